"""What the figures of the commands that judge files rest on."""

from splatctrl_cli.evaluate import score_report


def test_a_figure_of_views_rests_on_the_views_that_have_it() -> None:
    views = [{"psnr_seen": 20.0, "in_front_seen": None}, {"psnr_seen": 21.0, "in_front_seen": 0.0}]
    metrics = {"num_views": 2, "psnr_seen": 20.5, "in_front_seen": 0.0, "num_warnings": 0, "change_psnr_seen": 0.1}
    counts = score_report.counts_of({"metrics": metrics, "views": views})
    assert counts == {"num_views": 2, "psnr_seen": 2, "in_front_seen": 1, "num_warnings": 2, "change_psnr_seen": 2}
    both = {"metrics": metrics | {"num_views": 4}, "results": {"a": {"views": views}, "b": {"views": views}}}
    assert score_report.counts_of(both)["in_front_seen"] == 2

"""A bake as a function: what its figures rest on."""

from splatctrl_cli.jobs.bake import counts_of


def test_a_figure_of_a_band_rests_on_the_cells_of_that_band() -> None:
    figures = {"num_cells": 1000, "voxel": 0.02, "seen.hard.0_2cm.count": 0, "seen.hard.0_2cm.rmse": None}
    figures |= {"over_estimate.count": 7, "over_estimate.count_beyond": 0}
    counts = counts_of(figures)
    assert counts["seen.hard.0_2cm.rmse"] == 0 and counts["over_estimate.count_beyond"] == 7
    assert counts["voxel"] == counts["seen.hard.0_2cm.count"] == 1000

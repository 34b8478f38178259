"""A tiny study from end to end: a trial for each cell, kept and gone on with; and what it does not take for whole."""

import shutil
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.__main__ import main
from experiments.environments import ENVIRONMENTS
from experiments.problem_run import TRIALS, read_trials, verdict_on_trials
from experiments.problems import archive_of
from experiments.study import StudyRequest, StudyResult, merged_study, run_study
from experiments.trial import OURS, TRUTH, Trial
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.evaluate.verdict import Outcome
from tests.refused import expect_refusal

CAMERAS = (2,)


def request(out: Path) -> StudyRequest:
    return StudyRequest(study="table2", out=out, trials=1, methods=(OURS, TRUTH), width=32)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, StudyResult, StudyResult]]:
    """A study of two cameras, of which one of two shards ran first, and what came of that and of the whole.

    Its problems run in threads; in processes of their own those of test_shared_workspace do.
    """
    out = tmp_path_factory.mktemp("study") / "table2"
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("SPLATCTRL_REAL_DATA", raising=False)
        patch.setattr(
            "experiments.study.ProcessPoolExecutor", lambda max_workers, **_: ThreadPoolExecutor(max_workers)
        )
        patch.setattr("experiments.drawn_task.TASK_GUESSES", 6)
        patch.setattr("experiments.trial.PLANS", 1)
        patch.setattr("experiments.trial.SEARCH", 300)
        patch.setattr("experiments.trial.CAMERAS", CAMERAS)
        patch.setattr("experiments.table2.CAMERAS", CAMERAS)
        part = run_study(replace(request(out), shard=(1, 2)))
        assert not (out / TRIALS).exists()
        yield out, part, run_study(request(out))


def test_a_study_with_a_shard_missing_is_not_whole_and_says_which_problem_lacks(
    whole: tuple[Path, StudyResult, StudyResult],
) -> None:
    _, part, _ = whole
    assert part.verdict.outcome is Outcome.NOT_EVALUABLE
    assert not part.trials
    assert not part.sections
    assert "1 of 3 problems have no trials yet: cubby-0000" in part.verdict.sentence


def test_every_cell_has_a_trial_and_those_of_before_are_kept(whole: tuple[Path, StudyResult, StudyResult]) -> None:
    out, _, result = whole
    assert result.num_kept == 2
    cells = {(t.environment, t.cameras, t.method) for t in result.trials}
    ours = {(e, n, OURS) for e in ENVIRONMENTS for n in CAMERAS}
    assert cells == ours | {(e, 0, TRUTH) for e in ENVIRONMENTS}
    assert all(trial.success for trial in result.trials if trial.method == TRUTH)
    assert all(bool(trial.cause) is not trial.success for trial in result.trials)
    assert read_trials(out / TRIALS, Trial) == list(result.trials)
    assert [title.split(" (")[0] for title, _, _ in result.sections[:3]] == ["Tabletop", "Cubby", "Merged cubby"]


def test_other_settings_do_not_go_on_in_the_folder(whole: tuple[Path, StudyResult, StudyResult]) -> None:
    out = whole[0]
    expect_refusal(
        "was begun with other settings: width", run_study, replace(request(out), width=48), error=UsageError
    )
    with pytest.raises(UsageError, match="was begun with other settings: methods"):
        run_study(replace(request(out), methods=(TRUTH,)))
    (out.parent / "other").mkdir()
    (out.parent / "other" / "run.json").write_text("{}")
    expect_refusal("is no study, but something else", run_study, request(out.parent / "other"), error=UsageError)


def test_a_table_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / TRIALS).write_text("a,b\n1,2\n")
    expect_refusal("is not a table of trials: other columns", read_trials, tmp_path / TRIALS, Trial)


def test_trials_made_elsewhere_come_to_the_same_table(
    whole: tuple[Path, StudyResult, StudyResult], tmp_path: Path
) -> None:
    out, _, result = whole
    lines = (out / TRIALS).read_text().splitlines(keepends=True)
    for name, part in (("a.csv", lines[1:5]), ("b.csv", lines[5:])):
        (tmp_path / name).write_text("".join([lines[0], *part]))
    files = (tmp_path / "a.csv", tmp_path / "b.csv")
    merged = merged_study(replace(request(tmp_path / "table2"), made=files))
    assert (merged.sections, merged.verdict) == (result.sections, result.verdict)
    assert (tmp_path / "table2" / TRIALS).read_bytes() == (out / TRIALS).read_bytes()
    unfinished = tmp_path / "unfinished"
    shutil.copytree(out, unfinished)
    (unfinished / TRIALS).unlink()
    assert len(merged_study(replace(request(tmp_path / "again"), made=(unfinished,))).trials) == len(result.trials)
    with pytest.raises(InputError, match=r"csv: tabletop 0, 2 cameras, ours: is there twice"):
        merged_study(replace(request(tmp_path / "twice"), made=(out, files[0])))
    (tmp_path / "empty").mkdir()
    expect_refusal(rf"has no {TRIALS}", merged_study, replace(request(tmp_path / "none"), made=(tmp_path / "empty",)))
    expect_refusal("was begun with other settings", merged_study, replace(request(out), made=files), error=UsageError)


def test_a_method_and_an_archive_that_are_none_are_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--methods luck: expected some of ours, tsdf, truth"):
        run_study(replace(request(tmp_path / "out"), methods=("luck",)))
    expect_refusal(r"has no problems\.tar\.bz2", archive_of, tmp_path)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("words", [("--trials", "0"), ("--workers", "0"), ("--width", "-1"), ("--shard", "3/2")])
def test_counts_that_make_no_study_are_refused(words: tuple[str, str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as left:
        main(["table2", *words, "-o", str(tmp_path / "out")])
    assert left.value.code == 2 and not (tmp_path / "out").exists()


def test_without_a_trial_nothing_is_judged() -> None:
    assert verdict_on_trials([]).outcome is Outcome.NOT_EVALUABLE


def test_an_error_is_one_line_with_its_remedy_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["table2", "--made", str(tmp_path / "none"), "-o", str(tmp_path / "out")]) == 4
    assert capsys.readouterr().err.count("check the path") == 1

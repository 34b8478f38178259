"""Annotations and step summaries as GitHub Actions reads them."""

import io
from pathlib import Path

import pytest

from splatctrl_cli.report import github
from splatctrl_cli.report.github import annotations, summary, tell_github
from splatctrl_cli.report.suites import Case, Kind, Suite


def case_of(kind: Kind, name: str = "clearance", sentence: str = "too near", text: str = "") -> Case:
    return Case(name=name, group="log.mcap/replay", kind=kind, sentence=sentence, text=text or sentence)


def suite_of(*cases: Case, path: str = "") -> Suite:
    return Suite(name="log.mcap", cases=cases, path=path)


def test_ten_annotations_at_most_and_those_of_the_most_severe() -> None:
    kinds = [Kind.NOT_EVALUABLE] * 8 + [Kind.PASSED, Kind.SKIPPED] + [Kind.FAILED] * 4
    lines = annotations([suite_of(*map(case_of, kinds))], is_fatal=True, environment={})
    assert [line.count("(failed)") for line in lines] == [1] * 4 + [0] * 6
    assert all(line.startswith("::error title=log.mcap/replay%3A clearance (") for line in lines)
    (line,) = annotations([suite_of(case_of(Kind.FAILED))], is_fatal=False, environment={})
    assert line == "::warning title=log.mcap/replay%3A clearance (failed)::too near"


def test_an_annotation_is_one_line_that_gives_back_its_text() -> None:
    odd = case_of(Kind.FAILED, name="a,b:c\n::stop-commands::x", text="100 %\r\n::add-mask::secret, and: more")
    (line,) = annotations([suite_of(odd)], is_fatal=True, environment={})
    assert len(line.splitlines()) == 1
    head, _, text = line.removeprefix("::error ").partition("::")
    assert "," not in head
    assert head.count(":") == 0
    back = text.replace("%0A", "\n").replace("%0D", "\r").replace("%25", "%")
    assert back == odd.text


def test_the_file_of_an_annotation_is_the_recording_where_the_repository_has_it(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "log.mcap").touch()
    workspace = {"GITHUB_WORKSPACE": str(tmp_path)}

    def line(path: Path | str, environment: dict[str, str]) -> str:
        return annotations([suite_of(case_of(Kind.FAILED), path=str(path))], is_fatal=True, environment=environment)[
            0
        ]

    assert line(tmp_path / "data" / "log.mcap", workspace).startswith("::error file=data/log.mcap,title=")
    for path, environment in ((tmp_path / "data", workspace), ("missing", workspace), (__file__, workspace)):
        assert line(path, environment).startswith("::error title=")
    assert line(tmp_path / "data" / "log.mcap", {}).startswith("::error title=")


def test_a_summary_has_a_row_for_each_case_that_is_not_passed_and_no_markup_of_others() -> None:
    cases = [case_of(Kind.PASSED), case_of(Kind.FAILED, sentence="a | b <script>\nnext *x*"), case_of(Kind.ERROR)]
    text = summary([suite_of(*cases)], 10_000)
    head, *rows = [line for line in text.splitlines() if line]
    assert head == "### splatctrl: log.mcap: 1 of 3 criteria passed, 1 failed, 1 error"
    assert len(rows) == 4
    assert "a &#124; b &#60;script&#62; next &#42;x&#42;" in rows[2]
    assert rows[2].count("|") == 5


@pytest.mark.parametrize("room", [0, 100, 400, 1000, 3000, 100_000])
def test_a_summary_keeps_within_its_room_and_says_what_it_leaves_out(room: int) -> None:
    suites = [suite_of(*[case_of(Kind.FAILED, sentence="é" * 20)] * 50)]
    text = summary(suites, room)
    assert len(text.encode()) <= room
    shown = text.count("| failed |")
    assert shown == 50 or f"... and {50 - shown} more that do not fit here" in text or room < 300
    assert (shown == 50) == (room == 100_000)


def test_steps_of_one_summary_share_its_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, suites = tmp_path / "summary.md", [suite_of(*[case_of(Kind.FAILED)] * 30)]
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(file))
    monkeypatch.setattr(github, "SUMMARY_BYTES", 4000)
    file.write_text("what another step wrote\n")
    for _ in range(3):
        tell_github(suites, io.StringIO(), is_fatal=True)
    assert 3900 < file.stat().st_size <= 4000
    assert file.read_text().startswith("what another step wrote\n### splatctrl")


def test_nothing_is_said_outside_of_github(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.delenv("GITHUB_ACTIONS", raising=False)
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(tmp_path / "summary.md"))
    tell_github([suite_of(case_of(Kind.FAILED))], stream, is_fatal=True)
    assert (stream.getvalue(), list(tmp_path.iterdir())) == ("", [])
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.delenv("GITHUB_STEP_SUMMARY")
    tell_github([suite_of(case_of(Kind.FAILED))], stream, is_fatal=True)
    assert stream.getvalue().startswith("::error ")

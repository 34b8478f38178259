"""JUnit XML is read back by two parsers that others keep, whatever is in the texts; annotations and summaries are as
GitHub Actions reads them.
"""

import io
import re
from pathlib import Path

import pytest
import xunitparserx
from hypothesis import given, settings
from hypothesis import strategies as st
from junitparser import Error, Failure, JUnitXml, Skipped

from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.verdict import Outcome, Reason, verdict_of
from splatctrl_cli.report.junit import (
    Case,
    Kind,
    Suite,
    annotations,
    cases_of,
    check_replaceable,
    error_case,
    junit_text,
    summary,
    tell_github,
    worst_first,
    write_junit,
)
from tests.refused import expect_refusal

FAR = Reason(criterion="clearance", outcome=Outcome.PASSED, sentence="hand[3] is 60 mm away", value=0.06, unit="m")
NEAR = Reason(
    criterion="clearance",
    outcome=Outcome.FAILED,
    sentence="hand[9] is 4.5 mm from the scene",
    value=0.0045,
    threshold=0.02,
    unit="m",
    time_s=1.62,
    place=(0.5, 0.25, -0.1),
    who="hand[9]",
    cause="near splat 7",
    remedy="raise control.margin",
    count=351,
)
BLIND = Reason(
    criterion="known space", outcome=Outcome.NOT_EVALUABLE, sentence="40 % was seen", remedy="add a camera"
)
GATE = Reason(criterion="--require x>=1", outcome=Outcome.PASSED, sentence="x is 2, required >= 1")
VERDICT = verdict_of("replay", [FAR, NEAR, BLIND, GATE], notes=["3 fixed spheres"]).as_dict()
GROUP = "log.mcap/replay"


def suite_of(*cases: Case, **more: object) -> Suite:
    return Suite(name="log.mcap", cases=cases, **more)  # type: ignore[arg-type]


def not_run(group: str, why: str) -> Case:
    return Case(name="skipped", group=group, kind=Kind.SKIPPED, sentence=why, text=why)


def test_a_case_for_each_criterion_and_gate_of_which_only_the_passed_pass(tmp_path: Path) -> None:
    cases = cases_of(VERDICT, GROUP)
    write_junit(
        tmp_path / "j.xml",
        [suite_of(*cases, notes=[VERDICT["sentence"], *VERDICT["notes"]], started="2026-01-01T00:00:00+00:00")],
    )
    (suite,) = JUnitXml.fromfile(str(tmp_path / "j.xml"))
    found = {case.name: case for case in suite}
    assert list(found) == ["clearance", "known space", "--require x>=1"]
    assert {case.classname for case in suite} == {GROUP}
    ((failure,), (error,)) = found["clearance"].result, found["known space"].result
    assert isinstance(failure, Failure) and isinstance(error, Error)
    assert failure.message == "hand[9] is 4.5 mm from the scene at 1.62 s"
    facts = ("0.0045 m", "threshold: 0.02 m", "time: 1.620 s", "0.500, 0.250, -0.100 m", "near splat 7", "351")
    for fact in (*facts, "remedy: raise control.margin", "60 mm away"):
        assert fact in failure.text
    assert (error.type, "remedy: add a camera" in error.text) == ("not evaluable", True)
    assert found["--require x>=1"].is_passed
    assert (suite.tests, suite.failures, suite.errors, suite.skipped) == (3, 1, 1, 0)
    read, _ = xunitparserx.parse(str(tmp_path / "j.xml"))
    assert {case.methodname: case.result for case in read} == {
        "clearance": "failure",
        "known space": "error",
        "--require x>=1": "success",
    }
    assert "replay: FAILED" in read.stdout and "3 fixed spheres" in read.stdout


def test_what_could_not_run_or_was_not_run_or_was_killed_is_no_pass() -> None:
    cases = [
        error_case("a/bake", "scene: no such file", exit_code=4),
        not_run("a/replay", "needs a/bake"),
        error_case("a/bake", "timed out after 5 s", exit_code=None, lines=["fits", "still fits"]),
    ]
    (suite,) = JUnitXml.fromstring(junit_text([suite_of(*cases)]).encode())
    (error,), (skipped,), (killed,) = (case.result for case in suite)
    assert (type(error), type(skipped), [*suite][2].name) == (Error, Skipped, "killed")
    assert (error.message, "exit code: 4" in error.text) == ("scene: no such file", True)
    assert (killed.message, killed.text) == ("timed out after 5 s", "timed out after 5 s\nfits\nstill fits")
    assert (suite.tests, suite.errors, suite.skipped) == (3, 2, 1)
    each = cases_of(VERDICT, "a")[1:], [not_run("b", "")], cases_of(VERDICT, "c")
    worst = [case.kind for _, case in worst_first([suite_of(*some) for some in each])]
    assert worst == [Kind.FAILED, Kind.NOT_EVALUABLE, Kind.NOT_EVALUABLE, Kind.SKIPPED]


def test_what_was_expected_to_fail_passes_and_fails_where_it_passes() -> None:
    assert {case.kind for case in cases_of(VERDICT, GROUP, expected="failed")} == {Kind.PASSED}
    first, second = cases_of(verdict_of("replay", [FAR]).as_dict(), GROUP, expected="failed")
    assert (first.kind, first.sentence, second.kind) == (Kind.FAILED, "expected 'failed', got 'passed'", Kind.PASSED)


def test_the_same_suites_are_the_same_text_but_for_the_times() -> None:
    def text(**times: object) -> str:
        return re.sub(r' (time|timestamp)="[^"]*"', "", junit_text([suite_of(*cases_of(VERDICT, GROUP), **times)]))

    assert text() == text(started="2026-01-01T00:00:00+00:00", seconds=3.25)


@settings(deadline=None, max_examples=50)
@given(st.text(st.characters(exclude_categories=()), max_size=20))
def test_no_text_breaks_the_xml_or_is_lost(odd: str) -> None:
    case = Case(name=f"n{odd}", group=f"g{odd}", kind=Kind.FAILED, sentence=f"s{odd}", text=f"t{odd}]]>&<")
    passed = Case(name="p", group="g", kind=Kind.PASSED, text=f"t{odd}")
    text = junit_text([suite_of(case, passed, notes=[odd], properties={"label": odd})])
    (suite,) = JUnitXml.fromstring(text.encode())
    (failure,) = next(iter(suite)).result
    shown = re.sub(r"[^\t\n -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]", lambda found: ascii(found[0])[1:-1], odd)
    assert next(iter(suite)).name == f"n{shown}"
    assert (failure.message, failure.text) == (f"s{shown}", f"t{shown}]]>&<")


def test_a_file_that_is_no_report_is_never_replaced(tmp_path: Path) -> None:
    file = tmp_path / "log.mcap"
    file.write_bytes(b"\x89MCAP")
    with pytest.raises(
        UsageError, match=r"log\.mcap: exists, and is no JUnit report of splatctrl; give another --junit"
    ):
        write_junit(file, [suite_of()])
    assert file.read_bytes() == b"\x89MCAP"
    expect_refusal("is a folder, expected a file", write_junit, tmp_path, [suite_of()], error=UsageError)
    write_junit(tmp_path / "new" / "j.xml", [suite_of()])
    check_replaceable(tmp_path / "new" / "j.xml")
    write_junit(tmp_path / "new" / "j.xml", [suite_of(*cases_of(VERDICT, GROUP))])
    assert "hand[9]" in (tmp_path / "new" / "j.xml").read_text()
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["j.xml"]


def case_of(kind: Kind, name: str = "clearance", sentence: str = "too near", text: str = "") -> Case:
    return Case(name=name, group="log.mcap/replay", kind=kind, sentence=sentence, text=text or sentence)


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
    head, _, text = line.removeprefix("::error ").partition("::")
    assert len(line.splitlines()) == 1 and not {",", ":"} & set(head)
    assert text.replace("%0A", "\n").replace("%0D", "\r").replace("%25", "%") == odd.text


@pytest.mark.parametrize(
    ("path", "workspace", "start"),
    [
        ("data/log.mcap", ".", "::error file=data/log.mcap,title="),
        ("data", ".", "::error title="),
        ("missing", ".", "::error title="),
        (__file__, ".", "::error title="),
        ("data/log.mcap", None, "::error title="),
    ],
)
def test_the_file_of_an_annotation_is_the_recording_where_the_repository_has_it(
    tmp_path: Path, path: str, workspace: str | None, start: str
) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "log.mcap").touch()
    environment = {} if workspace is None else {"GITHUB_WORKSPACE": str(tmp_path / workspace)}
    suite = suite_of(case_of(Kind.FAILED), path=str(tmp_path / path))
    assert annotations([suite], is_fatal=True, environment=environment)[0].startswith(start)


def test_a_summary_has_a_row_for_each_case_that_is_not_passed_and_no_markup_of_others() -> None:
    cases = [case_of(Kind.PASSED), case_of(Kind.FAILED, sentence="a | b <script>\nnext *x*"), case_of(Kind.ERROR)]
    head, *rows = [line for line in summary([suite_of(*cases)], 10_000).splitlines() if line]
    assert (head, len(rows)) == ("### splatctrl: log.mcap: 1 of 3 criteria passed, 1 failed, 1 error", 4)
    assert "a &#124; b &#60;script&#62; next &#42;x&#42;" in rows[2] and rows[2].count("|") == 5


@pytest.mark.parametrize("room", [0, 100, 400, 1000, 3000, 100_000])
def test_a_summary_keeps_within_its_room_and_says_what_it_leaves_out(room: int) -> None:
    text = summary([suite_of(*[case_of(Kind.FAILED, sentence="é" * 20)] * 50)], room)
    assert len(text.encode()) <= room
    shown = text.count("| failed |")
    assert shown == 50 or f"... and {50 - shown} more that do not fit here" in text or room < 300
    assert (shown == 50) == (room == 100_000)


def test_steps_of_one_summary_share_its_room(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, suites = tmp_path / "summary.md", [suite_of(*[case_of(Kind.FAILED)] * 30)]
    monkeypatch.setenv("GITHUB_ACTIONS", "true")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(file))
    monkeypatch.setattr("splatctrl_cli.report.junit.SUMMARY_BYTES", 4000)
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

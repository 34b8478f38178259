"""JUnit XML is read back by two parsers that others keep, whatever is in the texts."""

import re
from pathlib import Path

import pytest
import xunitparserx
from hypothesis import given, settings
from hypothesis import strategies as st
from junitparser import Error, Failure, JUnitXml, Skipped

from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.verdict import Outcome, Reason, verdict_of
from splatctrl_cli.report.junit import check_replaceable, junit_text, write_junit
from splatctrl_cli.report.suites import Case, Kind, Suite, cases_of, error_case, notes_of, skipped_case, worst_first

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


def test_a_case_for_each_criterion_and_gate_of_which_only_the_passed_pass(tmp_path: Path) -> None:
    cases = cases_of(VERDICT, GROUP)
    write_junit(tmp_path / "j.xml", [suite_of(*cases, notes=notes_of(VERDICT), started="2026-01-01T00:00:00+00:00")])
    (suite,) = JUnitXml.fromfile(str(tmp_path / "j.xml"))
    found = {case.name: case for case in suite}
    assert list(found) == ["clearance", "known space", "--require x>=1"]
    assert {case.classname for case in suite} == {GROUP}
    ((failure,), (error,)) = found["clearance"].result, found["known space"].result
    assert isinstance(failure, Failure)
    assert isinstance(error, Error)
    assert failure.message == "hand[9] is 4.5 mm from the scene at 1.62 s"
    for fact in ("0.0045 m", "threshold: 0.02 m", "time: 1.620 s", "0.500, 0.250, -0.100 m", "near splat 7", "351"):
        assert fact in failure.text
    assert "remedy: raise control.margin" in failure.text
    assert "60 mm away" in failure.text
    assert (error.type, "remedy: add a camera" in error.text) == ("not evaluable", True)
    assert found["--require x>=1"].is_passed
    assert (suite.tests, suite.failures, suite.errors, suite.skipped) == (3, 1, 1, 0)
    read, _ = xunitparserx.parse(str(tmp_path / "j.xml"))
    assert {case.methodname: case.result for case in read} == {
        "clearance": "failure",
        "known space": "error",
        "--require x>=1": "success",
    }
    assert "replay: FAILED" in read.stdout
    assert "3 fixed spheres" in read.stdout


def test_what_could_not_run_or_was_not_run_is_no_pass() -> None:
    cases = [error_case("a/bake", "scene: no such file", exit_code=4), skipped_case("a/replay", "needs a/bake")]
    (suite,) = JUnitXml.fromstring(junit_text([suite_of(*cases)]).encode())
    (error,), (skipped,) = (case.result for case in suite)
    assert (type(error), type(skipped)) == (Error, Skipped)
    assert (error.message, "exit code: 4" in error.text) == ("scene: no such file", True)
    assert (suite.tests, suite.errors, suite.skipped) == (2, 1, 1)


def test_what_was_killed_has_its_cause_in_a_line_and_the_end_of_its_log() -> None:
    case = error_case("a/bake", "timed out after 5 s", exit_code=None, lines=["fits", "still fits"])
    ((found,),) = JUnitXml.fromstring(junit_text([suite_of(case)]).encode())
    assert (found.name, found.result[0].message) == ("killed", "timed out after 5 s")
    assert found.result[0].text == "timed out after 5 s\nfits\nstill fits"


def test_what_was_expected_to_fail_passes_and_fails_where_it_passes() -> None:
    assert {case.kind for case in cases_of(VERDICT, GROUP, expected="failed")} == {Kind.PASSED}
    passed = verdict_of("replay", [FAR]).as_dict()
    first, second = cases_of(passed, GROUP, expected="failed")
    assert (first.kind, first.sentence, second.kind) == (Kind.FAILED, "expected 'failed', got 'passed'", Kind.PASSED)


def test_the_worst_of_all_suites_comes_first() -> None:
    suites = [
        suite_of(*cases_of(VERDICT, "a")[1:]),
        suite_of(skipped_case("b", "")),
        suite_of(*cases_of(VERDICT, "c")),
    ]
    assert [case.kind for _, case in worst_first(suites)] == [
        Kind.FAILED,
        Kind.NOT_EVALUABLE,
        Kind.NOT_EVALUABLE,
        Kind.SKIPPED,
    ]


def test_the_same_suites_are_the_same_text_but_for_the_times() -> None:
    def text(**times: object) -> str:
        return re.sub(r' (time|timestamp)="[^"]*"', "", junit_text([suite_of(*cases_of(VERDICT, GROUP), **times)]))

    assert text() == text(started="2026-01-01T00:00:00+00:00", seconds=3.25)


@settings(deadline=None)
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
    with pytest.raises(UsageError, match="is a folder, expected a file"):
        write_junit(tmp_path, [suite_of()])
    write_junit(tmp_path / "new" / "j.xml", [suite_of()])
    check_replaceable(tmp_path / "new" / "j.xml")
    write_junit(tmp_path / "new" / "j.xml", [suite_of(*cases_of(VERDICT, GROUP))])
    assert "hand[9]" in (tmp_path / "new" / "j.xml").read_text()
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["j.xml"]

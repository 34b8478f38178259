"""JUnit XML, which GitLab, Jenkins and others show beside a run."""

import re
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

from splatctrl_cli.errors import UsageError
from splatctrl_cli.files.output import output_path
from splatctrl_cli.report.suites import Case, Kind, Suite

HEAD = '<?xml version="1.0" encoding="UTF-8"?>\n<testsuites name="splatctrl"'
ELEMENTS = {Kind.FAILED: "failure", Kind.ERROR: "error", Kind.NOT_EVALUABLE: "error", Kind.SKIPPED: "skipped"}
_NOT_XML = re.compile("[^\t\n\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def write_junit(path: Path, suites: Sequence[Suite]) -> None:
    """Write the suites into the file `path`, whole or not at all; a report that is there is replaced.

    Raises UsageError where `path` is another kind of file or cannot be written, WriteError where the disk is full.
    """
    check_replaceable(path)
    with output_path(path, force=True, is_folder=False) as partial:
        partial.write_text(junit_text(suites), encoding="utf-8")


def check_replaceable(path: Path) -> None:
    """Raise UsageError where `path` is a file that is no report of ours, and not empty."""
    try:
        with path.open("rb") as stream:
            start = stream.read(len(HEAD))
    except (FileNotFoundError, NotADirectoryError, IsADirectoryError):
        return  # `output_path` says what is wrong with the others
    except OSError as error:
        raise UsageError(f"{path}: cannot be replaced: {error.strerror}", remedy="give another --junit") from None
    if start not in (b"", HEAD.encode()):
        raise UsageError(f"{path}: exists, and is no JUnit report of splatctrl", remedy="give another --junit")


def junit_text(suites: Sequence[Suite]) -> str:
    """The suites as XML 1.0, the same for the same suites; what is no character of XML stands as its escape."""
    seconds = _seconds(sum(suite.seconds for suite in suites))
    root = ElementTree.Element("testsuites", {"name": "splatctrl", **_counts(suites), "time": seconds})
    for suite in suites:
        _add_suite(root, suite)
    ElementTree.indent(root)
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_suite(root: ElementTree.Element, suite: Suite) -> None:
    attributes = {"name": _clean(suite.name), **_counts([suite]), "skipped": str(suite.count(Kind.SKIPPED))}
    attributes |= {"time": _seconds(suite.seconds)} | ({"timestamp": suite.started} if suite.started else {})
    element = ElementTree.SubElement(root, "testsuite", attributes)
    if suite.properties:
        properties = ElementTree.SubElement(element, "properties")
        for name, value in suite.properties.items():
            ElementTree.SubElement(properties, "property", name=_clean(name), value=_clean(value))
    for case in suite.cases:
        _add_case(element, case)
    if suite.notes:
        ElementTree.SubElement(element, "system-out").text = _clean("\n".join(suite.notes))


def _add_case(suite: ElementTree.Element, case: Case) -> None:
    attributes = {"classname": _clean(case.group), "name": _clean(case.name), "time": _seconds(case.seconds)}
    element = ElementTree.SubElement(suite, "testcase", attributes)
    if case.kind is Kind.PASSED:
        if case.text:
            ElementTree.SubElement(element, "system-out").text = _clean(case.text)
        return
    ended = {"message": _clean(case.sentence), "type": str(case.kind)}
    ElementTree.SubElement(element, ELEMENTS[case.kind], ended).text = _clean(case.text)


def _counts(suites: Sequence[Suite]) -> dict[str, str]:
    """Errors are also what is not evaluable: nothing was shown to be right."""
    return {
        "tests": str(sum(len(suite.cases) for suite in suites)),
        "failures": str(sum(suite.count(Kind.FAILED) for suite in suites)),
        "errors": str(sum(suite.count(Kind.ERROR, Kind.NOT_EVALUABLE) for suite in suites)),
    }


def _seconds(value: float) -> str:
    return f"{value:.3f}"


def _clean(text: str) -> str:
    """The text with escapes for what no XML can hold: control characters, bytes that are not UTF-8."""
    return _NOT_XML.sub(lambda found: ascii(found[0])[1:-1], text)

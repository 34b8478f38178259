"""The words of docstrings: ``make lint`` finds each fault, and the package has none."""

import pytest

from tools.docstrings import docstrings, find_faults


def test_no_docstring_of_the_package_breaks_a_rule() -> None:
    found = [*docstrings()]
    assert len(found) > 2000
    assert [
        f"{place}: {fault}" for place, text, is_function in found for fault in find_faults(text, is_function)
    ] == []


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("Whether a splat is round.", "first word"),
        ("Returns the nearest splat.", "first word"),
        ("nearest splat of each point.", "first word"),
        ("Nearest splat of each point", "first line"),
        (f"Nearest {'far ' * 15}splat.", "first line"),
        (f"Nearest splat.\n{'far ' * 60}", "first paragraph"),
        ("Nearest splat of the thing.", "terms"),
    ],
)
def test_a_rule_finds_its_fault(text: str, fault: str) -> None:
    (found,) = find_faults(text, is_function=True)
    assert found.startswith(fault)


def test_shapes_units_and_code_are_not_counted_as_words() -> None:
    text = f"Distance (Q,) [m] of `points_world`, {'far ' * 10}or ``a b c``."
    assert [*find_faults(text, is_function=True)] == []

"""Requirements that cannot pass vacuously."""

import math

import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.gates import check_gate_names, gate_reasons, parse_gate
from splatctrl_cli.evaluate.verdict import Outcome


@pytest.mark.parametrize("value", [None, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("comparison", [">=", "<=", ">", "<"])
def test_a_metric_without_a_finite_value_is_not_evaluable(value: float | None, comparison: str) -> None:
    gate = f"clearance{comparison}0"
    (found,) = gate_reasons([gate], {"clearance": value}, {"clearance": 1})
    assert found.outcome is Outcome.NOT_EVALUABLE
    assert "clearance is unknown" in found.sentence


@pytest.mark.parametrize("counts", [{"num_below_margin": 0}, {}])
def test_a_metric_that_rests_on_nothing_is_not_evaluable(counts: dict[str, int]) -> None:
    (found,) = gate_reasons(["num_below_margin<=0"], {"num_below_margin": 0}, counts)
    assert (found.outcome, found.count) == (Outcome.NOT_EVALUABLE, 0)
    assert "num_below_margin is unknown, as it rests on nothing" in found.sentence


@pytest.mark.parametrize(
    ("gate", "value", "holds"),
    [
        *((">=1", 1.0, True), (">=1", 1 - 1e-9, False), (">=1", 0.9995, False), (">=1", 1.0001, True)),
        *(("<=1", 1.0, True), ("<=1", 1 + 1e-9, False), ("<=1", 1.0005, False), ("<=1", 0.9999, True)),
        *((">1", 1.0, False), (">1", 1 + 1e-9, True), (">1", 0.9995, False)),
        *(("<1", 1.0, False), ("<1", 1 - 1e-9, True), ("<1", 1.0005, False)),
        *((">=0", -1e-12, False), ("<=0", 1e-12, False), (">0", 0.0, False), ("<0", 0.0, False)),
    ],
)
def test_a_gate_is_held_to_its_last_digit_and_strict_is_strict(gate: str, value: float, holds: bool) -> None:
    (found,) = gate_reasons([f"metric{gate}"], {"metric": value}, {"metric": 1})
    assert found.outcome is (Outcome.PASSED if holds else Outcome.FAILED)
    assert (found.value, found.threshold) == (value, float(gate.lstrip("<>=")))


def test_the_first_time_is_that_of_a_broken_gate_alone() -> None:
    asked: list[str] = []

    def first_time(name: str, holds: object) -> float:
        asked.append(name)
        assert holds(5.0) and not holds(4.9)  # type: ignore[operator]
        return 1.25

    found = gate_reasons(["a>=5", "b>=1"], {"a": 1.0, "b": 2.0}, {"a": 1, "b": 1}, first_time=first_time)
    assert asked == ["a"]
    assert [reason.outcome for reason in found] == [Outcome.FAILED, Outcome.PASSED]
    assert found[0].sentence.endswith("first at 1.250 s")


@pytest.mark.parametrize(
    ("name", "words"),
    [("min_clearence", "did you mean min_clearance?"), ("qqq", "known here: min_clearance, unknown_share")],
)
def test_a_name_that_is_not_known_is_refused_with_the_nearest(name: str, words: str) -> None:
    with pytest.raises(UsageError, match="unknown metric") as refused:
        check_gate_names([f"{name}>=0"], ("min_clearance", "unknown_share"))
    assert words in str(refused.value.remedy)


def test_a_figure_of_another_mode_is_refused_with_it() -> None:
    elsewhere = {"--mode audit": ("a",), "--mode closed-loop": ("a", "goal_reached")}
    with pytest.raises(UsageError, match="a figure of --mode closed-loop"):
        check_gate_names(["goal_reached>=1"], ("a",), elsewhere)
    check_gate_names(["a>=1"], ("a",), elsewhere)


@pytest.mark.parametrize(
    "gate", ["a", "a=1", "a>=", "a>=nan", "a>=inf", "a<=-inf", ">=1", "a>=1e999", "a>>1", "a>=x"]
)
def test_what_is_no_gate_is_refused(gate: str) -> None:
    with pytest.raises(UsageError, match="expected METRIC>=NUMBER"):
        parse_gate(gate)


def test_spaces_about_a_gate_mean_nothing() -> None:
    assert parse_gate(" a.b <= 1e-3 ") == ("a.b", "<=", 1e-3)

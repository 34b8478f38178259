"""One verdict of several reasons; and gates on metrics."""

import itertools
import json
import math
from unittest.mock import Mock

import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.evaluate.verdict import (
    EXIT_CODES,
    Outcome,
    Reason,
    check_gate_names,
    gate_reasons,
    parse_gate,
    verdict_of,
)
from tests.refused import expect_refusal


def reason(outcome: Outcome, criterion: str = "clearance", label: str = "", **more: object) -> Reason:
    return Reason(criterion=criterion, outcome=outcome, sentence=f"{criterion} said", label=label, **more)  # type: ignore[arg-type]


PASSED, FAILED, UNKNOWN = (reason(outcome) for outcome in Outcome)


@pytest.mark.parametrize(
    ("reasons", "outcome", "code"),
    [
        ([PASSED, PASSED], Outcome.PASSED, 0),
        ([PASSED, UNKNOWN], Outcome.NOT_EVALUABLE, 5),
        ([PASSED, FAILED], Outcome.FAILED, 1),
        ([UNKNOWN, FAILED, PASSED], Outcome.FAILED, 1),
    ],
)
def test_a_failure_outranks_missing_evidence_which_outranks_a_pass(
    reasons: list[Reason], outcome: Outcome, code: int
) -> None:
    rank = [Outcome.FAILED, Outcome.NOT_EVALUABLE, Outcome.PASSED].index
    for order in itertools.permutations(reasons):
        verdict = verdict_of("replay", order)
        assert (verdict.outcome, verdict.exit_code) == (outcome, code)
        assert [r.outcome for r in verdict.reasons] == sorted((r.outcome for r in reasons), key=rank)


@pytest.mark.parametrize(("found", "code"), [(PASSED, 3), (UNKNOWN, 5), (FAILED, 1)])
def test_damage_is_in_the_exit_code_of_what_passed_alone(found: Reason, code: int) -> None:
    assert verdict_of("reconstruct", [found], is_damaged=True).exit_code == code


def test_nothing_judged_is_not_evaluable() -> None:
    verdict = verdict_of("replay", [], passed="safe")
    assert (verdict.outcome, verdict.label, verdict.exit_code) == (Outcome.NOT_EVALUABLE, "not evaluable", 5)
    assert "nothing was judged" in verdict.sentence
    assert set(EXIT_CODES) == set(Outcome)


CONTACT, BROKEN = reason(Outcome.FAILED, label="contact"), reason(Outcome.FAILED, label="limits broken")


@pytest.mark.parametrize(
    ("reasons", "label"),
    [
        ([PASSED], "safe"),
        ([CONTACT, BROKEN], "contact"),
        ([FAILED], "failed"),
        ([FAILED, CONTACT, BROKEN], "contact"),
        ([reason(Outcome.PASSED, label="contact"), UNKNOWN], "not evaluable"),
    ],
)
def test_the_label_is_the_failures_own_or_the_commands(reasons: list[Reason], label: str) -> None:
    assert verdict_of("replay", reasons, passed="safe").label == label


def test_the_sentence_names_outcome_scope_the_decisive_reason_and_how_many_more() -> None:
    worst = reason(Outcome.FAILED, "clearance", "contact", time_s=1.5, cause="near a ball", remedy="stop")
    verdict = verdict_of("replay", [PASSED, UNKNOWN, UNKNOWN, worst], scope="all of it", notes=["a note"])
    assert verdict.sentence == (
        "replay: CONTACT (all of it): clearance: clearance said at 1.50 s, near a ball; stop; and 2 more reasons"
    )
    assert verdict.decisive == (worst, UNKNOWN, UNKNOWN)
    assert "and 1 more reason" in verdict_of("replay", [UNKNOWN, worst]).sentence
    assert "more" not in verdict_of("replay", [PASSED, worst]).sentence
    assert verdict_of("replay", [PASSED], passed="safe", notes=["a note"]).sentence == "replay: SAFE; a note"


@pytest.mark.parametrize(
    ("reasons", "asked", "code"),
    [
        ([FAILED, UNKNOWN], ("--require",), 0),
        ([UNKNOWN, reason(Outcome.FAILED, "--require x>=1")], ("--require",), 1),
        ([FAILED, reason(Outcome.NOT_EVALUABLE, "--require y>=1")], ("--require",), 5),
        ([PASSED, UNKNOWN], None, 5),
    ],
)
def test_what_was_asked_for_alone_can_turn_the_exit_code(
    reasons: list[Reason], asked: tuple[str, ...] | None, code: int
) -> None:
    assert verdict_of("replay", reasons).exit_code_of(asked) == code


def test_numbers_that_json_has_not_are_null() -> None:
    odd = reason(Outcome.FAILED, value=float("nan"), threshold=float("inf"), time_s=None, place=(1.0, 2.0, 3.0))
    written = json.loads(json.dumps(verdict_of("replay", [odd]).as_dict(), allow_nan=False))
    expected = {"value": None, "threshold": None, "time_s": None, "outcome": "failed", "place": [1.0, 2.0, 3.0]}
    assert {key: written["reasons"][0][key] for key in expected} == expected
    assert (len(written["reasons"]), written["outcome"], written["exit_code"]) == (1, "failed", 1)


@pytest.mark.parametrize("value", [None, math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("comparison", [">=", "<=", ">", "<"])
def test_a_metric_without_a_finite_value_is_not_evaluable(value: float | None, comparison: str) -> None:
    (found,) = gate_reasons([f"clearance{comparison}0"], {"clearance": value}, {"clearance": 1})
    assert found.outcome is Outcome.NOT_EVALUABLE and "clearance is unknown" in found.sentence


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


@pytest.mark.parametrize("gates", [["a>=5", "b>=1"], ["b>=1", "a>=5"]])
def test_a_gate_that_holds_hides_none_that_fails(gates: list[str]) -> None:
    found = verdict_of("replay", gate_reasons(gates, {"a": 1.0, "b": 2.0}, {"a": 1, "b": 1}), scope="")
    assert (found.outcome, found.exit_code, found.exit_code_of(("--require",))) == (Outcome.FAILED, 1, 1)
    assert [reason.criterion for reason in found.decisive] == ["--require a>=5"]


def test_the_first_time_is_that_of_a_broken_gate_alone() -> None:
    first_time = Mock(return_value=1.25)
    found = gate_reasons(["a>=5", "b>=1"], {"a": 1.0, "b": 2.0}, {"a": 1, "b": 1}, first_time=first_time)
    (((name, holds), _),) = first_time.call_args_list
    assert name == "a" and holds(5.0) and not holds(4.9)
    assert [reason.outcome for reason in found] == [Outcome.FAILED, Outcome.PASSED]
    assert found[0].sentence.endswith("first at 1.250 s")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("min_clearence", "did you mean min_clearance?"),
        ("qqq", "known here: min_clearance, unknown_share"),
        ("goal_reached", "a figure of --mode closed-loop"),
    ],
)
def test_a_name_that_is_not_known_is_refused_with_the_nearest(name: str, words: str) -> None:
    """Or with the mode whose figure it is."""
    elsewhere = {"--mode audit": ("min_clearance",), "--mode closed-loop": ("min_clearance", "goal_reached")}
    check_gate_names(["min_clearance>=1"], ("min_clearance", "unknown_share"), elsewhere)
    expect_refusal(
        words, check_gate_names, [f"{name}>=0"], ("min_clearance", "unknown_share"), elsewhere, error=UsageError
    )


@pytest.mark.parametrize(
    "gate", ["a", "a=1", "a>=", "a>=nan", "a>=inf", "a<=-inf", ">=1", "a>=1e999", "a>>1", "a>=x"]
)
def test_what_is_no_gate_is_refused(gate: str) -> None:
    assert parse_gate(" a.b <= 1e-3 ") == ("a.b", "<=", 1e-3)
    expect_refusal("expected METRIC>=NUMBER", parse_gate, gate, error=UsageError)

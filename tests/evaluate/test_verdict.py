"""One verdict of several reasons."""

import itertools
import json

import pytest

from splatctrl_cli.evaluate.verdict import EXIT_CODES, Outcome, Reason, verdict_of


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
    for order in itertools.permutations(reasons):
        verdict = verdict_of("replay", order)
        assert (verdict.outcome, verdict.exit_code) == (outcome, code)
        assert [r.outcome for r in verdict.reasons] == sorted(
            (r.outcome for r in reasons), key=[Outcome.FAILED, Outcome.NOT_EVALUABLE, Outcome.PASSED].index
        )


@pytest.mark.parametrize(("found", "code"), [(PASSED, 3), (UNKNOWN, 5), (FAILED, 1)])
def test_damage_is_in_the_exit_code_of_what_passed_alone(found: Reason, code: int) -> None:
    assert verdict_of("reconstruct", [found], is_damaged=True).exit_code == code


def test_nothing_judged_is_not_evaluable() -> None:
    verdict = verdict_of("replay", [], passed="safe")
    assert (verdict.outcome, verdict.label, verdict.exit_code) == (Outcome.NOT_EVALUABLE, "not evaluable", 5)
    assert "nothing was judged" in verdict.sentence
    assert set(EXIT_CODES) == set(Outcome)


def test_the_label_is_the_failures_own_or_the_commands() -> None:
    assert verdict_of("replay", [PASSED], passed="safe").label == "safe"
    two = [reason(Outcome.FAILED, label="contact"), reason(Outcome.FAILED, label="limits broken")]
    assert verdict_of("replay", two, passed="safe").label == "contact"
    assert verdict_of("replay", [FAILED], passed="safe").label == "failed"
    assert verdict_of("replay", [FAILED, *two], passed="safe").label == "contact"
    label_of_a_pass = reason(Outcome.PASSED, label="contact")
    assert verdict_of("replay", [label_of_a_pass, UNKNOWN], passed="safe").label == "not evaluable"


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


def test_what_was_asked_for_alone_can_turn_the_exit_code() -> None:
    gate, asked = reason(Outcome.FAILED, "--require x>=1"), ("--require", "golden")
    assert verdict_of("replay", [FAILED, UNKNOWN]).exit_code_of(asked) == 0
    assert verdict_of("replay", [UNKNOWN, gate]).exit_code_of(asked) == 1
    assert verdict_of("replay", [FAILED, reason(Outcome.NOT_EVALUABLE, "golden run")]).exit_code_of(asked) == 5
    assert verdict_of("replay", [PASSED, UNKNOWN]).exit_code_of(None) == 5


def test_numbers_that_json_has_not_are_null() -> None:
    odd = reason(Outcome.FAILED, value=float("nan"), threshold=float("inf"), time_s=None, place=(1.0, 2.0, 3.0))
    written = json.loads(json.dumps(verdict_of("replay", [odd]).as_dict(), allow_nan=False))
    (found,) = written["reasons"]
    assert (found["value"], found["threshold"], found["time_s"]) == (None, None, None)
    assert (found["outcome"], written["outcome"], written["exit_code"]) == ("failed", "failed", 1)
    assert found["place"] == [1.0, 2.0, 3.0]

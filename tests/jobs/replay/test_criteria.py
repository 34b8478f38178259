"""Criteria of a replay's verdict on made-up figures: those that a whole run seldom breaks alone."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from splatctrl_cli.config import Config, ControlConfig
from splatctrl_cli.control.audit import AuditTrace, Clearance
from splatctrl_cli.control.columns import Event, EventKind, Signal, audit_columns, events_of, step_columns
from splatctrl_cli.control.replay import Outcome as LoopOutcome
from splatctrl_cli.control.replay import ReplayTrace
from splatctrl_cli.control.step import ControlStep
from splatctrl_cli.evaluate.conformal import ConformalBound
from splatctrl_cli.evaluate.verdict import Outcome, Reason
from splatctrl_cli.jobs.replay import evidence_criteria as evidence
from splatctrl_cli.jobs.replay.criteria import Judged, controller
from splatctrl_cli.jobs.replay.files import columns_of
from splatctrl_cli.jobs.replay.inputs import LoggedStates
from splatctrl_cli.jobs.replay.known_scene import KnownScene
from splatctrl_cli.jobs.replay.motion_criteria import OF_MOTION, clearance, surface_clearance, unlearned_link
from splatctrl_cli.jobs.replay.request import MapError, Replay, ReplayInputs, ReplayRequest, SceneChange, Trace
from splatctrl_cli.jobs.replay.state_pass import NEAR_COLUMNS
from splatctrl_cli.recording.log.state_columns import StateColumns
from splatctrl_cli.scene.self_mask import self_mask_metrics
from splatctrl_cli.voxels import EvidenceClass
from tests.cli.replay_desk import FakeSource

NUM = 11
PASSED, FAILED, NOT_EVALUABLE = Outcome.PASSED, Outcome.FAILED, Outcome.NOT_EVALUABLE
NOTHING_NEAR = {name: np.full((NUM, *shape), np.nan) for name, shape in NEAR_COLUMNS.items()}
FIVE_STEPS = ReplayTrace(
    stamp_ns=np.arange(5),
    position=np.zeros((5, 0)),
    steps=[cast("ControlStep", None)] * 5,
    outcome=LoopOutcome.TIMEOUT,
    static_violations=(),
)
CONTROLLER = dict.fromkeys(("num_relaxed", "num_minimum_violation", "num_hold"), 0)


def judged(
    columns: Mapping[str, Any] | None = None,
    *,
    figures: Mapping[str, Any] | None = None,
    metrics: Mapping[str, float | None] | None = None,
    margin: float = 0.02,
    request: Mapping[str, Any] | None = None,
    self_model: Any = None,
    cameras: Any = None,
    **replay: Any,
) -> Judged:
    """A run in which nothing is broken but what is given; figures: of the scene, replay: fields of `Replay`."""
    stamps, trace = np.arange(NUM, dtype=np.int64) * 100_000_000, Trace()
    safe = dict.fromkeys(("unknown_share", "unbounded_s", "map_age_s", "is_blank"), np.zeros(NUM))
    surface = {"clearance_surface": np.full(NUM, 0.1)}
    trace.append({"stamp_ns": stamps, **safe, **surface, **NOTHING_NEAR, **(columns or {})})
    config = Config(control=ControlConfig(margin=margin))
    nothing: Any = None
    run: dict[str, Any] = {
        **{"model": nothing, "config": config, "mode": "audit", "fields": (), "trace": trace},
        **{"num_before_scene": 0, "lead_in_s": 0.0, "median_radius": 0.0, "start_time_s": 0.0, "statics": {}},
        **{"static_violations": (), "unwatched": (), "overtaken": (), "closest": {}},
    }
    states = StateColumns(stamp_ns=stamps, position=np.zeros((NUM, 0)), velocity=np.zeros((NUM, 0)))
    scene = KnownScene(
        at=nothing, observed=None, first_ns=None, cameras=cameras, digests={}, figures=lambda: figures or {}
    )
    source, model = FakeSource(states=()), cast("Any", SimpleNamespace(self_model=self_model))
    return Judged(
        request=ReplayRequest(log=Path(), out=Path(), config=config, **(request or {})),
        inputs=ReplayInputs(source=source, states=states, model=model, scene=scene, truth=None, digests={}),
        logged=LoggedStates(source=source, states=states, poses=None),
        replay=Replay(**run | replay),
        metrics={"unknown_share": 0.0, "num_scene_hits": 0, **(metrics or {})},
    )


def outcomes(criterion: Callable[[Any], Iterator[Reason]], of: Any) -> list[Outcome]:
    return [reason.outcome for reason in criterion(of)]


def event(kind: EventKind) -> Event:
    (found,) = events_of(np.arange(3), [Signal(kind=kind, is_on=np.ones(3, bool), value=np.full(3, 1.5))])
    return found


def test_a_link_that_holds_a_thing_is_not_judged_by_the_things_surface() -> None:
    seen = {"median_mm": 2.0, "sign": 1, "num_pixels": 5000, "reach_mm": 12.0}
    finger, few = seen | {"median_mm": -9.0, "sign": -1}, seen | {"median_mm": 30.0, "num_pixels": 99}
    rows: list[Any] = [
        SimpleNamespace(self_mask={"arm": seen, "finger": finger, "tip": few}, inside_robot={}, stamp_ns=0)
    ]
    figures = self_mask_metrics(rows, {"finger"})
    assert figures["self_mask_residual_mm"] == 2.0
    assert self_mask_metrics(rows)["self_mask_residual_mm"] == 9.0
    (reason,) = evidence.calibration(judged(figures=figures | {"self_mask_residual_mm": 6.0}))
    assert reason.who == "arm"


def loop_of(kind: str, metrics: Mapping[str, float], num_near: int = 0) -> Judged:
    """A closed loop with an event; num_near: states with rows relaxed near their margin."""
    columns, happened = {"relaxed_near": np.arange(NUM) < num_near}, (event(EventKind(kind.replace("_", "-"))),)
    return judged(columns, closed_loop=FIVE_STEPS, events=happened, metrics=CONTROLLER | metrics)


@pytest.mark.parametrize(
    ("unknown", "last", "outcome"),
    [
        ({"fore": "moves too little (3 of 5 configurations)"}, 0.010, NOT_EVALUABLE),
        ({"fore": "moves too little (3 of 5 configurations)"}, 0.021, FAILED),
        ({"upper": "moves too little (3 of 5 configurations)"}, 0.010, FAILED),
    ],
)
def test_an_object_always_beside_a_link_that_hardly_moves_may_be_its_part(
    unknown: dict[str, str], last: float, outcome: Outcome
) -> None:
    distance = np.append(np.full(NUM - 1, 0.009), last)
    happened = replace(event(EventKind.BELOW_MARGIN), source="exact", worst_name="fore[1]", worst=0.009)
    columns = {"clearance_exact": distance, "clearance_splats": distance, "nearest_exact": ["fore[1]"] * NUM}
    known = SimpleNamespace(unknown=unknown)
    (reason,) = clearance(judged(columns, events=(happened,), self_model=known, fields=("exact",)))
    assert reason.outcome is outcome
    if outcome is NOT_EVALUABLE:
        assert "a part of fore, which moves too little (3 of 5 configurations)" in reason.sentence
    driven = judged(columns, events=(happened,), self_model=known, fields=("exact",), closed_loop=FIVE_STEPS)
    assert unlearned_link(driven) == (("fore", unknown["fore"]) if "fore" in unknown else None)


def bodied(deficit: tuple[float, float], surface: float) -> Judged:
    """A run whose spheres keep 30 mm and whose surface keeps less, by two spheres of which each leaves something."""
    model = SimpleNamespace(
        moving_spheres=np.array([True, True]),
        sphere_deficit=np.array(deficit),
        coverage=None,
        coverage_unknown="no meshes",
    )
    columns = {"clearance_surface": np.full(NUM, surface), "clearance_between": np.full(NUM, surface)}
    return judged(columns | {"clearance_exact": np.full(NUM, 0.03)}, fields=("exact",), model=model)


def seen_off(residual: float) -> Judged:
    """A run whose map's hand is seen so far [mm] from where its joints put it."""
    links = {"hand": {"median_mm": -residual, "sign": -1, "num_pixels": 500}}
    return judged(figures={"self_mask_residual_mm": residual, "self_mask": links})


def displaced(sigma: float) -> Judged:
    """A run of which one camera sees the robot 6 mm off, with this uncertainty [mm], another where it is."""
    left = {"distance_mm": 6.0, "sigma_mm": sigma, "num_pixels": 2000}
    right = {"distance_mm": 0.3, "sigma_mm": 0.2, "num_pixels": 4000}
    return judged(figures={"displaced_cameras": {"left": left, "right": right}})


def missing(error: float) -> Judged:
    """A run whose map misses surface by up to `error` [m], 10 cm from the arm."""
    bound = ConformalBound(bound=error, confidence=0.9, num_blocks=9, length=1, at=0)
    return judged(map_error=MapError(source="cam3", num_sets=9, num_seen=9, num_points=5, bound=bound, time_s=0.1))


def past_limit(share: float) -> Judged:
    """A run past a joint's limit by a share of the tolerance."""
    margin = np.full(NUM, -share * ControlConfig().limit_tolerance)
    return judged({"limit_margin": margin, "limit_joint": ["elbow"] * NUM})


(POSITION_LIMITS,) = (one.reasons for one in OF_MOTION if one.name == "position limits")
Told = list[tuple[Outcome, str, int | None]]
CRITERIA: dict[str, tuple[Callable[[Any], Iterator[Reason]], Judged, Told, str]] = {
    "a robot seen where its joints put it": (evidence.calibration, seen_off(4.9), [(PASSED, "", 1)], ""),
    "a robot seen off": (evidence.calibration, seen_off(5.1), [(NOT_EVALUABLE, "hand", 500)], ""),
    "a camera that sees the robot elsewhere": (
        evidence.calibration,
        displaced(0.9),
        [(NOT_EVALUABLE, "left", 2000)],
        "",
    ),
    "a camera that is not sure": (evidence.calibration, displaced(1.1), [], ""),
    "a step at the minimum violation": (
        controller,
        loop_of("minimum_violation", {"num_minimum_violation": 2}),
        [(FAILED, "", 5)],
        "constraints could not be satisfied at 2 of 5 steps (2 minimum violation)",
    ),
    "a step that holds": (
        controller,
        loop_of("hold", {"num_hold": 2}),
        [(FAILED, "", 5)],
        "constraints could not be satisfied at 2 of 5 steps (2 hold)",
    ),
    "a row relaxed within twice the margin": (
        controller,
        loop_of("relaxed", {"num_relaxed": 3}, num_near=2),
        [(FAILED, "", 5)],
        "constraints could not be satisfied at 2 of 5 steps (2 relaxed)",
    ),
    "a row relaxed farther away": (
        controller,
        loop_of("relaxed", {"num_relaxed": 3}),
        [(PASSED, "", 5)],
        "all 5 steps solved, 3 of them with rows relaxed, all over twice their margin away",
    ),
    "what spheres leave uncovered keeps no margin": (
        surface_clearance,
        bodied((0.0, 0.005), 0.015),
        [(NOT_EVALUABLE, "", NUM)],
        "",
    ),
    "what spheres leave uncovered keeps the margin": (
        surface_clearance,
        bodied((0.0, 0.005), 0.025),
        [(PASSED, "", NUM)],
        "",
    ),
    "one sphere of unknown cover": (
        surface_clearance,
        bodied((0.0, np.nan), 0.025),
        [(NOT_EVALUABLE, "", None)],
        "the coverage of the robot by its spheres is unknown: no meshes",
    ),
    "one state judged by an old map": (
        evidence.map_age,
        judged({"map_age_s": np.array([0.1] * 10 + [1.5])}, events=(event(EventKind.STALE_MAP),)),
        [(NOT_EVALUABLE, "", NUM)],
        "",
    ),
    "a log that ends with the motion": (
        evidence.map_age,
        judged({"map_age_s": np.append(np.full(NUM - 1, 0.1), 1.01)}),
        [(NOT_EVALUABLE, "", NUM)],
        "the map is up to 1.01 s old, allowed 1 s (from 1.00 to 1.00 s)",
    ),
    "old evidence about the arm under a new map": (
        evidence.evidence_age,
        judged({"evidence_age": np.full(NUM, 1.5)}),
        [(NOT_EVALUABLE, "", NUM)],
        "",
    ),
    "a joint past its limit by the tolerance": (POSITION_LIMITS, past_limit(0.5), [(PASSED, "", NUM)], ""),
    "a joint past its limit by more": (POSITION_LIMITS, past_limit(1.5), [(FAILED, "elbow", NUM)], ""),
    "a lead-in as long as is allowed": (
        evidence.judged_time,
        judged(lead_in_s=0.9 * Config().verdict.lead_in),
        [],
        "",
    ),
    "a longer lead-in": (
        evidence.judged_time,
        judged(lead_in_s=1.1 * Config().verdict.lead_in),
        [(NOT_EVALUABLE, "", NUM)],
        "",
    ),
    "a surface that keeps the map error": (evidence.map_error, missing(0.09), [(PASSED, "", 5)], ""),
    "a surface nearer than the map error": (evidence.map_error, missing(0.11), [(NOT_EVALUABLE, "cam3", 5)], ""),
}


@pytest.mark.parametrize("name", CRITERIA)
def test_a_criterion_gives_its_reason(name: str) -> None:
    criterion, run, expected, words = CRITERIA[name]
    found = list(criterion(run))
    assert [(reason.outcome, reason.who, reason.count) for reason in found] == expected
    assert all(reason.sentence.startswith(words) for reason in found)


def test_a_state_without_a_distance_in_one_field_is_not_judged() -> None:
    there, blank, nowhere = np.full(NUM, 0.2), np.full(NUM, 0.2), np.full(NUM, -1)
    blank[3] = np.nan
    for fields in ((there, blank), (blank, there)):
        part = AuditTrace(
            stamp_ns=np.arange(NUM),
            position=np.zeros((NUM, 0)),
            clearance={name: Clearance(distance=d, sphere=nowhere) for name, d in zip("ab", fields, strict=True)},
            **dict.fromkeys(("limit_margin", "self_clearance", "unknown_share"), there),
            **dict.fromkeys(("limit_joint", "self_pair"), nowhere),
        )
        (reason,) = evidence.judged_time(judged({"is_blank": audit_columns(part, (), (), ())["is_blank"]}))
        assert (reason.outcome, reason.time_s) == (NOT_EVALUABLE, pytest.approx(0.3))


EVIDENCE = EvidenceClass
STRICT = (EVIDENCE.UNANSWERED, EVIDENCE.CONTRADICTED, EVIDENCE.DEPTH_EDGE, EVIDENCE.OUTSIDE)


def near_a(kind: EvidenceClass, distance: float) -> dict[str, Any]:
    """At one state a place of a class is so far [m] from the arm."""
    nearest, places = np.full((NUM, len(EVIDENCE)), np.inf), np.zeros((NUM, 3 * len(EVIDENCE)))
    nearest[4, kind] = distance
    places[4, 3 * kind : 3 * kind + 3] = 0.25
    return {"class_distance": nearest, "class_places": places}


def from_a_surface(column: str, distance: float) -> dict[str, Any]:
    """At one state unseen space is so far [m] from a surface of the map."""
    return {column: np.where(np.arange(NUM) == 4, distance, np.inf), f"{column}_place": np.full((NUM, 3), 0.25)}


@pytest.mark.parametrize(
    ("near", "distance", "count"),
    [
        (partial(from_a_surface, "unseen_path"), 0.043, 0),
        (partial(from_a_surface, "unseen_path"), 0.041, 1),
        (partial(from_a_surface, "blind_to_surface"), 0.101, 0),
        (partial(from_a_surface, "blind_to_surface"), 0.099, 1),
        *((partial(near_a, kind), distance, int(distance < 0.02)) for kind in STRICT for distance in (0.021, 0.019)),
        *((partial(near_a, kind), 0.0, 0) for kind in EVIDENCE if kind not in STRICT),
    ],
)
def test_a_place_of_which_too_little_is_known_near_the_arm_is_no_evidence(
    near: Callable[[float], dict[str, Any]], distance: float, count: int
) -> None:
    found = [r for r in evidence.known_space(judged(near(distance))) if r.outcome is NOT_EVALUABLE]
    told = [(r.count, r.time_s, r.place) for r in found if f"{1e3 * distance:.1f} mm" in r.sentence]
    assert told == [(1, pytest.approx(0.4), (0.25, 0.25, 0.25))] * count and len(found) == count


def unseen(share: float, **given: Any) -> Judged:
    """A run with a share of the space about the arm that no camera saw, at one state."""
    return judged({"unseen": np.where(np.arange(NUM) == 4, share, 0.1)}, **given)


@pytest.mark.parametrize(
    ("run", "num"),
    [
        *((judged(near_a(kind, 0.0), margin=0.0), 1) for kind in STRICT),
        *((unseen(evidence.UNSEEN - 0.01), 0), (unseen(evidence.UNSEEN + 0.01), 1)),
        # fewer cameras must see more of it
        *((unseen(0.34, cameras="a"), 1), (unseen(0.32, cameras="a"), 0)),
        *((unseen(0.41, cameras="ab"), 1), (unseen(0.39, cameras="ab"), 0)),
        *((unseen(0.47, cameras="abc"), 0), (unseen(0.47, cameras=None), 0)),
        # what is not recorded is not known and no proof
        (judged(metrics={"unknown_share": None}), 1),
        (judged(near_a(EVIDENCE.FREE, 0.01), request={"require_proof": "occupied"}), 1),
        (judged(near_a(EVIDENCE.FREE, 0.01), request={"unseen": "occupied"}), 1),
    ],
)
def test_space_of_which_too_little_is_known_is_no_evidence(run: Judged, num: int) -> None:
    assert outcomes(evidence.known_space, run).count(NOT_EVALUABLE) == num


@pytest.mark.parametrize("kind", [kind for kind in EvidenceClass if kind not in STRICT])
@pytest.mark.parametrize(("option", "broken"), [("require_proof", NOT_EVALUABLE), ("unseen", FAILED)])
def test_only_free_space_about_the_arm_is_proof(option: str, broken: Outcome, kind: EvidenceClass) -> None:
    columns = near_a(kind, 0.01) | {"assumed": np.zeros(NUM)}
    assert set(outcomes(evidence.known_space, judged(columns))) == {PASSED}
    run = judged(columns, request={option: "occupied"})
    assert (broken in outcomes(evidence.known_space, run)) == (kind is not EvidenceClass.FREE)


def test_cells_of_a_state_without_a_step_are_empty() -> None:
    never = {"q": np.zeros((NUM, 0)), "limit_margin": np.full(NUM, np.nan)}
    cells = columns_of(judged(never | step_columns([None] * NUM, 0), model=SimpleNamespace(joint_names=())).replay)
    assert {name for name, values in cells.items() if values == [""] * NUM} >= {"rung", "scale", "num_rows", "slack"}
    assert "" not in cells["limit_margin"]


@pytest.mark.parametrize(
    ("before", "after", "is_hit"),
    [(0.1, -0.01, True), (0.0, -1e-6, True), (-0.01, -0.02, False), (0.1, 0.0, False), (-0.02, 0.01, False)],
)
def test_only_a_scene_that_newly_comes_into_the_arm_is_a_hit(before: float, after: float, is_hit: bool) -> None:
    assert SceneChange(stamp_ns=0, before=before, after=after).is_hit == is_hit

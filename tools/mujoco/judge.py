"""The tool's answers about a recording, compared with the recording's truth."""

import csv
import json
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import nan
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tools.mujoco.table import (
    AUDIT,
    CONTACT,
    CRASH,
    FAILED,
    MARGIN_MM,
    NOT_EVALUABLE,
    REFUSED,
    SAFE,
    Row,
)

Floats = NDArray[np.float64]
Clearances = Callable[[Path, Floats, Floats], tuple[Floats, Floats]]

EPOCH_NS = 1_760_000_000 * 10**9  # stamp of the truth's time 0
OVER_MM, NEAR_MM = 8.0, 100.0
REACH_MM = 300.0  # up to which the truth is measured
NUM_CHARACTERS = 120  # of a reason
SCENE = "scene"
OUTCOME_OF = {"passed": SAFE, "failed": FAILED, "not evaluable": NOT_EVALUABLE}
NO_EVIDENCE = (4, 5)  # exit codes of a tool that refuses


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A recording with truth, by its folder."""

    folder: Path
    row: Row  # seed, index and the like; nothing judged
    log: Path
    urdf: Path
    spheres: Path
    joints: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class Node:
    """A command of a batch, and how it ended. exit_code: None if it was killed or never ran."""

    state: str
    exit_code: int | None
    cause: str
    sentence: str
    seconds: float


@dataclass(frozen=True, kw_only=True)
class Answer:
    """The tool's answer. label: of its verdict, empty without one."""

    outcome: str
    label: str
    reason: str


@dataclass(frozen=True, kw_only=True)
class Motion:
    """The judged states: times t (T,) [s], the tool's clearance `said` (T,) [mm], positions q (T, J), nearest links
    and splats.
    """

    t: Floats
    said: Floats
    q: Floats
    links: list[str]
    splats: list[str]


@dataclass(frozen=True, kw_only=True)
class Truth:
    """True clearance (T,) [mm] of the visual and of the collision surface, with names of the nearest links and
    objects.
    """

    visual: Floats
    collision: Floats
    links: list[str]
    objects: list[str]


def read_recording(folder: Path, spheres_folder: Path) -> Recording:
    """The recording in a folder, by its truth.json. Spheres that truth.json does not name are ROBOT.yaml in
    `spheres_folder`.
    """
    document = json.loads((folder / "truth.json").read_text(encoding="utf-8"))
    log, urdf = folder / document["log"], folder / document["urdf"]
    spheres = folder / document.get("spheres", spheres_folder / f"{document['robot']}.yaml")
    row = Row(
        seed=document["seed"],
        index=document["index"],
        mode="",
        family=document["family"],
        robot=document["robot"],
        depth=document["depth"],
        num_cams=len(document["cams"]),
        log=log.suffix.removeprefix(".") or "ros2",
    )
    return Recording(folder=folder, row=row, log=log, urdf=urdf, spheres=spheres, joints=(*document["joints"],))


def judge_replay(
    recording: Recording, mode: str, nodes: Mapping[str, Node], batch: Path, clearances: Clearances
) -> Row:
    """The row of a replay. nodes: by job; batch: folder of the batch's outputs for this recording."""
    node = nodes[mode]
    answer = read_answer(node, batch / f"{mode}.json")
    if node.state == "skipped":
        scene = read_answer(nodes[SCENE], batch / f"{SCENE}.json")
        outcome = CRASH if scene.outcome == CRASH else REFUSED
        answer = Answer(outcome=outcome, label="", reason=f"reconstruct: {scene.reason}"[:NUM_CHARACTERS])
    row = replace(
        recording.row,
        mode=mode,
        outcome=answer.outcome,
        label=answer.label,
        reason=answer.reason,
        seconds=node.seconds,
    )
    steps = batch / mode / "steps.csv"
    if answer.label and steps.is_file():
        motion = read_motion(steps, recording.joints)
        if mode == AUDIT:
            return compare(row, motion, read_truth(recording.folder, motion.t))
        visual, collision = clearances(recording.folder, motion.t, motion.q)
        return compare(row, motion, Truth(visual=1e3 * visual, collision=1e3 * collision, links=[], objects=[]))
    whole = read_truth(recording.folder, None if mode == AUDIT else np.zeros(1))  # a closed loop begins at time 0
    return replace(row, true_mm=float(whole.visual.min()), collision_mm=float(whole.collision.min()))


def read_answer(node: Node, result: Path) -> Answer:
    """The answer in a command's JSON: its verdict, its refusal, or else a crash."""
    if node.cause or node.exit_code is None:
        return Answer(outcome=CRASH, label="", reason=(node.cause or "did not run")[:NUM_CHARACTERS])
    try:
        document = json.loads(result.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        document = {}
    verdict = document.get("verdict")
    if verdict is None:
        outcome = REFUSED if node.exit_code in NO_EVIDENCE else CRASH
        message = document.get("error", {}).get("message", node.sentence) or f"exit {node.exit_code}"
        return Answer(outcome=outcome, label="", reason=message[:NUM_CHARACTERS])
    broken = [each for each in verdict["reasons"] if each["outcome"] == verdict["outcome"] != "passed"]
    first = f"{broken[0]['criterion']}: {broken[0]['sentence']}" if broken else ""
    outcome = CONTACT if verdict["label"] == "contact" else OUTCOME_OF[verdict["outcome"]]
    return Answer(outcome=outcome, label=verdict["label"], reason=first[:NUM_CHARACTERS])


def read_motion(steps: Path, joints: tuple[str, ...]) -> Motion:
    """The states in a replay's steps.csv; an empty clearance is NaN."""
    with steps.open(encoding="utf-8", newline="") as stream:
        lines = [*csv.DictReader(stream)]
    return Motion(
        t=np.array([(int(line["stamp_ns"]) - EPOCH_NS) * 1e-9 for line in lines]),
        said=np.array([1e3 * float(line["clearance_exact"] or nan) for line in lines]),
        q=np.array([[float(line[f"q_{joint}"]) for joint in joints] for line in lines]),
        links=[line["nearest_exact"].partition("[")[0] for line in lines],
        splats=[re.split(r"(?: at)? ?[\d(]", line["obstacle"], maxsplit=1)[0] for line in lines],
    )


def read_truth(folder: Path, t: Floats | None) -> Truth:
    """The truth of the logged motion at times t [s]; None means the truth's own times."""
    with np.load(folder / "truth.npz") as known:
        times = known["t"] if t is None else t
        nearest = np.interp(times, known["t"], np.arange(len(known["t"]))).round().astype(np.int64)
        return Truth(
            visual=1e3 * np.interp(times, known["t"], known["visual"]),
            collision=1e3 * np.interp(times, known["t"], known["collision"]),
            links=[str(name) for name in known["link"][nearest]],
            objects=[str(name) for name in known["object"][nearest]],
        )


def compare(row: Row, motion: Motion, truth: Truth) -> Row:
    """A row with figures that compare the tool's clearance of each state with the true clearance."""
    row = replace(
        row,
        true_mm=float(truth.visual.min()),
        collision_mm=float(truth.collision.min()),
        num_states=len(motion.t),
        num_true_below=int((truth.visual < MARGIN_MM).sum()),
    )
    said = np.minimum(motion.said, REACH_MM)
    known = np.isfinite(said)
    if not known.any():
        return row
    errors = (said - truth.visual)[known]
    overs = errors[truth.visual[known] < NEAR_MM]
    worst = int(np.nanargmin(motion.said))
    return replace(
        row,
        said_mm=float(motion.said[worst]),
        median_mm=float(np.median(np.abs(errors))),
        p95_mm=float(np.percentile(np.abs(errors), 95)),
        over_share=float((errors > OVER_MM).mean()),
        over_mm=float(overs.max()) if len(overs) else nan,
        num_said_below=int((motion.said[known] < MARGIN_MM).sum()),
        worst_s=float(motion.t[worst]),
        worst_link=motion.links[worst],
        worst_splat=motion.splats[worst],
        worst_true_mm=float(truth.visual[worst]),
        true_link=truth.links[worst] if truth.links else "",
        true_object=truth.objects[worst] if truth.objects else "",
    )

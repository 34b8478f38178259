"""Keys that a sweep may vary, and a run's jobs with varied values."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from splatctrl_cli.config import Config
from splatctrl_cli.config.ranges import Within
from splatctrl_cli.errors import UsageError, did_you_mean, refuse_if, require
from splatctrl_cli.files.output import sha256
from splatctrl_cli.jobs.batch.graph import CommandLine
from splatctrl_cli.jobs.batch.suite import Job
from splatctrl_cli.jobs.runs.run_folder import REPLAY, RunFolder, open_run
from splatctrl_cli.recording.source_options import CALIBRATION, PERTURB
from splatctrl_cli.simulate.tabletop import VISITOR

SIMULATE, FIT, BAKE = "simulate", "reconstruct", "sdf-bake"
MADE_BEFORE = {REPLAY: ("scene", "field"), BAKE: ("scene",)}  # options naming another command's output
PLACES = ("obstacle-x", "obstacle-y", "obstacle-radius")  # in the order of simulate --visitor


@dataclass(frozen=True, kw_only=True)
class Key:
    """Varied value: its unit, and the option of each command that takes it.

    lockstep: options for a run that makes its own map. is_monotone: the verdict can change only once.
    """

    name: str
    unit: str
    options: Mapping[str, str]
    lockstep: Mapping[str, str] = field(default_factory=dict)
    is_whole: bool = False
    is_monotone: bool = False


_BOTH = (FIT, REPLAY)
KEYS = {
    key.name: key
    for key in (
        Key(
            name="splats",
            unit="splats",
            options={FIT: "max-splats"},
            lockstep={REPLAY: "set.scene.max_splats"},
            is_whole=True,
        ),
        Key(
            name="cameras-out", unit="cameras", options={FIT: "cameras"}, lockstep={REPLAY: "cameras"}, is_whole=True
        ),
        Key(name="depth-noise", unit="m at 1 m", options=dict.fromkeys(_BOTH, "perturb.depth-noise")),
        Key(name="pose-error", unit="m", options=dict.fromkeys(_BOTH, "perturb.pose-error")),
        Key(name="pose-turn", unit="degrees", options=dict.fromkeys(_BOTH, "perturb.pose-turn")),
        Key(name="latency", unit="s", options={REPLAY: "latency"}),
        Key(name="max-map-age", unit="s", options={REPLAY: "max-map-age"}, is_monotone=True),
        Key(name="max-unknown", unit="", options={REPLAY: "max-unknown"}, is_monotone=True),
        Key(name="margin", unit="m", options={REPLAY: "set.control.margin"}, is_monotone=True),
        Key(name="speed", unit="m/s", options={REPLAY: "set.control.max_linear_speed"}),
        *(Key(name=name, unit="m", options={SIMULATE: "visitor"}) for name in PLACES),
    )
}


def key_of(name: str) -> Key:
    """Key by name, or a numeric setting ``SECTION.KEY``. Raises UsageError for other names."""
    if name in KEYS:
        return KEYS[name]
    section, _, setting = name.partition(".")
    table = getattr(Config(), section, None)
    declared = None if table is None else table.declared.get(setting)
    if not isinstance(declared, Within):
        settings = [f"{kind}.{each}" for kind, values in Config().as_dict().items() for each in values]
        known = f"known here: {', '.join(KEYS)}, and settings SECTION.KEY"
        what = "a setting that is no number" if declared is not None else "unknown key"
        raise UsageError(f"--over {name}: {what}", remedy=did_you_mean(name, [*KEYS, *settings], known))
    at, whole = {REPLAY: f"set.{name}"}, type(getattr(table, setting)) is int
    is_of_map = section in ("scene", "occupancy", "human")
    options = {FIT: f"set.{name}"} if is_of_map else {BAKE: f"set.{name}", **at} if section == "field" else at
    return Key(name=name, unit=declared.unit, options=options, lockstep=at if is_of_map else {}, is_whole=whole)


@dataclass(frozen=True, kw_only=True)
class Stage(Job):
    """Command of a run, with its training cameras."""

    cameras: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Chain:
    """Commands of a run, from the first that a key changes up to the replay."""

    stages: tuple[Stage, ...]
    keys: Mapping[str, Key]

    def jobs(self, values: Mapping[str, float]) -> tuple[Job, ...]:
        jobs = list[Job]()
        for stage in self.stages:
            chosen: dict[str, Any] = {
                key.options[stage.command]: int(values[name]) if key.is_whole else values[name]
                for name, key in self.keys.items()
                if stage.command in key.options
            }
            if "cameras" in chosen:
                chosen["cameras"] = list(stage.cameras[: len(stage.cameras) - int(chosen["cameras"])])
            if "visitor" in chosen:
                before = stage.options.get("visitor", VISITOR)
                chosen["visitor"] = [values.get(name, place) for name, place in zip(PLACES, before, strict=True)]
            jobs.append(replace(stage, matrix={option: [value] for option, value in chosen.items()}))
        return tuple(jobs)


def chain_of(run: RunFolder, keys: Mapping[str, Key], command_line: CommandLine) -> Chain:
    """Commands that made a replay, from the first that the keys change.

    Raises InputError for moved or changed inputs, UsageError for a key without effect.
    """
    stages = [_stage(run, command_line)]
    is_driven, is_lockstep = stages[0].options.get("mode") == "closed-loop", "lockstep" in stages[0].options
    searched = {
        name: replace(
            key,
            options=key.lockstep if is_lockstep and key.lockstep else key.options,
            is_monotone=key.is_monotone and not is_driven,  # a driven arm moves differently with another value
        )
        for name, key in keys.items()
    }
    wanted = {command for key in searched.values() for command in key.options}
    refuse_if(
        "speed" in keys and not is_driven,
        "--over speed: the arm moves as it was recorded",
        remedy="sweep a replay of --mode closed-loop",
        error=UsageError,
    )
    simulation = _simulation_of(stages[0]) if SIMULATE in wanted else None
    while wanted & {FIT, BAKE, SIMULATE} and (
        option := next((o for o in MADE_BEFORE.get(stages[0].command, ()) if o in stages[0].options), None)
    ):
        before = open_run(Path(stages[0].options[option]))
        refuse_if(
            before.command not in (FIT, BAKE),
            f"{before.path}: was written by {before.command}, expected {FIT}",
            remedy="sweep a replay of another scene",
            error=UsageError,
        )
        stages[0] = replace(stages[0], options={**stages[0].options, option: f"{{{before.command}}}"})
        stages.insert(0, _stage(before, command_line))
    if simulation is not None:
        stages = _add_simulation(simulation, stages, command_line)
    commands = {stage.command for stage in stages}
    for name, key in searched.items():
        refuse_if(
            not commands & key.options.keys(),
            f"--over {name}: the run has no {' or '.join(key.options)} that it could change",
            remedy="sweep a replay with --scene or --lockstep",
            error=UsageError,
        )
        takers = [stage for stage in stages if stage.command in key.options]
        refuse_if(
            "cameras" in key.options.values() and not all(stage.cameras for stage in takers),
            f"--over {name}: the run does not say which cameras trained",
            remedy="reconstruct again",
            error=UsageError,
        )
    return Chain(stages=tuple(stages), keys=searched)


def _stage(run: RunFolder, command_line: CommandLine) -> Stage:
    options = command_line.options_of(run.arguments)
    stages: list[Path] = []

    def find_place(value: Any) -> Any:
        if isinstance(value, list):
            return [find_place(each) for each in value]
        if not isinstance(value, Path):
            return value
        place = require(
            run.place_of(str(value), ()),
            f"{value}: is not there any more, and {run.path} was made from it",
            remedy="put it back, or make the run again and sweep that",
        ).absolute()
        stages.append(place)
        return str(place)

    options = {name: find_place(value) for name, value in options.items()}
    for recorded, digest in run.run.get("inputs", {}).items():
        name = recorded.removeprefix(CALIBRATION)
        places = [p for at in stages for p in (*((at,) if at.name == name else ()), at / name, at.parent / name)]
        files = [file for file in places if file.is_file()]
        refuse_if(
            not recorded.startswith(PERTURB) and not any(sha256(file) == digest for file in files),
            f"{files[0]}: has changed since {run.path} was made" if files else f"{run.path}: {recorded} has moved",
            remedy="put it back as it was, or make the run again and sweep that",
        )
    of_map = run.path / "scene"
    has_map = "lockstep" in options and (of_map / "run.json").is_file()
    metrics = open_run(of_map).metrics if has_map else run.metrics
    return Stage(name=run.command, command=run.command, options=options, cameras=tuple(metrics.get("cameras") or ()))


def _simulation_of(replayed: Stage) -> RunFolder:
    folder = Path(replayed.options.get("truth", "")).parent
    run = open_run(folder) if (folder / "run.json").is_file() else None
    return require(
        run if run is not None and run.command == SIMULATE else None,
        "--over obstacle-...: only of a simulated recording, by the folder that its --truth is in",
        remedy="make one with splatctrl simulate, and replay that with --truth DIR/truth.json",
        error=UsageError,
    )


def _add_simulation(simulation: RunFolder, stages: Sequence[Stage], command_line: CommandLine) -> list[Stage]:
    folder = simulation.path
    log, logs = folder / "log.mcap", ("log", "source", "seen-by")
    for recording in [Path(stage.options[option]) for stage in stages for option in logs if option in stage.options]:
        header = recording / "capture.json"
        sources = json.loads(header.read_text())["sources"].values() if header.is_file() else (sha256(recording),)
        refuse_if(
            sha256(log) not in sources,
            f"{recording}: is not the recording of {folder}",
            remedy=f"replay {log}",
            error=UsageError,
        )
    replaced = dict.fromkeys(logs, f"{{{SIMULATE}}}/log.mcap") | {"truth": f"{{{SIMULATE}}}/truth.json"}
    return [
        _stage(simulation, command_line),
        *(replace(s, options={**s.options, **{k: replaced[k] for k in replaced if k in s.options}}) for s in stages),
    ]

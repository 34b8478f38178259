"""The experiments of the paper that a study repeats."""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from splatctrl_cli.config import Config
from splatctrl_cli.files.output import Stopwatch
from splatctrl_cli.jobs.studies import (
    ablation,
    ablation_table,
    dtu,
    scenes,
    scenes_table,
    scenes_trial,
    table2,
    trial,
    workspace_table,
    workspace_trial,
)
from splatctrl_cli.jobs.studies.problem_run import SETTINGS, ProblemRequest, Study
from splatctrl_cli.jobs.studies.problems import FAMILIES, archive_of, read_problem


def _planned(request: ProblemRequest, config: Config, stopwatch: Stopwatch) -> Iterator[trial.Trial]:
    """The trials of a problem of Table II."""
    with stopwatch.stage("problem"):
        problem = read_problem(request.problem, request.problems)
    yield from trial.trials_of(
        problem,
        config,
        request.methods,
        width=request.width,
        threads=request.threads,
        stopwatch=stopwatch,
        out=request.out,
    )


def _carried(request: ProblemRequest, config: Config, stopwatch: Stopwatch) -> Iterator[scenes_trial.Transport]:
    """The trials of a scene with a cube."""
    return scenes_trial.transports_of(
        request.problem, request.methods, config, width=request.width, threads=request.threads, stopwatch=stopwatch
    )


def _visited(request: ProblemRequest, config: Config, stopwatch: Stopwatch) -> Iterator[workspace_trial.Visit]:
    """The trials of a visit of a person."""
    return workspace_trial.visits_of(
        request.problem, request.methods, config, width=request.width, stopwatch=stopwatch
    )


def _ablated(request: ProblemRequest, config: Config, stopwatch: Stopwatch) -> Iterator[ablation.Measured]:
    """A recording with each mechanism off in turn; `config` is that of each."""
    del config
    yield from ablation.measured(
        request.problem, request.methods, width=request.width, threads=request.threads, stopwatch=stopwatch
    )


def _scanned(request: ProblemRequest, config: Config, stopwatch: Stopwatch) -> Iterator[dtu.Fit]:
    """The fits of a scan; `config` is that of each."""
    del config
    return dtu.fits(request.problem, request.problems, request.methods, threads=request.threads, stopwatch=stopwatch)


STUDIES: Mapping[str, Study[Any]] = {
    "ablation": Study(
        row=ablation.Measured,
        methods=tuple(ablation.OFF),
        problems=ablation.problems,
        trials=_ablated,
        sections=ablation_table.sections,
        notes=ablation_table.notes,
    ),
    "table2": Study(
        row=trial.Trial,
        methods=trial.METHODS,
        problems=table2.problems,
        trials=_planned,
        sections=table2.sections,
        notes=table2.notes,
        archived=FAMILIES,
        archive=archive_of,
    ),
    "dtu": Study(
        row=dtu.Fit,
        methods=dtu.METHODS,
        problems=dtu.problems,
        trials=_scanned,
        sections=dtu.sections,
        notes=dtu.notes,
        archived=(dtu.GIVEN,),
        archive=lambda given: None if given is None else given.absolute(),
    ),
    "scenes": Study(
        row=scenes_trial.Transport,
        methods=scenes_trial.METHODS,
        problems=scenes.problems,
        trials=_carried,
        sections=scenes_table.sections,
        notes=scenes_table.notes,
        draw=scenes_table.draw,
        width=640,
    ),
    "shared-workspace": Study(
        row=workspace_trial.Visit,
        methods=workspace_trial.METHODS,
        problems=workspace_table.problems,
        trials=_visited,
        sections=workspace_table.sections,
        notes=workspace_table.notes,
        draw=workspace_table.draw,
        config=replace(SETTINGS, scene=replace(SETTINGS.scene, iterations_per_step=15)),  # twice the usual frames
        width=160,
    ),
}

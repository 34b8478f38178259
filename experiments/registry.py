"""The experiments of the paper that a study repeats."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from experiments import (
    ablation,
    dtu,
    scenes,
    scenes_table,
    scenes_trial,
    table2,
    trial,
    workspace_trial,
)
from experiments.problem_run import SETTINGS, Study
from experiments.problems import FAMILIES, archive_of

STUDIES: Mapping[str, Study[Any]] = {
    "ablation": Study(
        row=ablation.Measured,
        methods=tuple(ablation.OFF),
        problems=ablation.problems,
        trials=ablation.measured,
        sections=ablation.sections,
        notes=ablation.notes,
    ),
    "table2": Study(
        row=trial.Trial,
        methods=trial.METHODS,
        problems=table2.problems,
        trials=trial.trials_of,
        sections=table2.sections,
        notes=table2.notes,
        archived=FAMILIES,
        archive=archive_of,
    ),
    "dtu": Study(
        row=dtu.Fit,
        methods=dtu.METHODS,
        problems=dtu.problems,
        trials=dtu.trials_of,
        sections=dtu.sections,
        notes=dtu.notes,
        archived=(dtu.GIVEN,),
        archive=lambda given: None if given is None else given.absolute(),
    ),
    "scenes": Study(
        row=scenes_trial.Transport,
        methods=scenes_trial.METHODS,
        problems=scenes.problems,
        trials=scenes_trial.transports_of,
        sections=scenes_table.sections,
        notes=scenes_table.notes,
        draw=scenes_table.draw,
        width=640,
    ),
    "shared-workspace": Study(
        row=workspace_trial.Visit,
        methods=workspace_trial.METHODS,
        problems=workspace_trial.problems,
        trials=workspace_trial.visits_of,
        sections=workspace_trial.sections,
        notes=workspace_trial.notes,
        draw=workspace_trial.draw,
        config=replace(SETTINGS, scene=replace(SETTINGS.scene, iterations_per_step=15)),  # twice the usual frames
        width=160,
    ),
}

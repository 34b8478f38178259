"""Settings by section of the paper. Defaults are the paper's where it gives one."""

from splatctrl_cli.config.load import PRESETS, Config, check_voxel, load_config
from splatctrl_cli.config.sections import (
    ControlConfig,
    FieldConfig,
    HumanConfig,
    OccupancyConfig,
    PlannerConfig,
    SceneConfig,
    VerdictConfig,
)

__all__ = [
    "PRESETS",
    "Config",
    "ControlConfig",
    "FieldConfig",
    "HumanConfig",
    "OccupancyConfig",
    "PlannerConfig",
    "SceneConfig",
    "VerdictConfig",
    "check_voxel",
    "load_config",
]

"""Numbers of the method by section of the paper. The paper's value is the default where it gives one."""

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

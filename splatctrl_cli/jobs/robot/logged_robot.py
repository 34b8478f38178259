"""Robot of a job: from --urdf, or described by the log."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import InputError, UsageError, refuse_faults, refuse_if
from splatctrl_cli.formats.arrays import DAMAGE, read_arrays
from splatctrl_cli.formats.scene.scene_folder import SELF_MODEL
from splatctrl_cli.geometry import transform_from
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.recording.calibrated import LOGGED
from splatctrl_cli.recording.log.survey import NAME
from splatctrl_cli.recording.source import logged_descriptions
from splatctrl_cli.recording.state.state_source import StateSource
from splatctrl_cli.records import RecordSource, SphereSet
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.model_difference import model_difference
from splatctrl_cli.robot.self_model import SelfModel
from splatctrl_cli.robot.urdf import UrdfFile, read_urdf

NO_SELF_MODEL = Path("none")  # as --self-model: neither learned nor taken from the scene
GIVE_ROBOT: Mapping[str, Any] = {"remedy": "give --urdf as well", "error": UsageError}
TAKE = "leave --urdf out to take the log's own, or correct the file"


@dataclass(frozen=True, kw_only=True)
class RobotOptions:
    """Options to read a robot's URDF.

    spheres: None for `default_spheres`. packages: mesh folders. base: root pose in world, x, y, z, qx, qy, qz, qw,
    None for tf's. locked: values [rad or m] of unlogged joints.
    """

    spheres: Path | None = None
    packages: tuple[Path, ...] = ()
    base: tuple[float, ...] | None = None
    locked: Mapping[str, float] = field(default_factory=dict)

    def posed(self, urdf: UrdfFile, otherwise: SphereSet | None = None) -> RobotModel:
        """Robot of a URDF, with the given spheres, else `otherwise`. Raises InputError."""
        spheres = otherwise if self.spheres is None else self.spheres
        return RobotModel.from_urdf(
            urdf,
            spheres,
            T_world_base=None if self.base is None else transform_from(self.base[:3], self.base[3:]),
            locked=self.locked,
            packages=self.packages,
        )

    def refuse_without_robot(self) -> None:
        """Raise UsageError for a robot option without a robot."""
        for name, option in (("spheres", "spheres"), ("base", "base"), ("locked", "lock"), ("packages", "packages")):
            refuse_if(getattr(self, name), f"--{option}: needs the robot", **GIVE_ROBOT)


def logged_urdf(paths: Sequence[Path]) -> UrdfFile | None:
    """Robot described by logs, or None. Raises InputError for several robots or an invalid one."""
    robots = logged_descriptions(paths)
    refuse_if(
        len(robots) > 1,
        f"{paths[0] if paths else ''}: {len(robots)} robots, of {', '.join(where for _, where, _ in robots)}",
        remedy="give one of them with --urdf",
    )
    return _urdf(*robots[0]) if robots else None


def installed_urdf(name: str) -> Path:
    """File NAME.urdf of an installed Python package; downloads nothing.

    Raises UsageError for none or several.
    """
    files = [file for package in distributions() for file in package.files or () if file.suffix == ".urdf"]
    matches = sorted({Path(str(file.locate())).resolve() for file in files if file.stem == name})
    if len(matches) == 1:
        return matches[0]
    known = ", ".join(sorted({file.stem for file in files}))
    remedy = f"give one of: {known}" if known else "pip install example-robot-data, or give --urdf FILE"
    raise UsageError(
        f"--robot {name}: expected one installed URDF of that name, got {len(matches) or 'none'}",
        remedy=f"give one with --urdf: {', '.join(map(str, matches))}" if matches else remedy,
    )


def urdf_of(urdf: Path | None, paths: Sequence[Path], progress: Progress = SILENT) -> UrdfFile | None:
    """Robot of --urdf, else of the logs, with a warning if they differ.

    Raises InputError.
    """
    if urdf is None:
        return logged_urdf(paths)
    file = read_urdf(urdf)
    if words := differs(file, paths):
        progress.log(f"warning: {words}; {TAKE}")
    return file


def add_self_model(model: RobotModel, file: Path | None, scene: Path | None = None) -> RobotModel:
    """Add a self-model (`robot learn`): the given file, else the scene's if of this robot.

    `NO_SELF_MODEL` adds nothing. Raises InputError for an unreadable file, or a given file of another robot.
    """
    path = scene / SELF_MODEL if file is None and scene is not None else file
    if path is None or path == NO_SELF_MODEL or (file is None and not path.is_file()):
        return model
    faults, remedy = (*DAMAGE, OSError, TypeError, AttributeError), "write it with: splatctrl robot learn"
    with refuse_faults(f"{path}: not a self-model", *faults, remedy=remedy):
        self_model = SelfModel.from_arrays(read_arrays(path, most=2**30))  # bytes
    try:
        self_model.check_robot(model.surface, model.urdf.links, path)
    except InputError:
        if file is None:  # a replay reports a scene of another robot
            return model
        raise
    return model.join_self_model(self_model)


def other_frame(file: UrdfFile, source: RecordSource | StateSource) -> str:
    """Sentence if a log does not say where the robot's root is, else empty."""
    if not isinstance(source, LOGGED) or source.world_frame == file.root or file.root in source.tf_frames:
        return ""
    return f"the poses are in the frame '{source.world_frame}', and tf has no frame of its root '{file.root}'"


def differs(file: UrdfFile, paths: Sequence[Path]) -> str:
    """Difference of a model from every logged robot; empty if one agrees."""
    words = []
    for path, where, text in logged_descriptions(paths):
        try:
            words.append(model_difference(file, _urdf(path, where, text)))
        except (InputError, ValueError, RuntimeError) as error:
            words.append(f"{path}: its {NAME} cannot be read: {error}")
    return words[0] if words and all(words) else ""


def _urdf(path: Path, where: str, text: str) -> UrdfFile:
    return read_urdf(path / where.strip("/"), text)

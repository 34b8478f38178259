"""Which robot a job works with: that of --urdf, else the one that the log describes itself."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.arrays import DAMAGE, read_arrays
from splatctrl_cli.formats.scene.scene_folder import SELF_MODEL
from splatctrl_cli.jobs.running.progress import SILENT, Progress
from splatctrl_cli.recording.calibrated import LOGGED
from splatctrl_cli.recording.log.survey import NAME, RobotDescription
from splatctrl_cli.recording.source import logged_descriptions
from splatctrl_cli.recording.state.state_source import StateSource
from splatctrl_cli.records import RecordSource
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.model_difference import model_difference
from splatctrl_cli.robot.self_model import SelfModel
from splatctrl_cli.robot.urdf import UrdfFile, read_urdf

NO_SELF_MODEL = Path("none")  # as --self-model: neither learned nor taken from the scene
LARGEST_SELF_MODEL = 2**30  # bytes
TAKE = "leave --urdf out to take the log's own, or correct the file"


@dataclass(frozen=True, kw_only=True)
class RobotOptions:
    """How a robot's URDF is read.

    spheres: that cover it, None for those of the URDF; packages: folders of its meshes; base: pose of its root in
    world, x, y, z, qx, qy, qz, qw; locked: values [rad or m] of joints that no log moves.
    """

    spheres: Path | None = None
    packages: tuple[Path, ...] = ()
    base: tuple[float, ...] | None = None
    locked: Mapping[str, float] = field(default_factory=dict)


def logged_urdf(paths: Sequence[Path]) -> UrdfFile | None:
    """The robot that logs describe, None where none does. Raises InputError where they describe several, or none that
    is a URDF.
    """
    found = logged_descriptions(paths)
    if len(found) > 1:
        where = ", ".join(description.where for _, description in found)
        raise InputError(f"{paths[0]}: {len(found)} robots, of {where}", remedy="give one of them with --urdf")
    return _urdf(*found[0]) if found else None


def urdf_of(given: Path | None, paths: Sequence[Path], progress: Progress = SILENT) -> UrdfFile | None:
    """The robot of --urdf, with a warning where the logs describe another one; without it the one that they describe,
    None where they describe none. Raises InputError.
    """
    if given is None:
        return logged_urdf(paths)
    file = read_urdf(given)
    if words := differs(file, paths):
        progress.log(f"warning: {words}; {TAKE}")
    return file


def with_self_model(model: RobotModel, given: Path | None, scene: Path | None = None) -> RobotModel:
    """The robot with the parts that a self-model (`robot learn`) adds to its surface: the file given, else that of a
    scene folder where it has one of this robot; unchanged without a file, or `NO_SELF_MODEL`.

    Raises InputError for a file that cannot be read, or one given that belongs to another robot.
    """
    path = scene / SELF_MODEL if given is None and scene is not None else given
    if path is None or path == NO_SELF_MODEL or (given is None and not path.is_file()):
        return model
    try:
        found = SelfModel.from_arrays(read_arrays(path, most=LARGEST_SELF_MODEL))
    except (*DAMAGE, OSError, TypeError, AttributeError) as error:
        raise InputError(
            f"{path}: not a self-model: {error}", remedy="write it with: splatctrl robot learn"
        ) from None
    try:
        found.check_robot(model.surface, model.urdf.links, path)
    except InputError:
        if given is None:  # that the scene is of another robot is what a replay says
            return model
        raise
    return model.with_self_model(found)


def other_frame(file: UrdfFile, source: RecordSource | StateSource) -> str:
    """In words, that the poses of a log or capture are in another frame than the robot's root; empty where not."""
    if not isinstance(source, LOGGED) or source.world_frame == file.root:
        return ""
    return f"the poses are in the frame '{source.world_frame}', not in that of its root '{file.root}'"


def differs(file: UrdfFile, paths: Sequence[Path]) -> str:
    """How a model differs from all that the logs describe, in words; empty where it does not, or there is none."""
    words = []
    for path, description in logged_descriptions(paths):
        try:
            words.append(model_difference(file, _urdf(path, description)))
        except (InputError, ValueError, RuntimeError) as error:
            words.append(f"{path}: its {NAME} cannot be read: {error}")
    return words[0] if words and all(words) else ""


def _urdf(path: Path, description: RobotDescription) -> UrdfFile:
    return read_urdf(path / description.where.strip("/"), description.text)

"""Small valid inputs of every kind the tool reads, and the commands that read them, for `benchmarks.fuzz`."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin

from benchmarks.fuzz_folders import Commands, layout_folders, scans, scene_folder
from splatctrl_cli.formats.grid.grid_formats import write_grid
from splatctrl_cli.formats.splat.splats import FORMATS
from splatctrl_cli.recording.capture.capture_writer import write_capture
from splatctrl_cli.recording.container.log_formats import open_raw_log
from splatctrl_cli.recording.container.raw_log import Damage
from splatctrl_cli.recording.source import open_source
from tests.formats.grid.make_grid import random_grid
from tests.formats.splat.test_gaussian_ply import gaussian_set
from tests.recording.container.test_log_formats import as_ros1_bag, as_ros2_folder
from tests.recording.log.make_log import LogRecipe, make_log

ROBOT = Path(__file__).parent.parent / "sample_data" / "tabletop"


@dataclass(frozen=True, kw_only=True)
class Sample:
    """One input: the file or folder to give, the files in it that may be mutated, and commands.

    A command's arguments hold IN for the input and OUT for an output that does not exist.
    """

    name: str
    path: Path
    files: tuple[Path, ...]
    commands: Commands


def make_samples(folder: Path, commands: tuple[str, ...]) -> list[Sample]:
    """All samples below `folder`, with those of the tool's `commands` that read them."""
    log = make_log(folder / "log.mcap", LogRecipe(num_frames=4))
    of_log: list[tuple[str, ...]] = [("info", "IN"), ("ingest", "IN", "-o", "OUT.capture"), ("states", "IN")]
    if "check" in commands:
        of_log.append(("check", "IN"))
    as_log = tuple(of_log)
    made = [
        _file("mcap", log, as_log),
        _file("mcap-plain", plain_log(log, folder / "plain.mcap"), as_log),
        _file("bag", as_ros1_bag(log, folder / "log.bag"), as_log),
        _folder("db3", as_ros2_folder(log, folder / "bag", StoragePlugin.SQLITE3), as_log),
        _folder("capture", capture_of(log, folder / "c.capture"), as_log),
        _images(folder / "images", as_log),
        _table(folder / "table"),
    ]
    made += [_folder(name, *found) for name, found in layout_folders(folder / "layouts").items()]
    scene, of_scene = scene_folder(folder / "scene")
    made.append(_folder("scene", scene, of_scene))
    made += [_folder(name, *found) for name, found in scans(folder, scene).items()]
    splats = (("info", "IN"), ("export", "IN", "-o", "OUT.ply"))
    made += [_file(p.suffix[1:], p, splats) for p in _splats(folder)]
    made += [_file(p.suffix[1:], p, (("info", "IN"),)) for p in _grids(folder / "field")]
    urdf = folder / "robot.urdf"
    urdf.write_bytes((ROBOT / "robot.urdf").read_bytes())
    made.append(_file("urdf", urdf, (("info", "IN"), ("robot", "info", "--urdf", "IN"))))
    spheres = folder / "spheres.yaml"
    spheres.write_bytes((ROBOT / "robot_spheres.yaml").read_bytes())
    robot = ("robot", "info", "--urdf", str(ROBOT / "robot.urdf"), "--spheres", "IN")
    made.append(_file("spheres", spheres, (("info", "IN"), robot)))
    return made


def _file(name: str, path: Path, commands: Commands) -> Sample:
    return Sample(name=name, path=path, files=(path,), commands=commands)


def _folder(name: str, path: Path, commands: Commands) -> Sample:
    files = tuple(p for p in sorted(path.rglob("*")) if p.is_file())
    return Sample(name=name, path=path, files=files, commands=commands)


def plain_log(log: Path, path: Path) -> Path:
    """The log without compression and checksums, so that mutations reach the decoders."""
    with path.open("wb") as stream:
        writer = McapWriter(stream, chunk_size=4096, compression=CompressionType.NONE, enable_crcs=False)
        writer.start()
        channels: dict[str, int] = {}
        for message in open_raw_log(log).messages(Damage()):
            topic = message.topic
            if topic.name not in channels:
                schema = writer.register_schema(topic.type_name, "ros2msg", topic.definition.encode())
                channels[topic.name] = writer.register_channel(topic.name, topic.encoding, schema)
            writer.add_message(channels[topic.name], message.log_time_ns, message.data, message.log_time_ns)
        writer.finish()
    return path


def capture_of(log: Path, path: Path) -> Path:
    path.mkdir()
    write_capture(path, open_source(log))
    return path


def _images(folder: Path, commands: Commands) -> Sample:
    """An image folder with its description, and poses in a trajectory.log."""
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    lines = []
    for index in range(3):
        cv2.imwrite(str(folder / f"rgb/{index}.png"), np.full((24, 32, 3), 60 * index, np.uint8))
        cv2.imwrite(str(folder / f"depth/{index}.png"), np.full((24, 32), 1000, np.uint16))
        lines += [f"{index} {index} {index + 1}", *(" ".join(map(str, row)) for row in np.eye(4))]
    (folder / "t.log").write_text("\n".join(lines) + "\n")
    camera = "[camera]\nwidth = 32\nheight = 24\nfx = 30\nfy = 30\ncx = 15.5\ncy = 11.5\n"
    frames = '[frames]\ncolor = "rgb/*.png"\ndepth = "depth/*.png"\n[depth]\nscale = 1e-3\n'
    toml = folder / "folder.toml"
    toml.write_text(f'root = "."\n{camera}{frames}[poses]\nformat = "trajectory-log"\nfile = "t.log"\n')
    files = tuple(p for p in sorted(folder.rglob("*")) if p.is_file())
    return Sample(name="images", path=toml, files=files, commands=commands)


def _table(folder: Path) -> Sample:
    """Joint states as a CSV that a TOML describes."""
    folder.mkdir()
    rows = [f"{0.01 * i:.3f},{0.1 * i:.3f},{-0.1 * i:.3f}" for i in range(30)]
    (folder / "run.csv").write_text("t,a,b\n" + "\n".join(rows) + "\n")
    toml = folder / "run.toml"
    toml.write_text('[states]\nfile = "run.csv"\njoints = ["a", "b"]\ntime = "t"\nposition = ["a", "b"]\n')
    return Sample(name="table", path=toml, files=(toml, folder / "run.csv"), commands=(("states", "IN"),))


def _splats(folder: Path) -> list[Path]:
    paths = [folder / f"splats{suffix}" for suffix in FORMATS if not suffix.startswith(".usd")]
    for path in paths:
        FORMATS[path.suffix].write(path, gaussian_set(20), {})
    return paths


def _grids(folder: Path) -> list[Path]:
    folder.mkdir()
    files = write_grid(folder, random_grid("sdf", "gradient"), ["npz", "vti", "nrrd"])
    return list({file.suffix: file for file in files if file.suffix != ".json"}.values())

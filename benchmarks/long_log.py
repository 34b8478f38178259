"""`python -m benchmarks.long_log FOLDER SECONDS`: a moving arm logged at 1 kHz, and the cost of its replay."""

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.lib.format import write_array_header_1_0
from rosbags.typesys import Stores, get_typestore

from benchmarks.measure import ROBOT, Limit, Options, Result, measured
from benchmarks.scenes import sample_fitter, sample_robot
from splatctrl_cli.config import Config
from splatctrl_cli.field.clusters import field_splats
from splatctrl_cli.field.slabs import bake
from splatctrl_cli.formats.grid.npz_grid import write_npz
from splatctrl_cli.records import Float64

RATE = 1000  # states per second
FORMS = ("npz", "csv", "mcap")
BLOCK = 10_000  # states at once
START_NS = 1_700_000_000_000_000_000
MIDDLE = np.array([-0.2, 0.2, 0.0, -1.9, 0.0, 2.1, 0.8])  # [rad]
SWING = np.array([0.6, 0.15, 0.2, 0.2, 0.3, 0.2, 0.5])  # [rad]
PACE = np.array([0.31, 0.47, 0.23, 0.53, 0.29, 0.41, 0.37])  # [rad/s]
NAMES = tuple(f"joint{number}" for number in range(1, 8))


def blocks(num: int) -> Iterator[tuple[Float64, Float64, Float64]]:
    """Times (T,) [s], positions and velocities (T, 7) of `num` states, BLOCK at a time."""
    for first in range(0, num, BLOCK):
        t = np.arange(first, min(first + BLOCK, num)) / RATE
        phase = t[:, None] * PACE
        yield t, MIDDLE + SWING * np.sin(phase), SWING * PACE * np.cos(phase)


def write_log(folder: Path, seconds: float, form: str = "npz", *, with_velocity: bool = True) -> Path:
    """A log of the sample arm that swings above the table; returns the path for `splatctrl replay`.

    npz: a table with its .toml; csv: libfranka's columns; mcap: JointState messages.
    """
    num = max(round(seconds * RATE), 1)
    write = {"npz": _write_npz, "csv": _write_csv, "mcap": _write_mcap}[form]
    return write(folder / f"long_{num}.{form}", num, with_velocity)


def replay_command(log: Path, scene: Sequence[str], out: Path, *more: str) -> list[str]:
    """The command that replays a log of `write_log`; scene: --field or --scene with its path."""
    call = [sys.executable, "-m", "splatctrl_cli", "replay", str(log), *ROBOT, *scene]
    return [*call, "-o", str(out), "--force", "-q", "--max-unknown", "1", *more]


def run(options: Options) -> Result:
    """Audit a 1 kHz log with a baked grid in a process: states per second, and memory per state."""
    lengths = (10.0, 60.0) if options.is_quick else (20.0, 120.0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        field = _baked(folder / "field.npz")
        spent = []
        for seconds in lengths:
            log = write_log(folder, seconds)
            spent.append(measured(replay_command(log, ("--field", str(field)), folder / "out")))
    num = round(RATE * (lengths[1] - lengths[0]))
    rate = num / (spent[1].seconds - spent[0].seconds)
    slope = 1e6 * (spent[1].mebibytes - spent[0].mebibytes) / num
    return Result(
        title="long log: replay --mode audit of a log at 1 kHz",
        columns=("log [s]", "time [s]", "largest memory [MB]"),
        rows=[[f"{s:g}", f"{of.seconds:.1f}", f"{of.mebibytes:.0f}"] for s, of in zip(lengths, spent, strict=True)],
        figures={"states_per_s": rate, "mb_per_million_states": slope},
        limits=[
            Limit(figure="states_per_s", bound=5_000.0, is_least=True),
            Limit(figure="mb_per_million_states", bound=300.0),
        ],
    )


def _baked(file: Path) -> Path:
    """The sample log's map, baked over the arm's reach."""
    model, fitter = sample_robot(), sample_fitter()
    splats, occupancy = field_splats(fitter.splats()), fitter.occupancy.grid()
    write_npz(file, bake(splats, model.reach_box, Config().field, occupancy=occupancy))
    return file


def _write_npz(path: Path, num: int, with_velocity: bool) -> Path:
    import zipfile

    members = {"t": 0, "q": 1, **({"dq": 2} if with_velocity else {})}
    with zipfile.ZipFile(path, "w") as archive:
        for name, part in members.items():
            shape = (num,) if part == 0 else (num, len(NAMES))
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                write_array_header_1_0(stream, {"descr": "<f8", "fortran_order": False, "shape": shape})
                for block in blocks(num):
                    stream.write(np.ascontiguousarray(block[part]).tobytes())
    table = [f'file = "{path.name}"', f"joints = {list(NAMES)}", 'time = "t"', 'position = ["q"]']
    table += ['velocity = ["dq"]'] if with_velocity else []
    described = path.with_suffix(".toml")
    described.write_text("\n".join(["[states]", *table]) + "\n", encoding="utf-8")
    return described


def _write_csv(path: Path, num: int, with_velocity: bool) -> Path:
    columns = ["time", *(f"state.q[{i}]" for i in range(7)), *(f"state.dq[{i}]" for i in range(7) if with_velocity)]
    with path.open("w", encoding="utf-8") as stream:
        stream.write(",".join(columns) + "\n")
        for t, q, dq in blocks(num):
            table = np.column_stack([np.round(t * 1000), q, *([dq] if with_velocity else [])])
            np.savetxt(stream, table, fmt=["%d", *["%.9g"] * (table.shape[1] - 1)], delimiter=",")
    return path


def _write_mcap(path: Path, num: int, with_velocity: bool) -> Path:
    store: Any = get_typestore(Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/JointState"
    header, stamp = store.types["std_msgs/msg/Header"], store.types["builtin_interfaces/msg/Time"]
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="benchmarks")
        text, _ = store.generate_msgdef(kind, ros_version=2)
        schema = writer.register_schema(name=kind, encoding="ros2msg", data=text.encode())
        channel = writer.register_channel(topic="/joint_states", message_encoding="cdr", schema_id=schema)
        for t, q, dq in blocks(num):
            for index in range(len(t)):
                at_ns = START_NS + round(t[index] * 1e9)
                when = stamp(sec=at_ns // 10**9, nanosec=at_ns % 10**9)
                velocity = dq[index] if with_velocity else np.zeros(0)
                content = store.types[kind](
                    header=header(stamp=when, frame_id=""),
                    name=list(NAMES),
                    position=q[index],
                    velocity=velocity,
                    effort=np.zeros(0),
                )
                data = bytes(store.serialize_cdr(content, kind))
                writer.add_message(channel, log_time=at_ns, publish_time=at_ns, data=data)
        writer.finish()
    return path


def main(argv: Sequence[str] | None = None) -> int:
    """Write the log, replay it, and print time, states per second and memory."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.long_log", description=__doc__, allow_abbrev=False)
    parser.add_argument("folder", type=Path)
    parser.add_argument("seconds", type=float)
    parser.add_argument("--form", choices=FORMS, default="npz")
    parser.add_argument("--without-velocity", action="store_true")
    parser.add_argument("--field", type=Path, help="a baked field; without it the log is written and no more")
    parser.add_argument("--mode", default="audit")
    args, more = parser.parse_known_args(argv)
    log = write_log(args.folder, args.seconds, args.form, with_velocity=not args.without_velocity)
    if args.field is None:
        print(log)
        return 0
    command = replay_command(log, ("--field", str(args.field)), args.folder / "out", "--mode", args.mode, *more)
    spent, num = measured(command), round(args.seconds * RATE)
    print(
        f"{args.form} {args.mode}: {num} states in {spent.seconds:.1f} s ({num / spent.seconds:.0f} states/s), "
        f"processor {spent.processor_s:.1f} s ({num / spent.processor_s:.0f} states/s), {spent.mebibytes:.0f} MB, "
        f"exit {spent.code}"
    )
    return spent.code


if __name__ == "__main__":
    raise SystemExit(main())

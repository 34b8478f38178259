"""Colour and depth pairs from a log into a capture folder and back, compared with decoding only."""

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from mcap.writer import CompressionType, Writer
from rosbags.typesys import Stores, get_typestore

from benchmarks.measure import SAMPLE, Limit, Options, Result, measured, medians
from benchmarks.scenes import enlarged
from splatctrl_cli.recording.capture.capture_writer import write_capture
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import RgbdFrame

NUM_IMAGES = 12  # that differ; a log repeats them
PERIOD_NS = 33_333_333
START_NS = 1_700_000_000_000_000_000
JOINT_NAMES = ["joint1", "joint2"]
JOINTS_PER_FRAME = 3
NOISE_M = 0.002  # of the depth, as a sensor has it: a smooth image would be too easily compressed


def run(options: Options) -> Result:
    """Pairs per second by task, for logs of 640x480 pairs with JPEG and 16-bit PNG, or raw depth."""
    num = 60 if options.is_quick else 300
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        files, raw = write_log(folder / "files.mcap", num), write_log(folder / "raw.mcap", num, has_raw_depth=True)
        images = [data for pair in islice(_pairs(), NUM_IMAGES) for data in pair[:2]]
        capture = folder / "read.capture"
        write_capture(capture, open_source(files))
        tasks: dict[str, Callable[[], object]] = {
            "kept": partial(_ingest, files, folder),
            "encoded": partial(_ingest, raw, folder),
            "decoded": partial(_read, files),
            "capture": partial(_read, capture),
            "decoding": partial(_decode, images, num),
        }
        times = medians(tasks, options.rounds(5), clock=time.process_time)
        peaks = [_peak(write_log(folder / "log.mcap", length), folder / "out") for length in (num, 4 * num)]
    ms = {name: 1e3 * value / num for name, value in times.items()}
    rows = [
        ["ingest: JPEG and PNG kept as they are", "kept"],
        ["ingest: JPEG kept, raw depth written as PNG", "encoded"],
        ["records of the log, JPEG and PNG decoded", "decoded"],
        ["records of the capture, sha256 compared", "capture"],
        ["decoding alone (OpenCV)", "decoding"],
    ]
    return Result(
        title=f"ingest: pairs of 640x480 opening included ({num} pairs), processor time",
        columns=("what", "ms a pair", "pairs/s"),
        rows=[[text, f"{ms[name]:.2f}", f"{1e3 / ms[name]:.0f}"] for text, name in rows],
        figures={f"{name}_ms_per_pair": value for name, value in ms.items()}
        | {
            "kept_pairs_per_s": 1e3 / ms["kept"],
            "decoded_over_decoding": ms["decoded"] / ms["decoding"],
            "ingest_peak_mb": max(peaks),
        },
        ratios={
            "kept_against_decoding": ms["decoding"] / ms["kept"],
            "decoded_against_decoding": ms["decoding"] / ms["decoded"],
            "capture_against_decoding": ms["decoding"] / ms["capture"],
        },
        limits=[
            Limit(figure="kept_pairs_per_s", bound=400, is_least=True),
            Limit(figure="decoded_over_decoding", bound=1.3),
            Limit(figure="ingest_peak_mb", bound=400),
        ],
        notes=[f"peak of `splatctrl ingest`: {peaks[0]:.0f} MB of {num} pairs, {peaks[1]:.0f} MB of {4 * num}"],
    )


def write_log(path: Path, num: int, *, has_raw_depth: bool = False) -> Path:
    """Write an uncompressed ROS 2 MCAP with `num` pairs of one stationary camera, and joint states."""
    store: Any = get_typestore(Stores.ROS2_HUMBLE)
    types = store.types
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE, chunk_size=4 << 20)
        writer.start(profile="ros2", library="benchmarks")
        channels: dict[str, int] = {}

        def add(topic: str, kind: str, stamp_ns: int, **fields: Any) -> None:
            if topic not in channels:
                schema = writer.register_schema(
                    kind, "ros2msg", store.generate_msgdef(kind, ros_version=2)[0].encode()
                )
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            data = bytes(store.serialize_cdr(types[kind](**fields), kind))
            writer.add_message(channels[topic], stamp_ns, data, stamp_ns)

        def header(stamp_ns: int, frame: str = "camera") -> Any:
            time = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
            return types["std_msgs/msg/Header"](stamp=time, frame_id=frame)

        add("/tf_static", "tf2_msgs/msg/TFMessage", START_NS, transforms=[_still(types, header(START_NS, "world"))])
        for index, (jpeg, png, counts, frame) in zip(range(num), _pairs(), strict=False):
            stamp = START_NS + index * PERIOD_NS
            head = header(stamp)
            add("/camera/color/camera_info", "sensor_msgs/msg/CameraInfo", stamp, **_info(types, head, frame))
            color = np.frombuffer(jpeg, np.uint8)
            file = "sensor_msgs/msg/CompressedImage"
            add("/camera/color/image_raw/compressed", file, stamp, header=head, format="jpeg", data=color)
            if has_raw_depth:
                height, width = counts.shape
                shape = {"height": height, "width": width, "encoding": "16UC1", "is_bigendian": 0, "step": 2 * width}
                pixels = np.frombuffer(counts.tobytes(), np.uint8)
                add("/camera/depth/image_raw", "sensor_msgs/msg/Image", stamp, header=head, data=pixels, **shape)
            else:
                form, depth = "16UC1; png compressed ", np.frombuffer(png, np.uint8)
                add("/camera/depth/image_raw/compressed", file, stamp, header=head, format=form, data=depth)
            for number in range(JOINTS_PER_FRAME):
                at = stamp + number * PERIOD_NS // JOINTS_PER_FRAME
                fields = {"position": np.full(2, 1e-3 * index), "velocity": np.zeros(2), "effort": np.zeros(0)}
                add("/joint_states", "sensor_msgs/msg/JointState", at, header=header(at), name=JOINT_NAMES, **fields)
        writer.finish()
    return path


def _pairs() -> Iterator[tuple[bytes, bytes, "np.ndarray[Any, np.dtype[np.uint16]]", RgbdFrame]]:
    """Yield JPEG, PNG, depth counts [mm] and frame endlessly, from sample frames at twice their size."""
    random, found = np.random.default_rng(0), []
    frames = (item for item in open_source(SAMPLE / "log.mcap").records() if isinstance(item, RgbdFrame))
    for small in islice(frames, NUM_IMAGES):
        frame = enlarged(small)
        noisy = frame.depth + random.normal(0.0, NOISE_M, frame.depth.shape) * (frame.depth > 0)
        counts = np.clip(np.rint(1e3 * noisy), 0, 65535).astype(np.uint16)
        jpeg = cv2.imencode(".jpg", frame.color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes()
        found.append(
            (jpeg, cv2.imencode(".png", counts, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes(), counts, frame)
        )
    while True:
        yield from found


def _still(types: Any, header: Any) -> Any:
    translation = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    rotation = types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0)
    transform = types["geometry_msgs/msg/Transform"](translation=translation, rotation=rotation)
    kind = types["geometry_msgs/msg/TransformStamped"]
    return kind(header=header, child_frame_id="camera", transform=transform)


def _info(types: Any, header: Any, frame: RgbdFrame) -> dict[str, Any]:
    lens = frame.intrinsics
    roi = types["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return {
        "header": header,
        "height": lens.height,
        "width": lens.width,
        "distortion_model": "plumb_bob",
        "d": np.zeros(5),
        "k": np.array([lens.fx, 0, lens.cx, 0, lens.fy, lens.cy, 0, 0, 1]),
        "r": np.eye(3).ravel(),
        "p": np.zeros(12),
        "binning_x": 0,
        "binning_y": 0,
        "roi": roi,
    }


def _ingest(log: Path, folder: Path) -> None:
    write_capture(Path(tempfile.mkdtemp(dir=folder)), open_source(log))  # what is there goes with the folder, untimed


def _read(path: Path) -> int:
    return sum(isinstance(record, RgbdFrame) for record in open_source(path).records())


def _decode(images: list[bytes], num_pairs: int) -> None:
    for index in range(2 * num_pairs):
        cv2.imdecode(np.frombuffer(images[index % len(images)], np.uint8), cv2.IMREAD_UNCHANGED)


def _peak(log: Path, out: Path) -> float:
    """Largest resident memory [MB] of `splatctrl ingest`."""
    spent = measured([sys.executable, "-m", "splatctrl_cli", "ingest", str(log), "-o", str(out), "--force", "-q"])
    assert spent.code == 0
    return spent.mebibytes

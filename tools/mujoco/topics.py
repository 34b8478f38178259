"""A log as realsense-ros and robot_state_publisher write it: MCAP, ROS 2 sqlite or a ROS 1 bag."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tools.mujoco.cell import Lens
from tools.mujoco.images import Camera
from tools.mujoco.poses import Float64, inverse, quat_xyzw

FORMATS = {"mcap": "log", "sqlite": "log", "bag": "log.bag"}  # file or folder in the recording's
START_NS = 1_760_000_000_000_000_000
LINK_FROM_OPTICAL = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], dtype=np.float64)
TF = "tf2_msgs/msg/TFMessage"
Transform = tuple[str, str, Float64]  # parent, child, T_parent_child


class Log:
    """Writes messages; stamps are seconds since the start."""

    def __init__(self, path: Path, kind: str, stack: ExitStack) -> None:
        self._is_bag = kind == "bag"
        self._types = get_typestore(Stores.ROS1_NOETIC if self._is_bag else Stores.ROS2_HUMBLE)
        if self._is_bag:  # whose types lack that of /tf
            self._types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TF))
            writer: Any = BagWriter(path)
            writer.set_compression(BagWriter.CompressionFormat.LZ4)
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            writer = Rosbag2Writer(path, version=9, storage_plugin=plugin)
            if kind == "mcap":
                writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._writer = stack.enter_context(writer)
        self._connections: dict[str, Any] = {}

    def add_joints(self, time: float, names: Sequence[str], position: Float64, velocity: Float64) -> None:
        """sensor_msgs/JointState on /joint_states."""
        message = self._type("sensor_msgs/msg/JointState")(
            header=self._header(time, ""), name=list(names), position=np.asarray(position, np.float64),
            velocity=np.asarray(velocity, np.float64), effort=np.zeros(len(names)),
        )  # fmt: skip
        self._write("/joint_states", message, time)

    def add_transforms(self, time: float, transforms: Sequence[Transform], *, is_static: bool) -> None:
        """tf2_msgs/TFMessage on /tf_static or /tf."""
        stamped = []
        for parent, child, T in transforms:
            x, y, z, w = quat_xyzw(T)
            vector = self._type("geometry_msgs/msg/Vector3")(x=T[0, 3], y=T[1, 3], z=T[2, 3])
            turn = self._type("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)
            body = self._type("geometry_msgs/msg/Transform")(translation=vector, rotation=turn)
            stamped.append(
                self._type("geometry_msgs/msg/TransformStamped")(
                    header=self._header(time, parent), child_frame_id=child, transform=body
                )
            )
        message = self._type(TF)(transforms=stamped)
        self._write("/tf_static" if is_static else "/tf", message, time)

    def add_image(self, time: float, camera: Camera, color: NDArray[np.uint8], depth: NDArray[np.uint16]) -> None:
        """Colour as JPEG, depth aligned to it in millimetres, each with a camera_info."""
        header = self._header(time, f"{camera.name}_color_optical_frame")
        root = f"/camera/{camera.name}"
        good, jpeg = cv2.imencode(".jpg", color[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])
        assert good
        compressed = self._type("sensor_msgs/msg/CompressedImage")(
            header=header, format="rgb8; jpeg compressed bgr8", data=jpeg.ravel()
        )
        image = self._type("sensor_msgs/msg/Image")(
            header=header, height=depth.shape[0], width=depth.shape[1], encoding="16UC1", is_bigendian=0,
            step=2 * depth.shape[1], data=np.ascontiguousarray(depth).view(np.uint8).ravel(),
        )  # fmt: skip
        intrinsics = self._camera_info(header, camera.lens)
        self._write(f"{root}/color/image_raw/compressed", compressed, time)
        self._write(f"{root}/color/camera_info", intrinsics, time)
        self._write(f"{root}/aligned_depth_to_color/image_raw", image, time)
        self._write(f"{root}/aligned_depth_to_color/camera_info", intrinsics, time)

    def _camera_info(self, header: Any, lens: Lens) -> Any:
        k = lens.matrix
        p = np.column_stack([k, np.zeros(3)])
        region = self._type("sensor_msgs/msg/RegionOfInterest")(
            x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        matrices = {"d": np.zeros(5), "k": k.ravel(), "r": np.eye(3).ravel(), "p": p.ravel()}
        if self._is_bag:
            matrices = {name.upper(): value for name, value in matrices.items()}
        return self._type("sensor_msgs/msg/CameraInfo")(
            header=header, height=lens.height, width=lens.width, distortion_model="plumb_bob", binning_x=0,
            binning_y=0, roi=region, **matrices,
        )  # fmt: skip

    def _header(self, time: float, frame: str) -> Any:
        stamp = stamp_ns(time)
        moment = self._type("builtin_interfaces/msg/Time")(sec=stamp // 10**9, nanosec=stamp % 10**9)
        more = {"seq": 0} if self._is_bag else {}
        return self._type("std_msgs/msg/Header")(stamp=moment, frame_id=frame, **more)

    def _type(self, name: str) -> Any:
        return self._types.types[name]

    def _write(self, topic: str, message: Any, time: float) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._types)
        raw = (self._types.serialize_ros1 if self._is_bag else self._types.serialize_cdr)(message, kind)
        self._writer.write(self._connections[topic], stamp_ns(time), raw)


@contextmanager
def opened_log(folder: Path, kind: str) -> Iterator[Log]:
    """A log of a kind of `FORMATS` in a folder; an MCAP is left as the one file log.mcap."""
    path = folder / FORMATS[kind]
    with ExitStack() as stack:
        yield Log(path, kind, stack)
    if kind == "mcap":
        (mcap,) = path.glob("*.mcap")
        mcap.rename(folder / "log.mcap")
        (path / "metadata.yaml").unlink()
        path.rmdir()


def log_name(kind: str) -> str:
    """The log's file or folder in a recording."""
    return "log.mcap" if kind == "mcap" else FORMATS[kind]


def stamp_ns(time: float) -> int:
    """A time since the start [s] as a stamp [ns]."""
    return START_NS + round(time * 1e9)


def camera_transforms(camera: Camera, T_parent_camera: Float64, parent: str) -> list[Transform]:
    """parent -> NAME_link -> NAME_color_frame -> NAME_color_optical_frame, as realsense-ros publishes them."""
    T_parent_link = T_parent_camera @ inverse(LINK_FROM_OPTICAL)
    return [
        (parent, f"{camera.name}_link", T_parent_link),
        (f"{camera.name}_link", f"{camera.name}_color_frame", np.eye(4)),
        (f"{camera.name}_color_frame", f"{camera.name}_color_optical_frame", LINK_FROM_OPTICAL),
    ]

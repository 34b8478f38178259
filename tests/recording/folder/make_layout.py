"""Small trees laid out as public datasets are, with known poses and depth."""

import json
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import lzf
import numpy as np
import pytest

from splatctrl_cli.formats.image_file import write_pfm
from splatctrl_cli.geometry import invert_transform, look_at, quat_from_rotation
from splatctrl_cli.recording.folder.dtu import DtuView
from splatctrl_cli.recording.folder.idr import shrink_view
from splatctrl_cli.recording.folder.poses import OPENGL_FROM_OPTICAL
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64, RgbdFrame

WIDTH, HEIGHT = 8, 6
POSES = [look_at([0.5 + 0.1 * index, 0.2, 1.0], [0.0, 0.0, 0.0]) for index in range(3)]
K = (10.0, 11.0, 3.5, 2.5)


def color_of(index: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """RGB of a frame: red says which."""
    image = np.full((HEIGHT, WIDTH, 3), 20, np.uint8)
    image[..., 0] = 50 + 10 * index
    return image


def counts_of(index: int, unit: float = 1e-3) -> np.ndarray[Any, np.dtype[np.uint16]]:
    """Depth counts of a frame: its number and each pixel tell in the value; the first pixel has none."""
    metres = 1.0 + 0.1 * index + 0.01 * np.arange(WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    counts = np.round(metres / unit).astype(np.uint16)
    counts[0, 0] = 0
    return counts


def write_pair(color: Path, depth: Path, index: int, unit: float = 1e-3, invalid: int = 0) -> None:
    for path in (color, depth):
        path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(color), color_of(index)[..., ::-1])
    counts = counts_of(index, unit)
    counts[0, 0] = invalid
    cv2.imwrite(str(depth), counts)


def matrix_text(T: Float64) -> str:
    return "\n".join(" ".join(repr(float(v)) for v in row) for row in T) + "\n"


def check(frames: list[RgbdFrame], unit: float = 1e-3, k: tuple[float, ...] = K) -> None:
    """Every value of three frames in order."""
    assert len(frames) == 3
    for index, frame in enumerate(frames):
        assert np.array_equal(frame.color, color_of(index))
        assert np.array_equal(frame.depth, counts_of(index, unit).astype(np.float32) * np.float32(unit))
        assert frame.depth[0, 0] == 0
        assert frame.T_world_camera == pytest.approx(POSES[index], abs=2e-7)  # some are float32
        i = frame.intrinsics
        assert (i.fx, i.fy, i.cx, i.cy) == pytest.approx(k, rel=1e-6)  # some are fitted
        assert (i.width, i.height) == (WIDTH, HEIGHT)


def make_tum(folder: Path) -> Path:
    """Depth 5 ms after colour, poses half a period before and after, so that colour lies in their middle."""
    start = 1305031102.0
    listed: dict[str, list[str]] = {"rgb": ["# timestamp filename"], "depth": []}
    poses = []
    for index, T in enumerate(POSES):
        color, depth = f"{start + index * 0.1:.6f}", f"{start + index * 0.1 + 0.005:.6f}"
        write_pair(folder / f"rgb/{color}.png", folder / f"depth/{depth}.png", index, 1 / 5000)
        listed["rgb"].append(f"{color} rgb/{color}.png")
        listed["depth"].append(f"{depth} depth/{depth}.png")
        quat = quat_from_rotation(T[:3, :3])
        for step in (-0.05, 0.05):
            position = T[:3, 3] + step * np.array([1.0, 2.0, 0.0])
            poses.append([start + index * 0.1 + step * 0.5, *position, *quat])
    for name, lines in listed.items():
        (folder / f"{name}.txt").write_text("\n".join(lines) + "\n")
    rows = [f"{row[0]:.6f} " + " ".join(repr(float(v)) for v in row[1:]) for row in poses]
    (folder / "groundtruth.txt").write_text("# timestamp tx ty tz qx qy qz qw\n" + "\n".join(rows) + "\n")
    return folder


def make_redwood(folder: Path) -> Path:
    lines = []
    for index, T in enumerate(POSES):
        write_pair(folder / f"color/{index + 9}.png", folder / f"depth/{index + 9}.png", index)
        lines.append(f"{index} {index} {index + 1}\n{matrix_text(T)}")
    (folder / "trajectory.log").write_text("".join(lines))
    by_columns = [K[0], 0, 0, 0, K[1], 0, K[2], K[3], 1]
    text = json.dumps({"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": by_columns})
    (folder / "camera_intrinsic.json").write_text(text)
    return folder


def make_frames(folder: Path, sequence: str = "seq-01") -> Path:
    for index, T in enumerate(POSES):
        stem = folder / sequence / f"frame-{index:06d}"
        write_pair(Path(f"{stem}.color.png"), Path(f"{stem}.depth.png"), index, invalid=65535)
        Path(f"{stem}.pose.txt").write_text(matrix_text(T))
    return folder


def make_scannet(folder: Path) -> Path:
    for index, T in enumerate(POSES):
        name = 8 + index  # 8, 9, 10: by number, not by letter
        write_pair(folder / f"color/{name}.png", folder / f"depth/{name}.png", index)
        (folder / "pose").mkdir(exist_ok=True)
        (folder / f"pose/{name}.txt").write_text(matrix_text(T))
    (folder / "intrinsic").mkdir()
    return folder


def make_bop(folder: Path, with_poses: bool = True) -> Path:
    cameras = {}
    for index, T in enumerate(POSES):
        write_pair(folder / f"rgb/{index:06d}.png", folder / f"depth/{index:06d}.png", index, 1e-4)
        entry: dict[str, Any] = {"cam_K": [K[0], 0, K[2], 0, K[1], K[3], 0, 0, 1], "depth_scale": 0.1}
        if with_poses:
            inverse = invert_transform(T)
            entry |= {"cam_R_w2c": inverse[:3, :3].ravel().tolist(), "cam_t_w2c": (1e3 * inverse[:3, 3]).tolist()}
        cameras[str(index)] = entry
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    return folder


def make_nerfstudio(folder: Path, **of_second: float) -> Path:
    frames: list[dict[str, Any]] = []
    for index, T in enumerate(POSES):
        write_pair(folder / f"images/frame_{index}.png", folder / f"depths/d_{index}.png", index)
        frames.append(
            {
                "file_path": f"./images/frame_{index}.png",
                "depth_file_path": f"depths/d_{index}.png",
                "transform_matrix": (T @ OPENGL_FROM_OPTICAL).tolist(),
            }
        )
    frames[1] |= of_second
    lens = {"fl_x": K[0], "fl_y": K[1], "cx": K[2] + 0.5, "cy": K[3] + 0.5, "w": WIDTH, "h": HEIGHT}
    content = {"camera_model": "OPENCV", **lens, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def make_icl(folder: Path) -> Path:
    """Left-handed: y up in the camera and in the world; image 0 has no pose."""
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    lines = []
    for index, T in enumerate(POSES):
        write_pair(folder / f"rgb/{index + 9}.png", folder / f"depth/{index + 9}.png", index, 1 / 5000)
        left = mirror @ T @ mirror
        row = [*left[:3, 3], *quat_from_rotation(left[:3, :3])]
        lines.append(f"{index + 9} " + " ".join(repr(float(v)) for v in row) + "\n")
    write_pair(folder / "rgb/0.png", folder / "depth/0.png", 0, 1 / 5000)
    (folder / "livingRoom2.gt.freiburg").write_text("".join(lines))
    (folder / "associations.txt").write_text("0 depth/0.png 0 rgb/0.png\n")
    return folder


def make_replica(folder: Path, *, is_slam: bool = True) -> Path:
    """As NICE-SLAM has it, or Semantic-NeRF."""
    of_slam, of_nerf = ("results/frame{}.png", "results/depth{}.png"), ("rgb/rgb_{}.png", "depth/depth_{}.png")
    for index in range(3):  # 8, 9, 10: by number, not by letter
        names = (form.format(f"{index + 8:0{6 if is_slam else 1}d}") for form in (of_slam if is_slam else of_nerf))
        write_pair(*(folder / name for name in names), index, 1 / 6553.5 if is_slam else 1e-3)
    text = "".join(matrix_text(T).replace("\n", " ") + "\n" for T in [np.eye(4)] * 8 + POSES)
    (folder / ("traj.txt" if is_slam else "traj_w_c.txt")).write_text(text)
    return folder


def make_sun3d(folder: Path) -> Path:
    """Depth 2 ms after colour, its bits rotated; an older trajectory beside the one that counts."""
    rows = []
    for index, T in enumerate(POSES):
        time = 33_000 * index
        color, depth = (
            folder / f"image/{index + 1:07d}-{time:012d}.png",
            folder / f"depth/{index:07d}-{time + 2000:012d}.png",
        )
        write_pair(color, depth, index)
        counts = counts_of(index)
        cv2.imwrite(str(depth), (counts << 3) | (counts >> 13))
        rows += [" ".join(repr(float(v)) for v in row) for row in T[:3]]
    (folder / "extrinsics").mkdir()
    (folder / "extrinsics/20140101000000.txt").write_text("\n".join(rows[3:] + rows[:3]))
    (folder / "extrinsics/20150101000000.txt").write_text("\n".join(rows))
    (folder / "intrinsics.txt").write_text(f"{K[0]} 0 {K[2] + 1}\n0 {K[1]} {K[3] + 1}\n0 0 1\n")
    return folder


def make_arkit(folder: Path) -> Path:
    """The lens' file is named a millisecond off, poses lie half a period to either side."""
    root = folder / "41069021_frames"
    (root / "lowres_wide_intrinsics").mkdir(parents=True)
    lines = []
    for index, T in enumerate(POSES):
        stamp = 305.367 + 0.1 * index
        name = f"41069021_{stamp:.3f}.png"
        write_pair(root / "lowres_wide" / name, root / "lowres_depth" / name, index)
        lens = f"{WIDTH} {HEIGHT} {K[0]} {K[1]} {K[2]} {K[3]}"
        (root / f"lowres_wide_intrinsics/41069021_{stamp + 0.001:.3f}.pincam").write_text(lens)
        for step in (-0.05, 0.05):
            moved = T.copy()
            moved[:3, 3] += step * np.array([1.0, 2.0, 0.0])
            inverse = invert_transform(moved)
            row = [*cv2.Rodrigues(inverse[:3, :3])[0].ravel(), *inverse[:3, 3]]
            lines.append(f"{stamp + step * 0.5:.6f} " + " ".join(repr(float(v)) for v in row) + "\n")
    (root / "lowres_wide.traj").write_text("".join(lines))
    return folder


def make_mvsnet(
    folder: Path, unit: float = 1.0, tail: str = "0.5 0.01 192 2.5", images: str = "images", depth: str = "depths"
) -> Path:
    """Lengths in units of so many metres; depth of another name than its image, as networks write it."""
    (folder / "cams").mkdir(parents=True)
    (folder / depth).mkdir(exist_ok=True)
    for index, T in enumerate(POSES):
        write_pair(folder / images / f"{index:08d}.png", folder / "unused.png", index)
        (folder / "unused.png").unlink()
        counts = counts_of(index).astype(np.float32)
        write_pfm(folder / depth / f"{index:08d}_init.pfm", counts * np.float32(1e-3 / unit))
        write_pfm(folder / depth / f"{index:08d}_prob.pfm", np.ones_like(counts))
        T_camera_world = invert_transform(T)
        T_camera_world[:3, 3] /= unit
        K3 = matrix_text(np.array([[K[0], 0, K[2]], [0, K[1], K[3]], [0, 0, 1]]))
        text = f"extrinsic\n{matrix_text(T_camera_world)}\nintrinsic\n{K3}\n{tail}\n"
        (folder / f"cams/{index:08d}_cam.txt").write_text(text)
    (folder / "pair.txt").write_text("3\n0\n2 1 9.5 2 3.5\n1\n2 0 9.5 2 9.5\n2\n2 1 9.5 0 3.5\n")
    return folder


def make_sens(folder: Path, *, form: str = ".png", is_packed: bool = True, num_cut: int = 0) -> Path:
    """A sensor file in its folder, by SensReader's structures; the file is without its last `num_cut` bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    k = np.eye(4, dtype="<f4")
    k[0, 0], k[1, 1], k[0, 2], k[1, 2] = K
    one = np.eye(4, dtype="<f4")
    matrices = b"".join(matrix.tobytes() for matrix in (k, one, k, one))
    sizes = struct.pack(
        "<2i4IfQ", {".png": 1, ".jpg": 2}[form], int(is_packed), WIDTH, HEIGHT, WIDTH, HEIGHT, 1000, 3
    )
    data = struct.pack("<IQ", 4, 15) + b"StructureSensor" + matrices + sizes
    for index, T in enumerate(POSES):
        color = cv2.imencode(form, color_of(index)[..., ::-1])[1].tobytes()
        words = counts_of(index).astype("<u2").tobytes()
        depth = zlib.compress(words) if is_packed else words
        stamp = 1_000_000 + 33_333 * index
        data += (
            T.astype("<f4").tobytes() + struct.pack("<4Q", stamp, stamp + 5, len(color), len(depth)) + color + depth
        )
    (folder / "scene0000_00.sens").write_bytes((data + struct.pack("<Q", 0))[: -num_cut or None])
    return folder


def cloud_of(index: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Points (H, W, 3) of a frame in its camera, NaN where there are none."""
    z = counts_of(index).astype(np.float32) * np.float32(1e-3)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    points = np.stack([(u - K[2]) / K[0] * z, (v - K[3]) / K[1] * z, z], axis=-1).astype(np.float32)
    points[z == 0] = np.nan
    return points


def pcd_bytes(
    points: np.ndarray[Any, np.dtype[np.float32]], color: Any, pose: Float64, form: str = "binary", *, kind: str = "F"
) -> bytes:
    """A cloud as PCL's PCDWriter has it: a label behind the colour, one field after the other where it is packed; as
    text the colour is a whole number, whatever its type (pcd_io.cpp).
    """
    height, width = points.shape[:2]
    packed = (color.astype(np.uint32) << np.array([16, 8, 0], np.uint32)).sum(axis=2, dtype=np.uint32).ravel()
    columns = [*points.reshape(-1, 3).T, packed, np.arange(height * width, dtype=np.uint32)]
    kind = "U" if form == "ascii" else kind
    x, y, z, w = quat_from_rotation(pose[:3, :3])
    viewpoint = " ".join(repr(float(value)) for value in (*pose[:3, 3], w, x, y, z))
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z rgb label\nSIZE 4 4 4 4 4\n"
        f"TYPE F F F {kind} U\nCOUNT 1 1 1 1 1\nWIDTH {width}\nHEIGHT {height}\nVIEWPOINT {viewpoint}\n"
        f"POINTS {height * width}\nDATA {form}\n"
    ).encode()
    if form == "ascii":
        rows = (" ".join(str(value) for value in row) for row in zip(*columns, strict=True))
        return head + "\n".join(rows).encode() + b"\n"
    if form == "binary":
        return head + np.rec.fromarrays(columns).tobytes()
    whole = b"".join(column.tobytes() for column in columns)
    small = lzf.compress(whole)
    return head + struct.pack("<II", len(small), len(whole)) + small


def make_pcd(folder: Path, form: str = "binary", kind: str = "F") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for index, T in enumerate(POSES):
        (folder / f"cloud_{index + 8}.pcd").write_bytes(
            pcd_bytes(cloud_of(index), color_of(index), T, form, kind=kind)
        )
    return folder


GIVEN = SourceOptions(intrinsics={"camera": K})


@dataclass(frozen=True, kw_only=True)
class Example:
    """A tree of a layout whose values `check` knows: how it is made and opened, metres a count, first stamp, step."""

    make: Callable[[Path], Path]
    options: SourceOptions | None = None
    unit: float = 1e-3
    stamps_ns: tuple[int, int] | None = None


EXAMPLES = {  # by the layout's name
    "TUM RGB-D": Example(
        make=make_tum, options=GIVEN, unit=1 / 5000, stamps_ns=(1_305_031_102_000_000_000, 100_000_000)
    ),
    "BOP scene": Example(make=make_bop, unit=1e-4),
    "7-Scenes": Example(make=make_frames, options=GIVEN),
    "nerfstudio": Example(make=make_nerfstudio),
    "ARKitScenes": Example(make=make_arkit, stamps_ns=(305_367_000_000, 100_000_000)),
    "SUN3D": Example(make=make_sun3d, stamps_ns=(0, 33_000_000)),
    "MVSNet scene": Example(make=make_mvsnet),
    "ScanNet sensor file": Example(make=make_sens, stamps_ns=(1_000_000_000, 33_333_000)),
    "PCD clouds": Example(make=make_pcd),
    "Open3D scene": Example(make=make_redwood),
}


def half_size(view: DtuView) -> DtuView:
    """The view at half the size, with the middle as its mask, for speed."""
    k = view.intrinsics
    mask = np.zeros((k.height // 2, k.width // 2), np.bool_)
    mask[20:-20, 30:-30] = True
    return replace(shrink_view(view, 2), mask=mask)


def changed_json(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """The file with its tree changed."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))

"""Pictures and videos of a scene, from a recorded camera or along a path."""

import csv
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from splatctrl_cli.calibration.displacement import correct_pose
from splatctrl_cli.config.ranges import checked_pose
from splatctrl_cli.errors import UsageError, refuse_faults, refuse_if, require
from splatctrl_cli.evaluate.verdict import Result
from splatctrl_cli.files.output import Stopwatch, output_path, write_run
from splatctrl_cli.formats.scene.scene_folder import SceneFolder, open_scene
from splatctrl_cli.geometry import interpolate_transform, transform_from
from splatctrl_cli.jobs.reconstruct.correct_views import corrected
from splatctrl_cli.jobs.score.views import render_with_shell, splats_and_shell
from splatctrl_cli.libraries import import_extra
from splatctrl_cli.recording.log.stored_frame import FrameSource, StoredFrame
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import Float32, Float64, Intrinsics, RgbdFrame, UInt8

PNG, MP4 = ".png", ".mp4"
POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")  # [m], of T_world_camera


@dataclass(frozen=True, kw_only=True)
class RenderSceneRequest:
    """Picture (``.png``), video (``.mp4``) or folder of pictures `out` of the folder `scene`.

    camera: a training camera, None for the first. It stays at its first frame's pose, or moves as in the recording
    `reference`, or along `path`. path: a CSV or JSON file of rows time_s, x, y, z, qx, qy, qz, qw, the optical
    frame's pose in world. at: time after the first snapshot [s]; None for all times, or the last for a picture. size:
    width and height [px], None for the camera's. fps: pictures per second. depth: colour by depth.
    """

    scene: Path
    out: Path = Path("render.png")
    camera: str | None = None
    reference: Path | None = None
    path: Path | None = None
    at: float | None = None
    size: tuple[int, int] | None = None
    fps: float = 10.0
    depth: bool = False
    threads: int = 0
    force: bool = False


@dataclass(frozen=True, kw_only=True)
class _Track:
    """Poses T_world_camera (K, 4, 4) at ascending times (K,) [s]."""

    times: Float64
    poses: Float64

    def pose(self, time_s: float) -> Float64:
        """Pose at a time: interpolated between two poses, the nearest outside the track."""
        after = int(np.searchsorted(self.times, time_s))
        if after in {0, len(self.times)}:
            return np.asarray(self.poses[min(after, len(self.times) - 1)])
        start, end = self.times[after - 1 : after + 1]
        return interpolate_transform(self.poses[after - 1], self.poses[after], (time_s - start) / (end - start))


def render_scene(request: RenderSceneRequest) -> Result:
    """Render and write; metrics: num_pictures, width and height [px].

    Raises UsageError for an unknown camera, InputError for a bad path.
    """
    scene, kind = open_scene(request.scene), request.out.suffix
    refuse_if(
        kind not in (PNG, MP4, ""),
        f"{request.out}: expected a name that ends in {PNG} or {MP4}, or a folder",
        remedy="give another --out",
        error=UsageError,
    )
    lens, track = _camera(request, scene)
    refuse_if(
        kind == MP4 and (lens.width % 2 or lens.height % 2),
        f"{request.out}: expected an even width and height of a video, got {lens.width}x{lens.height}",
        remedy=f"give --size {lens.width // 2 * 2}x{lens.height // 2 * 2}",
        error=UsageError,
    )
    times = _times(request, scene, track)
    images = _images(request, scene, lens, track, times)
    with output_path(request.out, force=request.force, is_folder=not kind) as partial:
        if kind == MP4:
            _write_video(partial, images, lens, request.fps)
        elif kind == PNG:
            partial.write_bytes(_encode(next(images)))
        else:
            for number, image in enumerate(images):
                (partial / f"{number:05d}{PNG}").write_bytes(_encode(image))
            write_run(partial, command="render", config={}, inputs={}, metrics={}, stopwatch=Stopwatch())
    metrics = {"num_pictures": len(times), "width": lens.width, "height": lens.height}
    return Result(out=request.out, metrics=metrics)


def _camera(request: RenderSceneRequest, scene: SceneFolder) -> tuple[Intrinsics, _Track]:
    rows: dict[str, Any] = {row["camera"]: row for row in scene.made_from.get("first_frames", [])}
    refuse_if(not rows, f"{scene.path}: does not say where its cameras were", remedy="reconstruct it again")
    name = request.camera or next(iter(rows))
    first = require(rows.get(name), f"--camera {name}: expected one of: {', '.join(rows)}", error=UsageError)
    fx, fy, cx, cy, width, height = first["intrinsics"]
    lens = Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy, width=int(width), height=int(height))
    if request.size is not None:
        lens = _resize(lens, *request.size)
    if request.path is not None:
        return lens, _read_path(request.path)
    start_ns = next(iter(_stamps(scene)), 0)
    poses = [(first["stamp_ns"], np.reshape(first["T_world_camera"], (4, 4)))]
    if request.reference is not None:
        poses = [(stamp, T) for stamp, camera, T in open_source(request.reference).poses() if camera == name]
        refuse_if(not poses, f"--reference {request.reference}: has no pose of camera {name}", error=UsageError)
    stamps, transforms = zip(*poses, strict=True)
    times = np.array([1e-9 * (stamp - start_ns) for stamp in stamps])
    return lens, _Track(times=times, poses=np.array(transforms))


def _resize(lens: Intrinsics, width: int, height: int) -> Intrinsics:
    factor = height / lens.height
    return Intrinsics(
        fx=factor * lens.fx,
        fy=factor * lens.fy,
        cx=factor * (lens.cx + 0.5 - lens.width / 2) + width / 2 - 0.5,
        cy=factor * (lens.cy + 0.5) - 0.5,
        width=width,
        height=height,
    )


def _read_path(file: Path) -> _Track:
    faults, remedy = (OSError, ValueError, KeyError, TypeError), f"expected rows of time_s, {', '.join(POSE)}"
    with refuse_faults(
        lambda error: f"{file}: {getattr(error, 'strerror', None) or f'no path of a camera: {error}'}",
        *faults,
        remedy=remedy,
    ):
        text = file.read_text(encoding="utf-8")
        rows = json.loads(text) if file.suffix == ".json" else list(csv.DictReader(text.splitlines()))
        times = np.array([float(row["time_s"]) for row in rows])
        poses = [checked_pose([float(row[name]) for name in POSE]) for row in rows]
        refuse_if(not rows or not (np.diff(times) > 0).all(), "its times do not ascend", error=ValueError)
    return _Track(times=times, poses=np.array([transform_from(pose[:3], pose[3:]) for pose in poses]))


def _stamps(scene: SceneFolder) -> list[int]:
    """Stamps of the snapshots [ns], none for a scene without times."""
    has_times = scene.has_clock and not scene.is_anisotropic
    return [snapshot.stamp_ns for snapshot in scene.snapshots] if has_times else []


def _times(request: RenderSceneRequest, scene: SceneFolder, track: _Track) -> list[float]:
    """Times of the pictures [s] after the first snapshot."""
    stamps = _stamps(scene)
    refuse_if(
        request.at is not None and not stamps,
        f"--at {request.at}: {scene.path} has no times",
        remedy="leave it out",
        error=UsageError,
    )
    first, last = (0.0, 1e-9 * (stamps[-1] - stamps[0])) if stamps else (0.0, 0.0)
    if request.path is not None:
        first, last = float(track.times[0]), float(track.times[-1])
    refuse_if(
        request.at is not None and not first <= request.at <= last,
        f"--at {request.at}: expected {first:g} to {last:g} s of the {'path' if request.path else 'scene'}",
        error=UsageError,
    )
    if request.at is not None or request.out.suffix == PNG:
        return [last if request.at is None else request.at]
    return [first + number / request.fps for number in range(int((last - first) * request.fps + 1e-6) + 1)]


def _images(
    request: RenderSceneRequest, scene: SceneFolder, lens: Intrinsics, track: _Track, times: Sequence[float]
) -> Iterator[UInt8]:
    """Pictures (H, W, 3), RGB; depth is red (near) to blue (far).

    Blue is the first picture's farthest depth. Pixels without depth are black.
    """
    splats_at = lru_cache(maxsize=1)(partial(splats_and_shell, scene))
    stamps, farthest = _stamps(scene), 0.0
    for time_s in times:
        stamp_ns = scene.snapshot_at(stamps[0] + round(1e9 * time_s)).stamp_ns if stamps else None
        splats, shell = splats_at(stamp_ns)
        view, depth = render_with_shell(splats, shell, lens, track.pose(time_s), scene.background, request.threads)
        farthest = farthest or float(depth.max())
        yield _color_depth(depth, farthest) if request.depth else _quantise(view.color)


def _quantise(color: Float32) -> UInt8:
    return np.asarray(np.rint(255 * np.clip(color, 0, 1)), np.uint8)


def render_newest(scene: SceneFolder, source: FrameSource, threads: int = 0) -> Iterator[tuple[RgbdFrame, UInt8]]:
    """Yield each training camera's last frame, and its render as known then (H, W, 3), RGB."""
    stored = (item for item in source.stored() if isinstance(item, StoredFrame))
    newest = {item.camera: item for item in stored if item.camera in scene.cameras}
    off, has_times = scene.run.get("metrics", {}).get("displaced_cameras") or {}, bool(_stamps(scene))
    for item in newest.values():
        frame = corrected(correct_pose(item.frame, off), scene.corrections)
        splats, shell = splats_and_shell(scene, frame.stamp_ns if has_times else None)
        pose = frame.T_world_camera
        view, _ = render_with_shell(splats, shell, frame.intrinsics, pose, scene.background, threads)
        yield frame, _quantise(view.color)


def _color_depth(depth: Float32, farthest: float) -> UInt8:
    level = np.rint(255 * (1 - np.clip(depth / max(farthest, 1e-6), 0, 1))).astype(np.uint8)
    colors = cv2.applyColorMap(level, cv2.COLORMAP_TURBO)[:, :, ::-1]
    return np.asarray(np.where(depth[:, :, None] > 0, colors, 0), np.uint8)


def _encode(image: UInt8) -> bytes:
    return bytes(cv2.imencode(PNG, np.ascontiguousarray(image[:, :, ::-1]))[1])


def _write_video(file: Path, images: Iterator[UInt8], lens: Intrinsics, fps: float) -> None:
    av = import_extra("av", "video", "videos")
    with av.open(str(file), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000), options={"crf": "18"})
        stream.width, stream.height, stream.pix_fmt = lens.width, lens.height, "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())

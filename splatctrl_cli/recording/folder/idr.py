"""DTU scans in the layout of IDR and NeuS; scans as training and held-out records.

SCAN/cameras_sphere.npz (or cameras.npz) has world_mat_I, the projection (4, 4) of world points to pixels of image I,
and scale_mat_I, from the object's unit sphere to the world; SCAN/image/000000.png; SCAN/mask/000.png. Image I is the
I-th by name (Totoro97/NeuS, models/dataset.py), or by number if some are missing. Lengths are millimetres in files,
metres in memory. SCAN/depth may have depth_map_0000.pfm (and depth_visual_0000.png) as MVSNet names them.
"""

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from splatctrl_cli.errors import InputError, UsageError, refuse_if
from splatctrl_cli.evaluate.protocols import ScoreProtocol, Split
from splatctrl_cli.files.output import sha256
from splatctrl_cli.formats.arrays import read_arrays, savez
from splatctrl_cli.formats.image_file import write_pfm
from splatctrl_cli.geometry import invert_transform, pose_at
from splatctrl_cli.recording.folder.dtu import (
    DtuScan,
    DtuView,
    Shrink,
    check_lengths,
    choose_scan,
    read_dtu,
    read_views,
    write_png,
)
from splatctrl_cli.records import MILLIMETRES, Bool, Float64, Intrinsics, LossReport, Record, RgbdFrame

CAMERAS = ("cameras_sphere.npz", "cameras.npz")
PLAUSIBLE_RADIUS = (0.02, 20.0)  # [m] of the sphere around the object


def idr_scans(root: Path) -> dict[str, Path]:
    """Scan folders by name: `root`, or its children."""
    scans = [path for path in (root, *sorted(root.glob("*"))) if any((path / name).is_file() for name in CAMERAS)]
    return {path.name.removeprefix("dtu_"): path for path in (scans[:1] if root in scans else scans)}


def read_idr(
    root: Path, scan: str | None = None, depths: Path | None = None, shrink: Shrink = lambda view: view
) -> DtuScan:
    """Read scan `scan` (default: the only one); `depths` contains its depth maps (default: SCAN/depth).

    `shrink` maps each view. A view without a depth map has depth 0. Raises InputError naming the file.
    """
    scan, folder = choose_scan(root, idr_scans(root), scan)
    path = next(folder / name for name in CAMERAS if (folder / name).is_file())
    projections = _projections(path)
    images = _number_images(folder / "image", len(projections))
    refuse_if(not images, f"{folder / 'image'}: expected images such as 000000.png, got none")
    masks = _number_images(folder / "mask", len(projections))
    missing = [number for number in images if number not in masks]
    if masks and missing:
        raise InputError(f"{folder / 'mask'}: expected a mask for each image, got none for image {missing[0]}")

    def camera(number: int, size: tuple[int, int]) -> tuple[Intrinsics, Float64]:
        K, T_world_camera = decompose(projections[number], f"{path}: world_mat_{number}")
        return _intrinsics(K, size, path), T_world_camera

    def depth_of(number: int) -> Path | None:
        file = (depths or folder / "depth") / f"depth_map_{number:04d}.pfm"
        return file if file.is_file() else None

    dtu_scan = read_views(
        scan, images, camera, depth_of=depth_of, mask_of=masks.get, shrink=shrink, keeps_without_depth=True
    )
    refuse_if(
        depths is not None and len(dtu_scan.without_depth) == len(dtu_scan.views),
        f"{depths}: expected depth_map_0000.pfm and so on, got none",
    )
    check_lengths(f"{folder}", dtu_scan.views)
    return replace(dtu_scan, files=(*dtu_scan.files, path))


def write_idr(root: Path, scan: str, views: Sequence[DtuView]) -> Path:
    """Write views and masks as one scan folder; return it.

    The object's sphere is centred nearest to the cameras' axes; its radius is half the nearest camera's distance.
    """
    folder = root / scan
    (folder / "image").mkdir(parents=True)
    center, radius = _sphere(views)
    scale = np.diag([radius, radius, radius, 1.0])
    scale[:3, 3] = center
    matrices: dict[str, Float64] = {}
    for number, view in enumerate(views):
        matrices |= {f"world_mat_{number}": projection(view), f"scale_mat_{number}": scale}
        write_png(folder / "image" / f"{number:06d}.png", view.color[:, :, ::-1])
        if view.mask is not None:
            (folder / "mask").mkdir(exist_ok=True)
            write_png(folder / "mask" / f"{number:03d}.png", np.where(view.mask, 255, 0).astype(np.uint8))
        (folder / "depth").mkdir(exist_ok=True)
        write_pfm(folder / "depth" / f"depth_map_{number:04d}.pfm", view.depth * np.float32(MILLIMETRES))
    savez(folder / CAMERAS[0], matrices)
    return folder


def projection(view: DtuView) -> Float64:
    """World points [mm] to pixels, (4, 4)."""
    k = view.intrinsics
    T_camera_world = invert_transform(view.T_world_camera)
    T_camera_world[:3, 3] *= MILLIMETRES
    return np.array([[k.fx, 0, k.cx, 0], [0, k.fy, k.cy, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]) @ T_camera_world


def _sphere(views: Sequence[DtuView]) -> tuple[Float64, float]:
    """Centre (3,) and radius [mm]."""
    centers = MILLIMETRES * np.array([view.T_world_camera[:3, 3] for view in views])
    axes = np.array([view.T_world_camera[:3, 2] for view in views])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]  # the part of a vector across the axis
    middle = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, centers), rcond=None)[0]
    return middle, 0.5 * float(np.linalg.norm(centers - middle, axis=1).min())


def decompose(P: Float64, where: str) -> tuple[Float64, Float64]:
    """Split P (3, 4) of world points [mm] into K (3, 3) and T_world_camera (4, 4) [m].

    P = s K [R | t] with K[2, 2] = 1 and any scale s, even negative; the camera's centre is where P is 0. Raises
    InputError if P is no camera.
    """
    M = P[:, :3]
    determinant = np.linalg.det(M)
    refuse_if(
        not np.isfinite(P).all() or abs(determinant) < 1e-12 * np.linalg.norm(M) ** 3,
        f"{where}: expected a camera's projection, got a matrix that cannot be inverted",
    )
    K, R = cv2.decomposeProjectionMatrix(P if determinant > 0 else -P)[:2]
    signs = np.where(np.diag(K) < 0, -1.0, 1.0)  # K diag(signs), diag(signs) R: a camera with a positive focal length
    K, R = np.asarray(K, np.float64) * signs, signs[:, None] * np.asarray(R, np.float64)
    return K / K[2, 2], pose_at(-np.linalg.solve(M, P[:, 3]) / MILLIMETRES, R.T)


def _number_images(folder: Path, num: int) -> dict[int, Path]:
    """Images by camera number: in order if there are `num`, else by name.

    Raises InputError for another name.
    """
    paths = sorted(folder.glob("*.png")) or sorted(folder.glob("*.jpg"))
    if len(paths) == num:
        return dict(enumerate(paths))
    numbered: dict[int, Path] = {}
    for path in paths:
        number = int(path.stem) if path.stem.isdecimal() else num
        refuse_if(
            number >= num or number in numbered,
            f"{path}: expected one picture for each of {num} cameras, or their numbers as names, got {len(paths)}"
            f" and this one" + (f" beside {numbered[number].name}" if number in numbered else ""),
            remedy=f"name it by its camera's number, as {0:06d}.png to {num - 1:06d}.png, or take it away",
        )
        numbered[number] = path
    return dict(sorted(numbered.items()))


def _projections(path: Path) -> list[Float64]:
    """World points [mm] to pixels, (3, 4) each."""
    try:
        arrays = read_arrays(path, most=1 << 24)  # bytes of cameras: 500 each
        num = sum(1 for name in arrays if re.fullmatch(r"world_mat_\d+", name))
        world = [np.asarray(arrays[f"world_mat_{i}"], np.float64)[:3, :4] for i in range(max(num, 1))]
        radius = float(np.asarray(arrays["scale_mat_0"], np.float64)[0, 0]) / MILLIMETRES
    except KeyError as error:
        raise InputError(f"{path}: {error.args[0]}; expected world_mat_0 and so on, and scale_mat_0") from None
    except Exception as error:  # numpy raises many kinds for a file that is not an archive
        raise InputError(f"{path}: not the cameras of a scan: {error}") from None
    low, high = PLAUSIBLE_RADIUS
    refuse_if(
        not low <= radius <= high,
        f"{path}: scale_mat_0: expected a sphere of {low:g} to {high:g} m around the object, got {radius:g} m",
        remedy="world lengths have to be millimetres, as DTU's; this file may hold cameras in the unit sphere",
    )
    return world


def _intrinsics(K: Float64, size: tuple[int, int], path: Path) -> Intrinsics:
    width, height = size
    refuse_if(
        abs(K[0, 1]) > 1.0, f"{path}: expected cameras without skew, got one of {K[0, 1]:.2f} px"
    )  # [px]; our cameras have none
    refuse_if(
        not (0.2 < K[0, 2] / width < 0.8 and 0.2 < K[1, 2] / height < 0.8),
        f"{path}: principal point ({K[0, 2]:.1f}, {K[1, 2]:.1f}) px does not lie about the middle of an image of"
        f" {width}x{height}",
        remedy="the images have to have the size that the cameras were made for",
    )
    return Intrinsics(
        fx=float(K[0, 0]), fy=float(K[1, 1]), cx=float(K[0, 2]), cy=float(K[1, 2]), width=width, height=height
    )


TRAINING_CAMERA = "camera"
HOLDOUT_CAMERA = "holdout"


def view_numbers(words: Sequence[str]) -> list[int]:
    """Parse view numbers such as ``2`` and ``5``. Raises UsageError for other words."""
    bad = [word for word in words if not word.isdigit()]
    refuse_if(bad, f"--holdout: expected view numbers such as 2,5, got {''.join(bad[:1])!r}", error=UsageError)
    return [int(word) for word in words]


class DtuSource:
    """A scan's views by number (view 0 is ``rect_001``), which is also the stamp.

    The scene is static, without a clock. Views in `holdout` belong to camera ``holdout``, others to ``camera``,
    unless a `protocol` assigns or drops them. masks, depths: folders outside the scan. downscale: shrink factor;
    None: to the protocol's size, if by a whole factor. layout: ``MVSNet`` or ``IDR``. split: training and held-out
    views.
    """

    joint_names: tuple[str, ...] = ()
    has_clock = False

    def __init__(
        self,
        root: Path,
        scan: str | None = None,
        holdout: Collection[int] = (),
        *,
        protocol: ScoreProtocol | None = None,
        masks: Path | None = None,
        depths: Path | None = None,
        downscale: int | None = None,
    ) -> None:
        self.layout = "IDR" if not (root / "Rectified").is_dir() and idr_scans(root) else "MVSNet"
        self._root = root
        dtu_scan = self._read(
            scan,
            masks,
            depths,
            lambda view: shrink_view(view, _factor(view, protocol) if downscale is None else downscale),
        )
        self.scan, self.name = dtu_scan.name, f"{root.name}/{dtu_scan.name}"
        self._files = dtu_scan.files
        self._views = dict(zip(dtu_scan.numbers, dtu_scan.views, strict=True))
        numbers = tuple(self._views)
        if protocol is not None:
            refuse_if(
                holdout,
                "--holdout: the protocol holds views out already",
                remedy="give --holdout or --protocol, not both",
                error=UsageError,
            )
            self.split = protocol.split(numbers, f"{root}/{dtu_scan.name}")
        else:
            self.split = _held_out(numbers, frozenset(holdout), root)
        self._held_out = set(self.split.scored) - set(self.split.training)
        self.cameras: tuple[str, ...] = (TRAINING_CAMERA, HOLDOUT_CAMERA) if self._held_out else (TRAINING_CAMERA,)
        is_left_out = self.layout == "MVSNet"
        notes = [f"{name}: without depth{', left out' if is_left_out else ''}" for name in dtu_scan.without_depth]
        self.loss = LossReport(unpaired_color=len(notes), notes=notes)

    def _read(self, scan: str | None, masks: Path | None, depths: Path | None, shrink: Shrink) -> DtuScan:
        if self.layout == "MVSNet":
            refuse_if(
                depths is not None,
                f"--depths {depths}: MVSNet's layout has its own",
                remedy="leave it out",
                error=UsageError,
            )
            return read_dtu(self._root, scan, masks, shrink)
        refuse_if(
            masks is not None, f"--masks {masks}: IDR's layout has its own", remedy="leave it out", error=UsageError
        )
        return read_idr(self._root, scan, depths, shrink)

    @property
    def has_depth(self) -> bool:
        return any(bool((view.depth > 0).any()) for view in self._views.values())

    def mask(self, number: int) -> Bool | None:
        """(H, W) True on the object; None if unknown."""
        return self._views[number].mask

    def records(self) -> Iterator[Record]:
        left_out = set(self.split.left_out)
        for number, view in self._views.items():
            if number in left_out:
                continue
            yield RgbdFrame(
                stamp_ns=number,
                camera=HOLDOUT_CAMERA if number in self._held_out else TRAINING_CAMERA,
                color=view.color,
                depth=view.depth,
                intrinsics=view.intrinsics,
                T_world_camera=view.T_world_camera,
            )

    def digests(self) -> dict[str, str]:
        return {
            str(path.relative_to(self._root) if path.is_relative_to(self._root) else path): sha256(path)
            for path in sorted(set(self._files))
        }


def shrink_view(view: DtuView, factor: int) -> DtuView:
    """Merge every `factor` x `factor` pixels: mean colour, middle pixel's depth, first pixel's mask.

    Colour and mask follow RegNeRF (regnerf/internal/datasets.py, downsample). Pixel (0, 0) has its centre at (0, 0):
    u becomes (u + 0.5) / factor - 0.5. Raises UsageError for a factor that does not divide the size.
    """
    k = view.intrinsics
    refuse_if(
        factor < 1 or k.width % factor or k.height % factor,
        f"--downscale {factor}: expected a whole factor of {k.width}x{k.height}",
        error=UsageError,
    )
    if factor == 1:
        return view
    size = (k.width // factor, k.height // factor)
    sample = slice(factor // 2, None, factor)
    return DtuView(
        name=view.name,
        color=np.asarray(cv2.resize(view.color, size, interpolation=cv2.INTER_AREA), np.uint8),
        depth=np.ascontiguousarray(view.depth[sample, sample]),
        intrinsics=Intrinsics(
            fx=k.fx / factor,
            fy=k.fy / factor,
            cx=(k.cx + 0.5) / factor - 0.5,
            cy=(k.cy + 0.5) / factor - 0.5,
            width=size[0],
            height=size[1],
        ),
        T_world_camera=view.T_world_camera,
        mask=None if view.mask is None else np.ascontiguousarray(view.mask[::factor, ::factor]),
    )


def _factor(view: DtuView, protocol: ScoreProtocol | None) -> int:
    if protocol is None or protocol.size is None:
        return 1
    width, height = protocol.size
    factor = view.intrinsics.width // width
    is_whole = factor >= 1 and (view.intrinsics.width, view.intrinsics.height) == (factor * width, factor * height)
    return factor if is_whole else 1


def _held_out(numbers: tuple[int, ...], holdout: frozenset[int], root: Path) -> Split:
    outside = sorted(holdout - set(numbers))
    refuse_if(
        outside,
        f"--holdout {min(outside, default=0)}: {root} has no such view",
        remedy=f"views: {_span(numbers)}",
        error=UsageError,
    )
    refuse_if(
        holdout and len(holdout) == len(numbers),
        f"--holdout: all {len(numbers)} views of {root} are held out",
        remedy="leave some",
        error=UsageError,
    )
    return Split(training=tuple(n for n in numbers if n not in holdout), scored=tuple(sorted(holdout)))


def _span(numbers: tuple[int, ...]) -> str:
    is_whole = numbers == tuple(range(numbers[0], numbers[-1] + 1))
    return f"{numbers[0]} to {numbers[-1]}" if is_whole else ", ".join(map(str, numbers))

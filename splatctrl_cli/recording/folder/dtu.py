"""Reader and writer of DTU scans in MVSNet's layout.

ROOT/Cameras/[train/]00000000_cam.txt (world-to-camera and K), ROOT/Cameras/pair.txt,
ROOT/Rectified/SCAN_train/rect_001_3_r5000.png (view 0, light 3), ROOT/Depths_raw/SCAN/depth_map_0000.pfm with
depth_visual_0000.png (above 10 where depth is valid). Lengths are millimetres in files, metres in memory.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from splatctrl_cli.errors import InputError, refuse_faults, refuse_if, require
from splatctrl_cli.formats.image_file import decode_file, read_pfm, write_pfm
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.records import MILLIMETRES, Bool, Float32, Float64, Intrinsics, UInt8

LIGHT = 3  # of seven; the one MVSNet's own lists test with
RAW = (1600, 1200)  # pixels of DTU's cameras; 640x512 is half of that, cropped about the middle
CROPPED = (640, 512)
CROP = (80, 44)  # pixels cut off left and top of the half-size image
PLAUSIBLE_DEPTH = (0.02, 20.0)  # [m] median of a scan
LEAST_SPREAD = 0.005  # of the depth, by which the cameras stand apart


@dataclass(frozen=True, kw_only=True)
class DtuView:
    """A view: color (H, W, 3) uint8 RGB, depth (H, W) float32 [m], K [px], pose [m].

    Depth 0 = none. mask (H, W): True on the object, None if unknown.
    """

    name: str
    color: UInt8
    depth: Float32
    intrinsics: Intrinsics
    T_world_camera: Float64
    mask: Bool | None = None


Shrink = Callable[[DtuView], DtuView]


@dataclass(frozen=True, kw_only=True)
class DtuScan:
    """A scan's views, their numbers, files read, and names of images without_depth."""

    name: str
    views: tuple[DtuView, ...]
    numbers: tuple[int, ...]
    files: tuple[Path, ...]
    without_depth: tuple[str, ...]


def read_dtu(
    root: Path, scan: str | None = None, masks: Path | None = None, shrink: Shrink = lambda view: view
) -> DtuScan:
    """Read scan `scan` (default: the only one) of a DTU folder; `masks` has NNN.png.

    `shrink` maps each view before the next is read. K is scaled to the images, as it may be for 1600x1200 or a
    quarter. Depth of another size is sampled, not blended. Drops views without depth. Raises InputError naming the
    file.
    """
    scan, folder = choose_scan(root, scan_folders(root), scan)

    def camera(number: int, size: tuple[int, int]) -> tuple[Intrinsics, Float64]:
        path = _camera_file(root, number)
        K, T_camera_world, _ = read_camera_file(path)
        T_camera_world[:3, 3] /= MILLIMETRES
        return fit_intrinsics(K, size, path), invert_transform(T_camera_world)

    dtu_scan = read_views(
        scan,
        _images(folder),
        camera,
        depth_of=lambda number: _depth_file(root, scan, number),
        mask_of=lambda number: None if masks is None else _mask_file(masks, number),
        shrink=shrink,
        keeps_without_depth=False,
    )
    refuse_if(
        not dtu_scan.views,
        f"{root}: scan '{scan}' has no depth",
        remedy=f"expected Depths_raw/{scan}/depth_map_0000.pfm and so on",
    )
    check_lengths(f"{root}: scan '{scan}'", dtu_scan.views)
    return replace(dtu_scan, files=(*dtu_scan.files, *(_camera_file(root, number) for number in dtu_scan.numbers)))


def choose_scan(root: Path, folders: Mapping[str, Path], scan: str | None) -> tuple[str, Path]:
    """The scan of that name, or the only one. Raises InputError with the choices."""
    name = next(iter(folders)) if scan is None and len(folders) == 1 else scan or ""
    got = "several scans" if scan is None else f"no scan '{scan}'"
    return name, require(
        folders.get(name), f"{root}: {got}", remedy=f"give --scan, one of: {', '.join(folders) or 'none is there'}"
    )


def read_views(
    scan: str,
    images: Mapping[int, Path],
    camera: Callable[[int, tuple[int, int]], tuple[Intrinsics, Float64]],
    *,
    depth_of: Callable[[int], Path | None],
    mask_of: Callable[[int], Path | None],
    shrink: Shrink,
    keeps_without_depth: bool,
) -> DtuScan:
    """Read views by number; `shrink` maps each before the next is read.

    A view without a depth file has depth 0 if `keeps_without_depth`, else it is left out. camera: intrinsics and
    T_world_camera by number and (width, height).
    """
    views: list[DtuView] = []
    numbers: list[int] = []
    files: list[Path] = []
    without_depth: list[str] = []
    for number, path in images.items():
        color = read_image(path)
        size = (color.shape[1], color.shape[0])
        intrinsics, T_world_camera = camera(number, size)
        depth_path, depth = depth_of(number), np.zeros(color.shape[:2], np.float32)
        if depth_path is None:
            without_depth.append(path.name)
            if not keeps_without_depth:
                continue
        else:
            visual = depth_path.with_name(f"depth_visual_{number:04d}.png")
            depth = read_depth(depth_path, visual, size)
            files += [depth_path, *([visual] if visual.is_file() else [])]
        mask_path = mask_of(number)
        views.append(
            shrink(
                DtuView(
                    name=path.stem,
                    color=color,
                    depth=depth,
                    intrinsics=intrinsics,
                    T_world_camera=T_world_camera,
                    mask=None if mask_path is None else read_mask(mask_path, size),
                )
            )
        )
        numbers.append(number)
        files += [path] if mask_path is None else [path, mask_path]
    return DtuScan(
        name=scan, views=tuple(views), numbers=tuple(numbers), files=tuple(files), without_depth=tuple(without_depth)
    )


def check_lengths(where: str, views: Sequence[DtuView]) -> None:
    """Raise InputError if depth or camera distances are not millimetres."""
    medians = [float(np.median(view.depth[view.depth > 0])) for view in views if (view.depth > 0).any()]
    if not medians:
        return
    median, (low, high) = float(np.median(medians)), PLAUSIBLE_DEPTH
    refuse_if(
        not low <= median <= high,
        f"{where}: depth: expected {MILLIMETRES * low:g} to {MILLIMETRES * high:g} mm, got a median of"
        f" {MILLIMETRES * median:.3g}",
        remedy="give lengths in millimetres",
    )
    centers = np.array([view.T_world_camera[:3, 3] for view in views])
    spread = float(np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())
    refuse_if(
        0 < spread < LEAST_SPREAD * median,
        f"{where}: cameras: expected millimetres, as the depth's median of {MILLIMETRES * median:.0f} mm, got"
        f" cameras within {MILLIMETRES * spread:.3g} mm of their middle",
        remedy="give translations in millimetres",
    )


def write_dtu(root: Path, scan: str, views: Sequence[DtuView]) -> None:
    cameras = root / "Cameras"
    rectified = root / "Rectified" / f"{scan}_train"
    depths = root / "Depths_raw" / scan
    for folder in (cameras, rectified, depths):
        folder.mkdir(parents=True, exist_ok=True)
    cameras.joinpath("pair.txt").write_text(_pairs(views), encoding="utf-8")
    for number, view in enumerate(views):
        cameras.joinpath(f"{number:08d}_cam.txt").write_text(_camera_text(view), encoding="utf-8")
        write_png(rectified / f"rect_{number + 1:03d}_{LIGHT}_r5000.png", view.color[:, :, ::-1])
        write_pfm(depths / f"depth_map_{number:04d}.pfm", view.depth * np.float32(MILLIMETRES))
        write_png(depths / f"depth_visual_{number:04d}.png", np.where(view.depth > 0, 255, 0).astype(np.uint8))


def write_png(path: Path, image: UInt8) -> None:
    path.write_bytes(cv2.imencode(".png", np.ascontiguousarray(image))[1].tobytes())


def scan_folders(root: Path) -> dict[str, Path]:
    """Image folders by scan. Raises InputError without Rectified."""
    rectified = root / "Rectified"
    refuse_if(
        not rectified.is_dir(),
        f"{root}: expected a DTU folder with Cameras, Rectified and Depths_raw, or scans with cameras_sphere.npz,"
        " got none",
        remedy="give the folder that holds Rectified, or the scans in IDR's layout",
    )
    return {path.name.removesuffix("_train"): path for path in sorted(rectified.iterdir()) if path.is_dir()}


def _images(folder: Path) -> dict[int, Path]:
    images: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        match = re.fullmatch(r"rect_(\d+)_(\d+|max)(_r5000)?\.(png|jpg)", path.name)
        if match:
            number = int(match[1]) - 1
            if number not in images or match[2] == str(LIGHT):
                images[number] = path
    refuse_if(not images, f"{folder}: expected images such as rect_001_3_r5000.png, got none")
    return dict(sorted(images.items()))


def read_image(path: Path) -> UInt8:
    """RGB (H, W, 3), ignoring the orientation tag. Raises InputError if unreadable."""
    image = decode_file(path.read_bytes(), color=True) if path.is_file() else None
    return np.asarray(require(image, f"{path}: not an image that can be read", remedy="copy the file anew"), np.uint8)


def read_mask(path: Path, size: tuple[int, int]) -> Bool:
    """Mask (H, W), True where bright in every channel, by nearest pixels."""
    image = read_image(path)
    if image.shape[1::-1] != size:
        width, height = size
        refuse_if(
            image.shape[1] * height != image.shape[0] * width,
            f"{path}: expected a mask of {width}x{height} or of that shape, got {image.shape[1]}x{image.shape[0]}",
        )
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    return np.asarray((image >= 128).all(axis=2))


def _mask_file(folder: Path, number: int) -> Path:
    files = (path for place in (folder, folder / "mask") for path in sorted(place.glob("*.png")))
    mask = next((path for path in files if path.stem.isdecimal() and int(path.stem) == number), None)
    return require(
        mask, f"{folder}: expected a mask {number:03d}.png, got none", remedy="give the folder of this scan's masks"
    )


def _camera_file(root: Path, number: int) -> Path:
    candidates = [root / "Cameras" / part / f"{number:08d}_cam.txt" for part in ("train", ".")]
    file = next(filter(Path.is_file, candidates), None)
    return require(file, f"{candidates[-1]}: missing", remedy="every image needs its camera file")


def read_camera_file(path: Path) -> tuple[Float64, Float64, float]:
    """Read K (3, 3) [px], T_camera_world (4, 4) and least depth of MVSNet's file.

    Lengths have the file's unit; depth 0: not given.
    """
    words = path.read_text(encoding="utf-8", errors="replace").split()
    with refuse_faults(
        lambda _: f"{path}: expected 'extrinsic' (4x4), 'intrinsic' (3x3) and a depth range, got another text",
        ValueError,
        remedy="copy the file again",
    ):
        extrinsic = np.array(words[words.index("extrinsic") + 1 :][:16], dtype=np.float64).reshape(4, 4)
        rest = words[words.index("intrinsic") + 1 :]
        K, nearest = np.array(rest[:9], dtype=np.float64).reshape(3, 3), float(rest[9]) if rest[9:] else 0.0
    R = extrinsic[:3, :3]
    refuse_if(
        not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0,
        f"{path}: extrinsic: expected a rotation in its first three columns",
    )
    return K, extrinsic, nearest


def fit_intrinsics(K: Float64, size: tuple[int, int], path: Path) -> Intrinsics:
    """Fit K, of one of the common sizes, to an image of `size` (width, height).

    Pixel (0, 0) has its centre at (0, 0) (lioryariv/idr, apchenstu/mvsnerf). Shrinking moves u to (u + 0.5) scale -
    0.5, as in `shrink_view`. MVSNet's K for 640x512, and for a quarter, are multiples of that for 1600x1200, without
    this shift.
    """
    width, height = size
    ratio = width / RAW[0]
    sizes: list[tuple[float, float, float, float, tuple[int, int]]] = [  # columns, rows, scale, shift, crop
        (width, height, 1.0, 0.0, (0, 0)),
        (width / 4, height / 4, 4.0, 0.0, (0, 0)),
        *([(*RAW, 0.5, 0.0, CROP)] if size == CROPPED else []),
        *([(*RAW, ratio, 0.5 * ratio - 0.5, (0, 0))] if width * RAW[1] == height * RAW[0] else []),
    ]
    for columns, rows, scale, shift, crop in sizes:
        if abs(K[0, 2] / columns - 0.5) < 0.1 and abs(K[1, 2] / rows - 0.5) < 0.1:
            return Intrinsics(
                fx=float(K[0, 0] * scale),
                fy=float(K[1, 1] * scale),
                cx=float(K[0, 2] * scale + shift - crop[0]),
                cy=float(K[1, 2] * scale + shift - crop[1]),
                width=width,
                height=height,
            )
    raise InputError(
        f"{path}: principal point ({K[0, 2]:g}, {K[1, 2]:g}) fits no image of {width}x{height}, nor a quarter of it,"
        f" nor 1600x1200"
    )


def _depth_file(root: Path, scan: str, number: int) -> Path | None:
    folders = (root / f"Depths_raw/{scan}", root / f"Depths/{scan}_train", root / f"Depths/{scan}")
    return next((path for folder in folders if (path := folder / f"depth_map_{number:04d}.pfm").is_file()), None)


def read_depth(path: Path, visual: Path, size: tuple[int, int]) -> Float32:
    """Depth (H, W) [m] for an image of `size` (width, height), 0 = none."""
    depth = read_pfm(path)
    depth = np.where(np.isfinite(depth) & (depth > 0), depth / np.float32(MILLIMETRES), np.float32(0))
    if visual.is_file():
        shown = cv2.cvtColor(read_image(visual), cv2.COLOR_RGB2GRAY)
        refuse_if(shown.shape != depth.shape, f"{visual}: expected a grey image of {depth.shape[1]}x{depth.shape[0]}")
        depth = np.where(shown > 10, depth, np.float32(0))
    width, height = size
    if depth.shape == (height, width):
        return depth
    if depth.shape == (RAW[1], RAW[0]) and size == CROPPED:
        return np.ascontiguousarray(depth[2 * CROP[1] :: 2, 2 * CROP[0] :: 2][:height, :width])
    smaller = depth.shape[1] // width
    if smaller >= 2 and (width * smaller, height * smaller) == depth.shape[::-1]:
        return np.ascontiguousarray(depth[smaller // 2 :: smaller, smaller // 2 :: smaller])
    factor = width // depth.shape[1] if depth.shape[1] else 0
    if factor >= 2 and (depth.shape[1] * factor, depth.shape[0] * factor) == size:
        spread = np.zeros((height, width), dtype=np.float32)
        spread[::factor, ::factor] = depth
        return spread
    raise InputError(f"{path}: {depth.shape[1]}x{depth.shape[0]} does not fit an image of {width}x{height}")


def _camera_text(view: DtuView) -> str:
    T_camera_world = invert_transform(view.T_world_camera)
    T_camera_world[:3, 3] *= MILLIMETRES
    k = view.intrinsics
    K = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]])
    known = view.depth[view.depth > 0].astype(np.float64) * MILLIMETRES
    near, far = (float(np.floor(known.min())), float(np.ceil(known.max()))) if known.size else (425.0, 935.0)
    pose, lens = (
        [" ".join(f"{value + 0.0:.10g}" for value in row) for row in matrix] for matrix in (T_camera_world, K)
    )
    return "\n".join(["extrinsic", *pose, "", "intrinsic", *lens, "", f"{near:g} {(far - near) / 191:.6g}"]) + "\n"


def _pairs(views: Sequence[DtuView]) -> str:
    centers = np.array([view.T_world_camera[:3, 3] for view in views]) * MILLIMETRES
    lines = [str(len(views))]
    for number in range(len(views)):
        gaps = np.linalg.norm(centers - centers[number], axis=1)
        order = [int(i) for i in np.argsort(gaps, kind="stable") if i != number][:10]
        words = [f"{other} {1e6 / (1000 + gaps[other]):.2f}" for other in order]
        lines += [str(number), " ".join([str(len(order)), *words])]
    return "\n".join(lines) + "\n"

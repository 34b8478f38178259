"""Folders of images with poses, as other tools write them."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from splatctrl_cli.geometry import quat_from_rotation, strided_lens
from splatctrl_cli.recording.source import SourceOptions, open_source
from tests.calibration.scan import views_of
from tests.cases.case import Case, Run, expect_result
from tests.conftest import ROOT

START = 1305031102.1
TINY = ("--set", "scene.first_iterations=2", "--set", "scene.iterations_per_step=2", "--max-splats", "200")


def tum(*, unit: float, lost: tuple[int, ...] = (), lines: int = 1, back: bool = False) -> Callable[[Path], None]:
    """A TUM folder of the sample's views: depth in counts of a `unit` [m]; views that are `lost` have a pose of NaN;
    `lines` of poses for each image; `back`: paths with backslashes.
    """

    def make(folder: Path) -> None:
        rows: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
        for name in ("rgb", "depth"):
            (folder / name).mkdir()
        for index, view in enumerate(views_of(ROOT / "sample_data")):
            T, stamp = view.T_world_camera, START + 0.2 * index
            for name, pixels in (("rgb", view.color[::3, ::3, ::-1]), ("depth", view.depth[::3, ::3] / unit)):
                kind = np.uint8 if name == "rgb" else np.uint16
                cv2.imwrite(str(folder / name / f"{stamp:.6f}.png"), np.round(pixels).astype(kind))
                rows[name].append(f"{stamp:.6f} {name}{chr(92) if back else '/'}{stamp:.6f}.png")
            pose = [*T[:3, 3], *quat_from_rotation(T[:3, :3])] if index not in lost else [float("nan")] * 7
            for line in range(lines):
                rows["groundtruth"].append(" ".join([f"{stamp + 0.01 * line:.6f}", *(f"{x:.9f}" for x in pose)]))
        for name, text in rows.items():
            (folder / f"{name}.txt").write_text("# stamp\n" + "\n".join(text) + "\n", encoding="utf-8")

    return make


def lens() -> tuple[str, str]:
    """--intrinsics of the sample's views, a third of their size."""
    k = strided_lens(views_of(ROOT / "sample_data")[0].intrinsics, 3)
    return "--intrinsics", f"camera={k.fx},{k.fy},{k.cx},{k.cy}"


def in_millimetres(folder: Path, out: Path, run: Run) -> None:
    """What `check` calls an error stops `reconstruct`, with the remedy that `check` gives; obeyed, it succeeds."""
    options, remedy = lens(), "give --depth-scale 0.001"
    expect_result(run, ["check", folder, *options], remedy, "views-scale", code=1)
    words = ["reconstruct", folder, *options, *TINY]
    expect_result(run, [*words, "-o", out / "scene"], remedy, "views-scale", code=4)
    expect_result(run, [*words, "-o", out / "scene", "--depth-scale", "0.001"])
    expect_result(run, [*words, "-o", out / "near", "--allow-disagreement"])


def no_pose(num: int, lines: int) -> Callable[[Path, Path, Run], None]:
    """Lines of NaN are no pose: images there are left out, others are read, and both are counted."""

    def examine(folder: Path, out: Path, run: Run) -> None:
        is_ours = (folder / "rgb.txt").is_file()
        given = lens() if is_ours else ("--intrinsics", "camera=60,60,31.5,23.5")
        parts = (f"without pose: {num} ", f"{lines} of ") if is_ours else ()
        words = ["ingest", folder if is_ours else folder / "32-tum-nan", *given, "-o", out / "capture"]
        expect_result(run, words, "lines are no pose (nan)", *parts)

    return examine


def as_check_says(folder: Path, out: Path, run: Run) -> None:
    """`reconstruct` refuses the folder where, and only where, `check` says that it cannot start."""
    is_ours = (folder / "rgb.txt").is_file()
    options = [folder, *lens()] if is_ours else [folder / "40-tum-mm", "--intrinsics", "camera=60,60,31.5,23.5"]
    refuses = "cannot start, or would be wrong: ingest, reconstruct" in run(["check", *options]).text
    expect_result(run, ["reconstruct", *options, "-o", out / "scene", *TINY], code=4 if refuses else 0)


def write_windows(folder: Path) -> None:
    """A transforms.json from Windows."""
    (folder / "images").mkdir()
    for name in ("c", "d"):
        kind = np.uint8 if name == "c" else np.uint16
        cv2.imwrite(str(folder / "images" / f"{name}0.png"), np.full((48, 64), 200, kind))
    frame = {"file_path": "images\\c0.png", "depth_file_path": ".\\images\\d0.png"}
    head = {"fl_x": 60, "fl_y": 60, "cx": 32, "cy": 24, "w": 64, "h": 48}
    content = {**head, "frames": [{**frame, "transform_matrix": np.eye(4).tolist()}]}
    (folder / "transforms.json").write_text(json.dumps(content), encoding="utf-8")


def one_frame(folder: Path, out: Path, run: Run) -> None:
    """It is read."""
    frames = list(open_source(folder, SourceOptions()).records())
    assert (len(frames), run(["info", folder]).code) == (1, 0)


def all_frames(folder: Path, out: Path, run: Run) -> None:
    """They are read."""
    num = len(views_of(ROOT / "sample_data"))
    expect_result(run, ["ingest", folder, *lens(), "-o", out / "capture"], f"camera {num}")


CASES: tuple[Case, ...] = (
    Case(name="38-tum-layout-mm", make=tum(unit=0.0002), examine=as_check_says, has_shared=True),
    Case(name="own-tum-folder-in-mm", make=tum(unit=0.001), examine=in_millimetres),
    Case(name="29-tum-nan-poses", make=tum(unit=0.0002, lost=(1, 2)), examine=no_pose(2, 2), has_shared=True),
    Case(name="nan-between-poses-that-are-near", make=tum(unit=0.0002, lost=(3,), lines=3), examine=no_pose(1, 3)),
    Case(name="tum-with-backslashes", make=tum(unit=0.0002, back=True), examine=all_frames),
    Case(name="transforms-with-backslashes", make=write_windows, examine=one_frame),
)

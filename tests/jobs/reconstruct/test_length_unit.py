"""Folders of views whose lengths are no metres: one map where poses and depth agree, and no map where they do not."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.config import Config, SceneConfig
from splatctrl_cli.errors import InputError
from splatctrl_cli.geometry import strided_lens
from splatctrl_cli.jobs.check import CheckRequest, check
from splatctrl_cli.jobs.reconstruct.reconstruct import reconstruct
from splatctrl_cli.jobs.reconstruct.reconstruction import ReconstructRequest
from splatctrl_cli.jobs.running.progress import Progress
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.records import RgbdFrame
from tests.calibration.scan import views_of
from tests.jobs.bake.baked import Said
from tests.recording.folder.make_layout import OPENGL_FROM_OPTICAL

CONFIG = Config(scene=SceneConfig(max_splats=600, first_iterations=20, refine_iterations=20))
DEPTH_ONLY = {"poses": 1.0, "depths": 1000.0}


@pytest.fixture(scope="module")
def views(sample_data: Path) -> list[RgbdFrame]:
    """Of a table from different places, in metres; every third row and column."""
    return [smaller(view) for view in views_of(sample_data)[:5]]


def smaller(frame: RgbdFrame) -> RgbdFrame:
    color, depth = (np.ascontiguousarray(image[::3, ::3]) for image in (frame.color, frame.depth))
    return replace(frame, color=color, depth=depth, intrinsics=strided_lens(frame.intrinsics, 3))


def written(folder: Path, views: list[RgbdFrame], *, poses: float, depths: float, **more: Any) -> Path:
    """The views as nerfstudio has them, with so many units of length a metre."""
    frames = []
    (folder / "images").mkdir(parents=True)
    for number, view in enumerate(views):
        T = view.T_world_camera.copy()
        T[:3, 3] *= poses
        color, depth = folder / f"images/{number:02d}.png", folder / f"images/{number:02d}_depth.png"
        cv2.imwrite(str(color), view.color[..., ::-1])
        cv2.imwrite(str(depth), np.round(view.depth * 1e4).astype(np.uint16))
        files = {name: str(path.relative_to(folder)) for name, path in (("file", color), ("depth_file", depth))}
        frames.append(
            {f"{name}_path": path for name, path in files.items()}
            | {"transform_matrix": (T @ OPENGL_FROM_OPTICAL).tolist()}
        )
    k = views[0].intrinsics
    lens = {"fl_x": k.fx, "fl_y": k.fy, "cx": k.cx + 0.5, "cy": k.cy + 0.5, "w": k.width, "h": k.height}
    content = {"camera_model": "PINHOLE", "depth_unit_scale_factor": 1e-4 * depths, **lens, "frames": frames, **more}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def made(folder: Path, said: Progress | None = None, **more: Any) -> dict[str, Any]:
    """The metrics of its map."""
    request = ReconstructRequest(source=open_source(folder), out=folder / "scene", config=CONFIG, force=True)
    return dict(reconstruct(replace(request, **more), said or Said()).metrics)


def test_another_unit_gives_the_same_map_in_metres_and_is_said(tmp_path: Path, views: list[RgbdFrame]) -> None:
    one = made(written(tmp_path / "metres", views, poses=1.0, depths=1.0))
    assert one["psnr"] > 14
    for name, factor in (("millimetres", 1000.0), ("centimetres", 100.0)):
        folder, said = written(tmp_path / name, views, poses=factor, depths=factor), Said()
        other = made(folder, said)
        assert other["psnr"] == pytest.approx(one["psnr"], abs=0.1)
        assert other["workspace"] == pytest.approx(one["workspace"], rel=1e-3)
        line = f"warning: {name}: lengths are taken as {name}: the median depth is"
        assert any(words.startswith(line) for words in said.lines)
        assert name in open_source(folder).loss.notes[0]


def refusal(folder: Path, **more: Any) -> str:
    with pytest.raises(InputError) as caught:
        made(folder, **more)
    return str(caught.value)


def test_depth_alone_in_another_unit_is_refused_by_its_median(tmp_path: Path, views: list[RgbdFrame]) -> None:
    assert "is implausible (expected 0.05 to 20 m)" in refusal(written(tmp_path / "set", views, **DEPTH_ONLY))


@pytest.mark.parametrize(
    ("poses", "depths", "factor"), [(1000, 1, "1000"), (100, 1000, "0.1"), (1000, 100, "10")], ids=str
)
def test_views_that_meet_in_another_unit_only_are_refused(
    tmp_path: Path, views: list[RgbdFrame], poses: float, depths: float, factor: str
) -> None:
    folder = written(tmp_path / "set", views, poses=poses, depths=depths)
    said = refusal(folder)
    assert re.search(rf"(do at|multiplied by) {factor}\b", said)
    unit = re.search(r"give --depth-scale (\S+) \(it is (\S+) m per count\), or correct the poses' unit", said)
    assert unit is not None and float(unit[1]) == pytest.approx(float(unit[2]) * float(factor))
    found = check(CheckRequest(paths=(folder,))).report.findings
    assert any(finding.code == "views-scale" and unit[0].partition(",")[0] in finding.remedy for finding in found)


def test_a_robot_is_in_metres_and_takes_no_guess(tmp_path: Path, views: list[RgbdFrame], plain_arm: Path) -> None:
    urdf = plain_arm / "tabletop/robot.urdf"
    said = refusal(written(tmp_path / "set", views, poses=1000.0, depths=1000.0), urdf=urdf)
    assert "lengths are taken as millimetres" in said
    assert "write poses and depth in metres, or leave the robot out" in said


def test_what_has_a_clock_is_in_metres(tmp_path: Path, views: list[RgbdFrame]) -> None:
    folder = written(tmp_path / "set", views, poses=1000.0, depths=1000.0)
    description = 'root = "set"\n[poses]\nformat = "nerfstudio"\nfile = "transforms.json"\naxes = "opengl"\n'
    path = tmp_path / "set.toml"
    path.write_text(description + "[stamps]\nrate = 10.0\n")
    assert folder.is_dir()
    with pytest.raises(InputError, match="is implausible"):
        list(open_source(path).records())

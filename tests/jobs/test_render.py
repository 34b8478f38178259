"""Pictures and videos of a scene: what a camera sees of it at a time, and where the camera is."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.evaluate.verdict import Result
from splatctrl_cli.geometry import look_at, quat_from_rotation
from splatctrl_cli.jobs import render as module
from splatctrl_cli.jobs.render import RenderSceneRequest, render_scene
from splatctrl_cli.records import Float64
from tests.jobs.stage import Stage, patch_json
from tests.refused import expect_refusal

AHEAD, ASIDE = ((1.0, 0.0, 0.5), 0.1), ((1.0, -0.3, 0.5), 0.1)  # balls; the second is on the right of it, and later
FRONT = look_at([0.0, 0.0, 0.5], [1.0, 0.0, 0.5])
BEHIND = look_at([0.0, 0.0, 0.5], [-1.0, 0.0, 0.5])
LENS = [40.0, 40.0, 31.5, 23.5, 64.0, 48.0]


@pytest.fixture
def scene(stage: Stage) -> Path:
    """One second of a ball ahead of both cameras, and from half of it on another one aside; cam1 looks away."""
    poses = {"cam0": FRONT, "cam1": BEHIND}
    lens = {"stamp_ns": 0, "intrinsics": LENS}
    frames = [{"camera": name, "T_world_camera": T.ravel().tolist()} | lens for name, T in poses.items()]
    metrics = {"cameras": [*poses], "first_frames": frames}
    return replace(stage, balls=(AHEAD,), later=(ASIDE,), metrics=metrics).scene()


def render(scene: Path, name: str = "out.png", **more: Any) -> Result:
    return render_scene(RenderSceneRequest(scene=scene, out=scene.parent / name, threads=1, force=True, **more))


def picture(scene: Path, **more: Any) -> Float64:
    """The picture (H, W, 3), RGB in [0, 1], by default of the depth."""
    image = cv2.imread(str(render(scene, **{"depth": True, **more}).out))
    return np.asarray(image[:, :, ::-1], np.float64) / 255


def columns(image: Float64) -> list[int]:
    """Columns in which there is something."""
    return np.flatnonzero(image.max(axis=(0, 2)) > 0.1).tolist()


def write_path(file: Path, times: list[float], poses: list[Float64]) -> Path:
    names = ["time_s", *module.POSE]
    rows = [[t, *T[:3, 3], *quat_from_rotation(T[:3, :3])] for t, T in zip(times, poses, strict=True)]
    if file.suffix == ".json":
        file.write_text(json.dumps([dict(zip(names, map(float, row), strict=True)) for row in rows]))
    else:
        file.write_text("\n".join([",".join(names), *(",".join(map(str, row)) for row in rows)]))
    return file


def test_a_camera_sees_the_scene_as_it_was_known_then(scene: Path) -> None:
    early, last = columns(picture(scene, at=0.1)), columns(picture(scene))
    assert 27 <= early[0] == last[0] < early[-1] <= 36 and last[-1] > 42
    assert columns(picture(scene, camera="cam1")) == []
    expect_refusal(r"--at 99.0: expected 0 to .* s of the scene", render, scene, at=99.0, error=UsageError)


def test_another_size_keeps_the_middle_and_the_vertical_view(scene: Path) -> None:
    seen = columns(picture(scene, at=0.0, size=(320, 96)))
    assert np.mean([seen[0], seen[-1]]) == pytest.approx(159.5, abs=1.0)
    assert len(seen) == pytest.approx(2 * len(columns(picture(scene, at=0.0))), abs=3)


def test_colour_is_that_of_the_splats_before_the_background(scene: Path) -> None:
    patch_json(scene / "run.json", lambda run: run | {"metrics": run["metrics"] | {"background": [0.2, 0.4, 0.6]}})
    image = picture(scene, depth=False, at=0.0)
    np.testing.assert_allclose(image[0, 0], [0.2, 0.4, 0.6], atol=0.005)
    assert image[24, 32].max() < 0.1, "a black ball"


def test_depth_is_red_near_by_blue_far_off_and_black_where_there_is_none(scene: Path) -> None:
    image = picture(scene, depth=True, at=0.0)
    assert image[0, 0].max() == 0
    assert image[24, 32, 2] > 0.15 and image[24, 32, 0] < 0.3, "the farthest"
    colors = module._color_depth(np.array([[0.0, 0.1, 2.0]], np.float32), 2.0)
    assert colors[0, 0].tolist() == [0, 0, 0] and colors[0, 1, 0] > colors[0, 1, 2] and colors[0, 2, 2] > 40


@pytest.mark.parametrize("name", ["path.csv", "path.json"])
def test_along_a_path_the_camera_turns_evenly(scene: Path, tmp_path: Path, name: str) -> None:
    path = write_path(tmp_path / name, [0.0, 0.4], [FRONT, look_at([0.0, 0.0, 0.5], [1.0, 0.6, 0.5])])
    result = render(scene, "out", path=path, fps=5.0, depth=True)
    middles = [np.mean(columns(cv2.imread(str(file)) / 255)) for file in sorted(result.out.glob("*.png"))]
    assert result.metrics["num_pictures"] == len(middles) == 3
    assert middles[0] == pytest.approx(31.5, abs=1.0) and middles[0] < middles[1] < middles[2]
    assert json.loads((result.out / "run.json").read_text())["command"] == "render"
    assert render(scene, "out.png", path=path).metrics["num_pictures"] == 1


def test_a_camera_moves_as_in_the_recording(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    poses = [(0, "cam0", FRONT), (0, "cam1", FRONT), (10**9, "cam0", BEHIND)]
    monkeypatch.setattr(module, "open_source", lambda path: SimpleNamespace(poses=lambda: iter(poses)))
    ahead, log = columns(picture(scene, at=0.0)), Path("log.mcap")
    given = ({"at": 0.0}, {}, {"camera": "cam1", "at": 0.0})
    assert [columns(picture(scene, reference=log, **more)) for more in given] == [ahead, [], ahead]
    poses[1:2] = []
    words = "--reference log.mcap: has no pose of camera cam1"
    expect_refusal(words, render, scene, reference=log, camera="cam1", error=UsageError)


def test_a_video_has_a_picture_for_each_time(scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    av = pytest.importorskip("av")
    out = scene.parent / "out.mp4"
    assert main(["render", str(scene), "--depth", "--fps", "4", "--size", "96x72", "-o", str(out)]) == 0
    assert capsys.readouterr().out == f"{out}: 96x72, pictures: 5\n"
    with av.open(str(out)) as container:
        (stream,) = container.streams.video
        assert (stream.frames, stream.width, stream.height, stream.average_rate) == (5, 96, 72, 4)
        frames = [frame.to_ndarray(format="rgb24") / 255 for frame in container.decode(stream)]
    assert len(columns(frames[-1])) > len(columns(frames[0])) > 0


def test_a_scene_without_times_has_one_picture(scene: Path) -> None:
    patch_json(scene / "run.json", lambda run: run | {"metrics": run["metrics"] | {"has_clock": False}})
    assert render(scene, "still").metrics["num_pictures"] == 1
    expect_refusal("--at 0.5: .* has no times; leave it out", render, scene, at=0.5, error=UsageError)


@pytest.mark.parametrize(
    ("name", "more", "words"),
    [
        ("out.png", {"camera": "cam7"}, "--camera cam7: expected one of: cam0, cam1"),
        ("out.gif", {}, r"out.gif: expected a name that ends in .png or .mp4"),
        ("out.png", {"at": -0.5}, "--at -0.5: expected 0 to 1 s of the scene"),
        (
            "out.mp4",
            {"size": (65, 48)},
            "expected an even width and height of a video, got 65x48; give --size 64x48",
        ),
        ("out.mp4", {}, r"videos need the library av: .*; pip install 'splatctrl-cli\[video\]'"),
    ],
)
def test_what_cannot_be_rendered_is_refused(
    scene: Path, monkeypatch: pytest.MonkeyPatch, name: str, more: dict[str, Any], words: str
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    expect_refusal(words, render, scene, name, error=UsageError, **more)
    assert not (scene.parent / name).exists()


HEADER = "time_s,x,y,z,qx,qy,qz,qw\n"


@pytest.mark.parametrize(
    "text",
    {
        "empty": "",
        "no row": HEADER,
        "no pose": "time_s,x\n0,1",
        "no number": f"{HEADER}0,a,0,0,0,0,0,1",
        "not finite": f"{HEADER}0,nan,0,0,0,0,0,1",
        "no quaternion": f"{HEADER}0,0,0,0,0,0,0,0",
        "twice one time": f"{HEADER}0,0,0,0,0,0,0,1\n0,0,0,0,0,0,0,1",
    }.values(),
)
def test_a_file_that_is_no_path_is_refused(scene: Path, tmp_path: Path, text: str) -> None:
    file = tmp_path / "path.csv"
    file.write_text(text)
    expect_refusal(
        r"path.csv: no path of a camera: .*; expected rows of time_s, x, y",
        render,
        scene,
        path=file,
        error=InputError,
    )

"""``splatctrl reconstruct``: small logs and scans, with people, and with something wrong."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.formats.scene.scene_folder import open_scene
from splatctrl_cli.formats.splat.splats import read_ply
from splatctrl_cli.geometry import quat_from_rotation
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64, Label, RgbdFrame
from splatctrl_cli.scene.recording_consistency import CAUSES
from tests.cli.here import splatctrl
from tests.recording.log.make_log import LogRecipe, make_log
from tests.scene.wall import INTRINSICS, frame

FAST = ["--max-splats", "800", "--set", "scene.first_iterations=30", "--set", "scene.iterations_per_step=5", "-q"]


def reconstruct(small_recording: Path, out: Path, *options: str) -> int:
    robot = ["--urdf", str(small_recording / "robot.urdf"), "--spheres", str(small_recording / "robot_spheres.yaml")]
    log = [str(small_recording / "log.mcap"), "--cameras", "cam0,cam1"]
    return main(["reconstruct", *log, *robot, "-o", str(out), *FAST, *options])


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "run.json"
    }


@pytest.mark.usefixtures("unchecked")
def test_a_robot_at_a_base_makes_the_map_of_one_at_the_origin_moved_there(
    small_recording: Path, tmp_path: Path
) -> None:
    """The same images by cameras turned and moved with the robot, by half a metre and a right angle."""
    T = np.array([[0, -1, 0, 0.5], [1, 0, 0, -0.3], [0, 0, 1, 0.8], [0, 0, 0, 1]])

    def numbers(pose: Float64) -> str:
        return ",".join(f"{value:.17g}" for value in [*pose[:3, 3], *quat_from_rotation(pose[:3, :3])])

    frames = open_source(small_recording / "log.mcap", SourceOptions(cameras=("cam0", "cam1"))).records()
    poses = {each.camera: T @ each.T_world_camera for each in frames if isinstance(each, RgbdFrame)}
    moved = [word for name, pose in poses.items() for word in ("--camera-pose", f"{name}={numbers(pose)}")]
    assert reconstruct(small_recording, tmp_path / "origin") == 0
    assert reconstruct(small_recording, tmp_path / "moved", f"--base={numbers(T)}", *moved) == 0
    here, there = (metrics(tmp_path / name) for name in ("origin", "moved"))
    assert {name: there[name] for name in ("self_mask_residual_mm", "robot_splats", "psnr")} == {
        "self_mask_residual_mm": pytest.approx(here["self_mask_residual_mm"], abs=0.1),
        "robot_splats": pytest.approx(here["robot_splats"], rel=0.25),
        "psnr": pytest.approx(here["psnr"], abs=0.5),
    }
    scene = read_ply(tmp_path / "moved" / "splats.ply")[0].centers
    expected = read_ply(tmp_path / "origin" / "splats.ply")[0].centers @ T[:3, :3].T + T[:3, 3]
    distance = np.linalg.norm(scene[:, None] - expected[None], axis=2).min(axis=1)
    assert np.median(distance) < 0.04  # of 800 splats, drawn anew
    assert reconstruct(small_recording, tmp_path / "astray", *moved) == 0
    reasons = open_scene(tmp_path / "astray").run["verdict"]["reasons"]
    assert "no camera sees the robot where its joints put it" in {reason["sentence"] for reason in reasons}


def test_one_thread_and_two_give_the_same_bytes(small_recording: Path, tmp_path: Path) -> None:
    for name, threads in (("one", "1"), ("two", "2")):
        assert reconstruct(small_recording, tmp_path / name, "--threads", threads) == 0
    one = contents(tmp_path / "one")
    assert set(one) > {"splats.ply", "occupancy.npz", "audit.jsonl", "snapshots.csv", "checkpoint/state.npz"}
    assert one == contents(tmp_path / "two")
    assert reconstruct(small_recording, tmp_path / "other", "--seed", "1") == 0
    assert contents(tmp_path / "other")["splats.ply"] != one["splats.ply"]


def test_views_that_trained_a_scene_are_not_scored_as_held_out(
    small_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene, dtu = str(tmp_path / "scene"), str(small_recording / "dtu")
    fast = [*FAST, "--set", "scene.refine_iterations=20"]
    assert main(["reconstruct", "--dtu", dtu, "--holdout", "1", "-o", scene, *fast]) == 0
    assert main(["score", scene, "--dtu", dtu, "--holdout", "1", "-q"]) == 0
    capsys.readouterr()
    assert main(["score", scene, "--dtu", dtu, "--holdout", "2", "-q"]) == 2
    assert "trained the scene" in capsys.readouterr().err


FEW = [
    *("--box=-0.45,-0.35,-0.05,0.45,0.35,0.6", "--set", "scene.first_iterations=5"),
    *("--set", "scene.iterations_per_step=2", "--set", "scene.refine_iterations=10", "--max-splats", "1500"),
]


def write_folder(folder: Path, frames: Sequence[RgbdFrame], *, has_clock: bool = True, noise: float = 1e-6) -> Path:
    """An image folder of the frames, each camera's numbered, and its description. By noise, a share of one pixel's
    depth, no two depth images are the same.
    """
    folder.mkdir()
    k = INTRINSICS
    lens = f"width = {k.width}\nheight = {k.height}\nfx = {k.fx}\nfy = {k.fy}\ncx = {k.cx}\ncy = {k.cy}\n"
    text = '[depth]\nencoding = "float32"\nscale = 1.0\n[poses]\nformat = "matrix-files"\nfile = ""\n'
    text += "[stamps]\nrate = 5.0\n" if has_clock else ""
    for camera in sorted({one.camera for one in frames}):
        own = [one for one in frames if one.camera == camera]
        for number, one in enumerate(own):
            name = f"{folder}/{camera}-{number}"
            cv2.imwrite(f"{name}.png", cv2.cvtColor(one.color, cv2.COLOR_RGB2BGR))
            depth = one.depth.copy()
            depth[0, 0] *= np.float32(1.0 + noise * number)
            np.save(f"{name}.npy", depth)
            np.savetxt(f"{name}.txt", one.T_world_camera)
        text += f'[[cameras]]\nname = "{camera}"\n{lens}'
        text += f'color = "{camera}-*.png"\ndepth = "{camera}-*.npy"\nposes = "{camera}-*.txt"\n'
    (folder / "views.toml").write_text(text)
    return folder / "views.toml"


def reconstruct_folder(description: Path, out: Path, *options: str) -> int:
    return main(["reconstruct", str(description), "-o", str(out), *FEW, *options])


def audit(scene: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in (scene / "audit.jsonl").read_text().splitlines()]


def metrics(scene: Path) -> dict[str, object]:
    found: dict[str, object] = open_scene(scene).run["metrics"]
    return found


def test_a_frame_without_depth_is_counted_and_seeds_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    views = [frame() for _ in range(4)]
    views[2].depth[:] = 0.0
    assert reconstruct_folder(write_folder(tmp_path / "in", views), tmp_path / "scene", "-q") == 0
    assert "  note: depth: 1 frame has no depth, and seeded no splats" in capsys.readouterr().out
    counts = [(row["without_depth"], len(row["blind"])) for row in audit(tmp_path / "scene")]
    assert (counts, metrics(tmp_path / "scene")["frames_without_depth"]) == ([(0, 0), (0, 0), (1, 1), (0, 0)], 1)


def test_frames_that_repeat_their_depth_are_left_out_and_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_folder(tmp_path / "in", [frame() for _ in range(4)], noise=0.0)
    assert reconstruct_folder(folder, tmp_path / "scene", "-q") == 0
    assert (
        "  note: depth: camera cam0: left out 3 frames that repeat the depth before them" in capsys.readouterr().out
    )
    found = metrics(tmp_path / "scene")
    assert (found["time_steps"], found["repeated_frames"]) == (1, {"cam0": 3})


def test_depth_that_is_not_finite_is_counted_and_is_none(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    odd, plain = [frame() for _ in range(2)], [frame() for _ in range(2)]
    for view, values in ((odd[1], [np.nan, np.inf, -np.inf, -1.0]), (plain[1], [0.0] * 4)):
        view.depth[20, 10:14] = values
    assert reconstruct_folder(write_folder(tmp_path / "odd", odd), tmp_path / "a", "-q") == 0
    assert (
        "  note: input: 4 pixels of depth are NaN, infinite, negative or 65535: read as no return"
        in capsys.readouterr().out
    )
    assert reconstruct_folder(write_folder(tmp_path / "plain", plain), tmp_path / "b", "-q") == 0
    assert "infinite" not in capsys.readouterr().out
    assert audit(tmp_path / "a") == audit(tmp_path / "b")


def test_a_camera_that_jumps_is_refused_by_distance_and_stamps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    views = [frame(), frame(x=0.1), frame(x=0.1)]
    views[2].T_world_camera[0, 3] += 3.0
    description = write_folder(tmp_path / "in", views)
    assert reconstruct_folder(description, tmp_path / "scene", "-q") == 4
    err = capsys.readouterr().err
    assert "camera cam0 jumps by 3.00 m from stamp 200000000 to 400000000 ns, 0.2 s later" in err
    assert "--max-pose-jump 3.01" in err and err.count("\n") == 1
    assert not (tmp_path / "scene").exists()
    assert reconstruct_folder(description, tmp_path / "scene", "-q", "--max-pose-jump", "3.01") == 0
    still = write_folder(tmp_path / "still", views, has_clock=False)  # views of a still scene may lie anywhere
    assert reconstruct_folder(still, tmp_path / "other", "-q") == 0
    assert reconstruct_folder(still, tmp_path / "none", "-q", "--max-pose-jump", "0") == 2


def two_cameras(offset: float) -> list[RgbdFrame]:
    views = [frame(block=0.2), frame(block=0.2, x=0.05, camera="cam1")]
    views[1].T_world_camera[2, 3] += offset
    return views


@pytest.mark.parametrize("has_clock", [True, False])
def test_cameras_that_disagree_are_refused_before_anything_is_fitted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], has_clock: bool
) -> None:
    description = write_folder(tmp_path / "in", two_cameras(0.09), has_clock=has_clock)
    assert reconstruct_folder(description, tmp_path / "scene", "-q") == 4
    err = capsys.readouterr().err
    assert "camera cam0 and cam1: depths disagree by 90 mm" in err and "expected at most 30 mm" in err
    assert CAUSES in err and "--cameras cam0" in err and "--allow-disagreement" in err
    assert err.count("\n") == 1
    assert [p.name for p in tmp_path.iterdir()] == ["in"]
    assert reconstruct_folder(description, tmp_path / "one", "-q", "--cameras", "cam0") == 0
    capsys.readouterr()
    assert reconstruct_folder(description, tmp_path / "both", "--allow-disagreement") == 0
    assert "warning: views.toml: camera cam0 and cam1: depths disagree by 90 mm" in capsys.readouterr().err
    assert metrics(tmp_path / "both")["disagreement"] == {"cam0 and cam1": 0.09}
    close = write_folder(tmp_path / "close", two_cameras(0.012), has_clock=has_clock)  # a sensor's error
    assert reconstruct_folder(close, tmp_path / "scene", "-q") == 0


def test_a_budget_too_small_for_the_first_frames_is_warned_about_with_one_that_is_not(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    description = write_folder(tmp_path / "in", [frame()])
    assert reconstruct_folder(description, tmp_path / "small", "--max-splats", "100") == 0
    err = capsys.readouterr().err
    assert "warning: 100 splats are too few for the first frames" in err
    enough = err.split("--max-splats ")[1].split()[0]
    assert reconstruct_folder(description, tmp_path / "enough", "--max-splats", enough) == 0
    assert "too few" not in capsys.readouterr().err


def test_colour_and_depth_of_different_sizes_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    description = write_folder(tmp_path / "in", [replace(frame(), depth=np.ones((30, 40), np.float32))])
    assert reconstruct_folder(description, tmp_path / "scene", "-q") == 4
    assert "cam0-0.npy: expected 80x60 as described, got 40x30" in capsys.readouterr().err


MASK = ("--human-topic", "cam0=/cam0/people/mask")


def test_who_the_masks_show_is_human_in_scene_and_field(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(mask_every=1, num_frames=3))
    splatctrl("ingest", log, *MASK, "-o", tmp_path / "x.capture")
    for name, source in (("a", (log, *MASK)), ("b", (tmp_path / "x.capture",))):
        few = ("--max-splats", "300", "--set", "scene.first_iterations=20")
        splatctrl("reconstruct", *source, "-o", tmp_path / name, *few)
    scene = open_scene(tmp_path / "a")
    is_human = scene.splats().labels == Label.HUMAN
    assert 10 < is_human.sum() < 0.6 * len(is_human)
    assert (open_scene(tmp_path / "b").splats().labels == scene.splats().labels).all()
    assert audit(tmp_path / "a")[-1]["human"] == is_human.sum()
    assert np.count_nonzero(scene.occupancy().entity & Label.HUMAN) > 10
    splatctrl("sdf-bake", tmp_path / "a", "-o", tmp_path / "field")
    splatctrl("sdf-bake", tmp_path / "a", "--include", "none", "-o", tmp_path / "without")
    used = [json.loads((tmp_path / name / "field.json").read_text())["splats_used"] for name in ("field", "without")]
    assert [counts["human"] for counts in used] == [is_human.sum(), 0]

"""``splatctrl score`` on scenes and recordings whose scores are known."""

import csv
import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.datasets.dtu import DtuView, write_dtu
from splatctrl_cli.geometry import look_at
from splatctrl_cli.jobs import score, score_reference
from splatctrl_cli.records import Float64, Intrinsics, Label, LossReport, OccupancyGrid, Record, RgbdFrame, SplatSet
from splatctrl_cli.scene.render import render
from splatctrl_cli.splat_files.splats import write_ply

INTRINSICS = Intrinsics(fx=60.0, fy=60.0, cx=31.5, cy=23.5, width=64, height=48)
SECOND = 1_000_000_000


def wall(brightness: float = 0.5) -> SplatSet:
    """A dense wall in the plane x = 1, of one colour."""
    y, z = (axis.ravel() for axis in np.meshgrid(np.arange(-0.8, 0.8, 0.02), np.arange(-0.8, 0.8, 0.02)))
    num = len(y)
    return SplatSet(
        centers=np.column_stack([np.ones(num), y, z]).astype(np.float32),
        radii=np.full(num, 0.02, np.float32),
        colors=np.full((num, 3), brightness, np.float32),
        opacities=np.full(num, 0.95, np.float32),
        labels=np.zeros(num, np.uint8),
        density=np.zeros(num, np.float32),
    )


def frame(stamp_ns: int, camera: str, T_world_camera: Float64, color_offset: float = 0.0) -> RgbdFrame:
    """What a camera records of the wall; its colour is off by `color_offset`."""
    rendering = render(wall(), INTRINSICS, T_world_camera, threads=1)
    color = np.clip(255 * (rendering.color + color_offset), 0, 255)
    return RgbdFrame(
        stamp_ns=stamp_ns,
        camera=camera,
        color=np.round(color).astype(np.uint8),
        depth=rendering.normalised_depth(),
        intrinsics=INTRINSICS,
        T_world_camera=T_world_camera,
    )


FRONT = look_at([0.0, 0.0, 0.0], [1.0, 0.0, 0.0])
SIDE = look_at([0.0, 0.1, 0.0], [1.0, 0.1, 0.0])
AWAY = look_at([0.0, 0.0, 0.0], [-1.0, 0.0, 0.0])


@dataclass(kw_only=True)
class FakeSource:
    """A recording from a list of frames."""

    frames: list[RgbdFrame]
    has_clock: bool = True
    name: str = "fake"
    joint_names: tuple[str, ...] = ()
    loss: LossReport = field(default_factory=LossReport)

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(f.camera for f in self.frames))

    def records(self) -> Iterator[Record]:
        return iter(self.frames)

    def digests(self) -> dict[str, str]:
        return {"fake": "0"}


@dataclass(kw_only=True)
class FakeSnapshot:
    """A moment of which the scene knows."""

    stamp_ns: int


@dataclass(kw_only=True)
class FakeScene:
    """A scene whose wall is dark at first and right from second 2 on."""

    has_clock: bool = True
    cameras: tuple[str, ...] = ("cam0",)
    snapshots: tuple[FakeSnapshot, ...] = (FakeSnapshot(stamp_ns=SECOND), FakeSnapshot(stamp_ns=2 * SECOND))
    training_stamps_ns: frozenset[int] = frozenset()
    is_anisotropic: bool = False
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    run: dict[str, Any] = field(default_factory=lambda: {"config": {"occupancy": {"free_below": 0.3}}})

    def occupancy(self) -> OccupancyGrid:
        """One voxel of free space that holds the left half of the wall."""
        return OccupancyGrid(
            origin=np.array([1.0, 5.0, 0.0]),
            voxel=10.0,
            log_odds=np.full((1, 1, 1), -2.0, np.float32),
            num_updates=np.ones((1, 1, 1), np.uint16),
            entity=np.zeros((1, 1, 1), np.uint8),
        )

    def unrepresented_at(self, stamp_ns: int | None) -> None:
        return None

    def splats(self) -> SplatSet:
        return wall()

    def splats_at(self, stamp_ns: int) -> SplatSet:
        return wall(0.4 if stamp_ns < 2 * SECOND else 0.5)


FRAMES = [
    *(frame(0, "cam0", FRONT), frame(0, "cam3", SIDE)),
    *(frame(SECOND, "cam0", FRONT), frame(SECOND, "cam3", SIDE)),
    *(frame(2 * SECOND, "cam3", SIDE, 0.01), frame(3 * SECOND, "cam3", AWAY)),
]


@pytest.fixture
def scored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scene, and the recording FRAMES."""
    (tmp_path / "scene").mkdir()
    write_ply(tmp_path / "scene" / "splats.ply", wall(), {})
    set_up(monkeypatch, FakeScene(), FakeSource(frames=FRAMES))
    return tmp_path


def set_up(monkeypatch: pytest.MonkeyPatch, scene: FakeScene, recording: FakeSource) -> None:
    monkeypatch.setattr(score, "open_scene", lambda path: scene)
    monkeypatch.setattr(score_reference, "open_source", lambda path, options: recording)


def run(folder: Path, *arguments: object) -> int:
    return main(["score", str(folder / "scene"), "--reference", "fake.mcap", *map(str, arguments)])


def result_of(capsys: pytest.CaptureFixture[str]) -> Any:
    return json.loads(capsys.readouterr().out)


def test_views_are_rendered_from_the_newest_snapshot_and_early_ones_are_counted(
    scored: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(scored, "--json") == 0
    result = result_of(capsys)
    assert result["cameras"] == ["cam3"]
    assert result["skipped_views"] == ["cam3-0000"]
    dark, right, away = result["views"]
    assert (dark["view"], right["view"], away["view"]) == ("cam3-0001", "cam3-0002", "cam3-0003")
    assert dark["psnr_all"] == pytest.approx(20.0, abs=0.6), "0.4 instead of 0.5"
    assert right["psnr_all"] == pytest.approx(40.0, abs=2.5), "off by 0.01, and rounded to 8 bits"
    assert right["depth_median_all"] < 1e-6
    assert result["metrics"]["num_views"] == 3
    assert result["metrics"]["num_skipped"] == 1


def test_seen_pixels_are_those_of_the_surface_that_the_training_camera_measured(
    scored: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(scored, "--json") == 0
    _, side, away = result_of(capsys)["views"]
    assert side["seen_share"] == pytest.approx(58 / 64, abs=0.03), "the view is moved by 0.1 m, 6 pixels"
    assert away["seen_share"] == 0.0
    assert away["psnr_seen"] is None
    assert away["depth_median_all"] is None


def test_final_splats_serve_all_views_when_asked(scored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(scored, "--json", "--snapshots", "final") == 0
    first, *_ = result_of(capsys)["views"]
    assert first["psnr_all"] > 50


def test_without_a_clock_every_view_is_scored_from_the_final_splats(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up(monkeypatch, FakeScene(has_clock=False, snapshots=()), FakeSource(frames=FRAMES, has_clock=False))
    assert run(scored, "--json") == 0
    result = result_of(capsys)
    assert result["snapshots"] == "final"
    assert result["metrics"]["num_skipped"] == 0
    assert len(result["views"]) == 4


@pytest.mark.parametrize("label", [None, Label.ROBOT])
def test_a_scene_without_a_splat_that_counts_is_not_evaluable_and_leaves_nothing(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], label: Label | None
) -> None:
    full = wall()
    splats = full.select(np.zeros(len(full), bool)) if label is None else with_label(full, label)
    monkeypatch.setattr(FakeScene, "splats", lambda scene: splats)
    assert run(scored, "-o", scored / "out") == 5
    err = capsys.readouterr().err
    assert err == (
        f"splatctrl: splats: none of {len(splats)} is labelled object, human; give a scene that has some;"
        " sdf-bake --include takes other labels\n"
    )
    assert [path.name for path in scored.iterdir()] == ["scene"]


def with_label(splats: SplatSet, label: Label) -> SplatSet:
    return replace(splats, labels=np.full(len(splats), label, np.uint8))


def test_the_table_shows_each_view_and_the_mean(scored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(scored) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "score: PASSED (3 views)"
    table = lines[lines.index("") + 1 :]
    assert table[0].split("  ")[0] == "view"
    assert [line.split()[0] for line in table[2:5]] == ["cam3-0001", "cam3-0002", "cam3-0003"]
    assert table[6].startswith("mean of 3")
    assert "3 views scored, 1 before the first snapshot" in lines[-2]
    assert lines[-1].startswith("in front: ")


def test_the_output_folder_holds_scores_rows_pictures_and_the_run(scored: Path) -> None:
    assert run(scored, "-o", scored / "score") == 0
    names = sorted(path.name for path in (scored / "score").iterdir())
    assert names == ["cam3_best_worst.png", "run.json", "score.json", "views.csv"]
    rows = list(csv.DictReader((scored / "score" / "views.csv").read_text().splitlines()))
    score = json.loads((scored / "score" / "score.json").read_text())
    assert [row["view"] for row in rows] == [view["view"] for view in score["views"]]
    assert float(rows[0]["psnr_all"]) == score["views"][0]["psnr_all"]
    assert rows[2]["psnr_seen"] == ""
    run_json = json.loads((scored / "score" / "run.json").read_text())
    assert run_json["metrics"] == score["metrics"]
    assert set(run_json["inputs"]) == {"fake", "scene/splats.ply"}


def test_an_output_that_exists_is_refused_before_anything_is_rendered(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(FakeScene, "splats_at", lambda scene, stamp_ns: pytest.fail("rendered"))
    (scored / "score").mkdir()
    assert run(scored, "-o", scored / "score") == 2
    assert "score: already exists; give --force" in capsys.readouterr().err


def test_a_gate_that_fails_leaves_the_scores_and_exits_1(scored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(scored, "-o", scored / "score", "--require", "psnr_seen>=20", "--require", "psnr_all>=90") == 5
    assert "psnr_all is" in capsys.readouterr().err
    assert (scored / "score" / "score.json").is_file()


def test_a_gate_on_an_unknown_metric_is_refused_before_anything_is_rendered(
    scored: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FakeScene, "splats_at", lambda scene, stamp_ns: pytest.fail("rendered"))
    assert run(scored, "--require", "num_skipped<=1", "--require", "sharpness>=1") == 2


def test_a_view_whose_psnr_is_infinite_lets_no_gate_pass(scored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(scored, "--json", "--require", "psnr_all>=1") == 5
    done = capsys.readouterr()
    assert json.loads(done.out)["views"][2]["psnr_all"] is None, "a black view of nothing, rendered black"
    assert "psnr_all is unknown" in done.err


def test_damaged_input_exits_3(scored: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    set_up(monkeypatch, FakeScene(), FakeSource(frames=FRAMES, loss=LossReport(damaged=1)))
    assert run(scored) == 3


def test_a_training_camera_is_scored_only_when_allowed(scored: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(scored, "--cameras", "cam0") == 2
    assert "cam0 trained the scene" in capsys.readouterr().err
    assert run(scored, "--cameras", "cam0", "--allow-training", "--json") == 0
    (view,) = result_of(capsys)["views"]
    assert view["seen_share"] == view["valid_share"]


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--cameras", "cam9"], 4, "fake.mcap: no camera 'cam9'; use one of: cam0, cam3"),
        (["--require", "sharpness>=1"], 2, "unknown metric; known here: num_views, valid_share, "),
        (["--require", "sharpness>=1"], 2, ", chamfer, accuracy_beyond, "),
        (["--require", "psnr_sen>=1"], 2, "unknown metric; did you mean psnr_seen?"),
        (["--require", "psnr_seen"], 2, "--require psnr_seen: expected METRIC>=NUMBER"),
        (["--require", "psnr_seen>=nan"], 2, "--require psnr_seen>=nan: expected METRIC>=NUMBER"),
        (["--scan", "scan1"], 2, "--scan scan1: only with --dtu"),
        (["--dtu", "root"], 2, "not allowed with argument"),
    ],
)
def test_bad_usage_names_the_thing_and_the_choices(
    scored: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], code: int, message: str
) -> None:
    assert run(scored, *arguments) == code
    assert message in capsys.readouterr().err


def test_a_recording_before_the_first_snapshot_cannot_be_scored(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up(monkeypatch, FakeScene(), FakeSource(frames=FRAMES[:2]))
    assert run(scored, "-o", scored / "score") == 5
    assert "no view of cam3 to score; 1 lie before the first snapshot" in capsys.readouterr().err
    assert not (scored / "score").exists()


@pytest.mark.parametrize(
    "frames",
    [
        [frame(2 * SECOND, "cam3", SIDE)],
        [frame(2 * SECOND, "cam0", AWAY), frame(2 * SECOND, "cam3", SIDE)],
        [frame(2 * SECOND, "cam0", FRONT), frame(2 * SECOND, "cam3", AWAY)],
    ],
)
def test_views_of_which_no_training_camera_saw_a_pixel_cannot_be_scored(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], frames: list[RgbdFrame]
) -> None:
    set_up(monkeypatch, FakeScene(), FakeSource(frames=frames))
    assert run(scored, "-o", scored / "score") == 5
    done = capsys.readouterr()
    assert "no pixel of cam3 was seen by a training camera (cam0); is it the same world and the same" in done.err
    assert done.out == ""
    assert not (scored / "score").exists()


def test_a_single_view_is_counted_as_one(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up(monkeypatch, FakeScene(), FakeSource(frames=FRAMES[2:4]))
    assert run(scored) == 0
    assert "\n1 view scored, 0 before" in capsys.readouterr().out


def test_a_recording_of_training_cameras_alone_is_refused(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up(monkeypatch, FakeScene(cameras=("cam0", "cam3")), FakeSource(frames=FRAMES))
    assert run(scored) == 2
    assert (
        "each camera is called like one that trained the scene (cam0, cam3); give the views"
        in capsys.readouterr().err
    )


def test_a_dtu_scan_is_scored_on_the_views_held_out(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    views = [
        DtuView(name=f.camera, color=f.color, depth=f.depth, intrinsics=f.intrinsics, T_world_camera=f.T_world_camera)
        for f in (frame(0, "a", FRONT), frame(1, "b", SIDE, 0.1), frame(2, "c", FRONT))
    ]
    write_dtu(scored / "dtu", "scan1", views)
    set_up(monkeypatch, FakeScene(cameras=("camera",), has_clock=False, snapshots=()), FakeSource(frames=[]))
    arguments = ["score", str(scored / "scene"), "--dtu", str(scored / "dtu"), "--holdout", "1", "--json"]
    assert main(arguments) == 0
    result = result_of(capsys)
    (view,) = result["views"]
    assert (view["view"], view["camera"], result["training_cameras"]) == ("holdout-0001", "holdout", ["camera"])
    assert view["psnr_seen"] == pytest.approx(20.0, abs=0.6)
    assert view["depth_median_seen"] < 1e-5
    assert view["seen_share"] > 0.8


def test_a_dtu_scan_without_views_held_out_is_refused(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    f = frame(0, "a", FRONT)
    view = DtuView(name="a", color=f.color, depth=f.depth, intrinsics=f.intrinsics, T_world_camera=f.T_world_camera)
    write_dtu(scored / "dtu", "scan1", [view])
    set_up(monkeypatch, FakeScene(cameras=("camera",)), FakeSource(frames=[]))
    assert main(["score", str(scored / "scene"), "--dtu", str(scored / "dtu")]) == 2
    assert "each camera is called like one that trained the scene (camera); give the views" in capsys.readouterr().err


def test_a_folder_that_is_no_scene_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["score", str(tmp_path), "--reference", "fake.mcap"]) == 4
    assert "expected a scene folder with splats.ply and run.json" in capsys.readouterr().err


def test_what_stands_in_front_and_in_free_space_is_scored_and_gated(
    scored: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(scored, "--json") == 0
    metrics = result_of(capsys)["metrics"]
    assert metrics["in_front_seen"] == metrics["in_front_all"] == 0.0
    assert metrics["free_mass"] is None  # no occupancy.npz
    (scored / "scene" / "occupancy.npz").touch()
    assert run(scored, "--json") == 0
    assert result_of(capsys)["metrics"]["free_mass"] == pytest.approx(0.5, abs=0.05)
    assert run(scored, "--require", "free_mass<=0.1") == 1
    out = capsys.readouterr().out
    assert "of the splats' mass is in space observed free" in out
    assert "in front" in out


def test_a_render_before_the_recorded_surface_is_in_front(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    late = frame(3 * SECOND, "cam3", SIDE)
    late.depth[late.depth > 0] += 0.05
    seen = frame(3 * SECOND, "cam0", FRONT)
    set_up(monkeypatch, FakeScene(), FakeSource(frames=[seen, frame(2 * SECOND, "cam3", SIDE), late]))
    assert run(scored, "--json") == 0
    views = result_of(capsys)["views"]
    assert [view["in_front_all"] for view in views] == [0.0, 1.0]


def test_what_no_splat_covers_shows_the_background_of_the_scene(
    scored: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    set_up(monkeypatch, FakeScene(background=(0.0, 1.0, 0.0)), FakeSource(frames=FRAMES))
    assert run(scored, "--json") == 0
    away = result_of(capsys)["views"][2]
    assert away["psnr_all"] == pytest.approx(10 * np.log10(3), abs=0.01), "green before a black view of nothing"

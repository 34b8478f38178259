"""The scene folder reads back what was written, and says what is wrong with others."""

import json
from dataclasses import make_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.files.output import write_json
from splatctrl_cli.formats.arrays import read_arrays, savez
from splatctrl_cli.formats.scene.scene_folder import open_scene
from splatctrl_cli.formats.scene.scene_writer import CHECKPOINT, SceneWriter, read_checkpoint
from splatctrl_cli.formats.scene.voxel_file import (
    read_known_occupancy,
    read_occupancy,
    read_seen,
    read_states,
    read_unrepresented,
    write_occupancy,
    write_states,
)
from splatctrl_cli.recording.source import describe
from splatctrl_cli.records import Label, SplatSet
from splatctrl_cli.voxels import SWEPT, EvidenceClass, LostEdges, OccupancyGrid, Unseen, VoxelState
from tests.plain import known, plain_grid, plain_splats
from tests.refused import expect_refusal

Row = make_dataclass("Row", [("stamp_ns", int)])
FREE_BELOW = "run.json: config.occupancy.free_below: expected what reconstruct writes"
STATE = {"a": np.arange(4), "scalar": np.array(2.5)}


def splats(count: int) -> SplatSet:
    rng = np.random.default_rng(count)
    centers, radii = rng.normal(size=(count, 3)), rng.uniform(0.01, 0.02, count)
    return plain_splats(centers, radii, colors=rng.uniform(0, 1, (count, 3)), opacities=rng.uniform(0.1, 0.9, count))


def grid() -> OccupancyGrid:
    rng, shape = np.random.default_rng(0), (3, 4, 5)
    log_odds, num_updates = rng.normal(size=shape), rng.integers(0, 9, shape)
    return plain_grid(
        shape, 0.05, [-0.1, 0.2, 0.3], log_odds=log_odds, num_updates=num_updates, entity=rng.integers(0, 4, shape)
    )


def written(folder: Path) -> Path:
    folder.mkdir()
    writer = SceneWriter(folder, {"frame": "world"})
    for stamp in (100, 200, 300):
        step(writer, stamp, stamp // 100)
    finish(writer, {})
    write_json(folder / "run.json", {"metrics": {"cameras": ["cam0"], "has_clock": True, "stamp_ns": 300}})
    return folder


def step(writer: SceneWriter, stamp: int, num: int) -> None:
    """A row of the audit, and a snapshot of so many splats."""
    writer.audit(Row(stamp))
    writer.snapshot(stamp, splats(num), known(grid(), stamp), grid().states(0.3, 0.7))


def finish(writer: SceneWriter, progress: dict[str, Any]) -> None:
    writer.finish(300, splats(3), known(grid(), 300))
    writer.checkpoint(progress, STATE, is_last=True)


def test_a_scene_is_known_by_its_newest_snapshot(tmp_path: Path) -> None:
    scene = open_scene(written(tmp_path / "scene"))
    assert [len(scene.splats_at(stamp)) for stamp in (100, 199, 200, 10_000)] == [1, 1, 2, 3]
    expect_refusal("no snapshot", scene.splats_at, 99, error=NotEvaluableError)
    assert (scene.cameras, scene.stamp_ns) == (("cam0",), 300)


def test_occupancy_comes_back_bit_by_bit_also_without_lost_edges(tmp_path: Path) -> None:
    path, want = tmp_path / "occupancy.npz", grid()
    write_occupancy(path, known(want))
    again = read_occupancy(path)
    assert again.voxel == want.voxel
    for name in ("origin", "log_odds", "num_updates", "entity"):
        assert getattr(again, name).tobytes() == getattr(want, name).tobytes()
    arrays = read_arrays(path, most=1 << 20)
    header = json.loads(str(arrays.pop("header")))
    del header["edges"], arrays["edges"]
    savez(path, {**arrays, "header": np.array(json.dumps(header))})
    for found in (read_seen(path), read_known_occupancy(path)):
        assert len(found.edges.radii) == 0


def test_a_run_that_goes_on_drops_what_came_after_its_checkpoint(tmp_path: Path) -> None:
    straight, cut = tmp_path / "straight", tmp_path / "cut"
    for folder in (straight, cut):
        folder.mkdir()
        writer = SceneWriter(folder, {"frame": "world"})
        for stamp in (100, 200):
            step(writer, stamp, 2)
        writer.checkpoint({"num_read": 2}, STATE)
        if folder is cut:
            step(writer, 999, 9)
            writer.settle()
            for name in ("audit.jsonl", "snapshots/000003.ply", f"{CHECKPOINT}.new", "splats.ply", "run.json"):
                with (folder / name).open("ab") as stream:
                    stream.write(b'{"stamp')
            again = read_checkpoint(folder)
            assert again.progress == {"num_read": 2}
            assert again.state["scalar"].shape == () and again.state["a"].tolist() == [0, 1, 2, 3]
            writer = SceneWriter(folder, {"frame": "world"}, again)
            assert [row["stamp_ns"] for row in writer.audited()] == [100, 200]
        step(writer, 300, 3)
        finish(writer, {"num_read": 3})
    files = {p.relative_to(cut): p.read_bytes() for p in cut.rglob("*") if p.is_file()}
    assert files == {p.relative_to(straight): p.read_bytes() for p in straight.rglob("*") if p.is_file()}


@pytest.mark.parametrize("name", ["audit.jsonl", "snapshots/000001.npz", CHECKPOINT])
def test_a_partial_scene_that_lacks_a_file_does_not_go_on(tmp_path: Path, name: str) -> None:
    folder = written(tmp_path / "scene.partial")
    (folder / name).unlink()
    expect_refusal("start over", lambda: SceneWriter(folder, {}, read_checkpoint(folder)))


def test_a_snapshot_that_was_changed_since_the_checkpoint_is_not_gone_on_with(tmp_path: Path) -> None:
    folder = written(tmp_path / "scene")
    checkpoint = read_checkpoint(folder)
    file = folder / "snapshots" / "000001.npz"
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    expect_refusal(
        r"000001.npz: was changed after it was written .*; start over", SceneWriter, folder, {}, checkpoint
    )
    SceneWriter(folder, {}, replace(checkpoint, parts=None))  # of an older version


def test_a_snapshot_keeps_what_was_known_of_each_voxel(tmp_path: Path) -> None:
    want = grid()
    want.num_updates[0], want.entity[0] = 0, 0
    want.num_updates[1, 0], want.entity[1, 0] = 0, SWEPT
    states = want.states(0.3, 0.7)
    assert set(states.ravel().tolist()) == {0, 1, 2, 3, 4}
    write_states(tmp_path / "a.npz", known(want), states)
    again = read_states(tmp_path / "a.npz")
    assert again.voxel == want.voxel and again.origin.tobytes() == want.origin.tobytes()
    for thresholds in ((0.3, 0.7), (0.01, 0.99)):
        assert (again.states(*thresholds) == states).all()
    assert np.array_equal(read_seen(tmp_path / "a.npz").is_free, states == VoxelState.FREE)


@pytest.mark.parametrize("num_steps", [2, 239, 240, 255, 300])
def test_a_snapshot_says_when_a_voxel_was_last_seen_and_what_has_no_splat(tmp_path: Path, num_steps: int) -> None:
    want = replace(
        known(grid(), unrepresented=[[0.0, 0.25, 0.4]], label=Label.HUMAN),
        step_stamps_ns=np.arange(num_steps) * 10,
        last_seen=np.zeros((3, 4, 5), np.uint16),
        edges=LostEdges(centers=np.array([[0.0, 0.5, 1.0]], np.float32), radii=np.array([0.25], np.float32)),
    )
    want.last_seen[1, 2, 3], want.last_seen[0, 0, 0], want.last_seen[2, 0, 1] = num_steps, 1, Unseen.UNANSWERED
    want.last_seen[0, 0, 1] = Unseen.SWEPT
    points = want.grid.origin + 0.05 * np.array(
        [[1.4, 1.6, 3.0], [0.0, 0.4, 0.0], [2.0, 0.0, 1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [9.0, 0.0, 0.0]]
    )
    seen_ns, free = [10 * (num_steps - 1), 0, -1, -1, -1, -1], EvidenceClass.FREE
    why = [EvidenceClass.UNANSWERED, EvidenceClass.SWEPT, EvidenceClass.OUT_OF_VIEW, EvidenceClass.OUTSIDE]
    wanted = [seen_ns, [free, free, *why]]
    write_states(tmp_path / "a.npz", want, want.grid.states(0.3, 0.7))
    write_occupancy(tmp_path / "b.npz", want)
    again = read_known_occupancy(tmp_path / "b.npz")
    assert (again.last_seen == want.last_seen).all()
    for balls in (again.unrepresented, *(read_unrepresented(tmp_path / name) for name in ("a.npz", "b.npz"))):
        assert balls.centers.tolist() == want.unrepresented.centers.tolist()
        assert (balls.labels.tolist(), balls.radius) == ([Label.HUMAN], pytest.approx(0.025 * 3**0.5))
        assert balls.volume == pytest.approx(0.05**3)
    files = [read_seen(tmp_path / name) for name in ("a.npz", "b.npz")]
    assert {seen.last_seen.dtype for seen in files} == {np.dtype(np.uint8 if num_steps < 240 else np.uint16)}
    for seen in (again.seen, *files):
        assert [each.tolist() for each in seen.look(points)] == wanted
        assert (seen.edges.centers.tolist(), seen.edges.radii.tolist()) == ([[0.0, 0.5, 1.0]], [0.25])


@pytest.mark.parametrize("num_steps", [2, 245])
def test_the_largest_number_of_an_older_file_is_looked_at_in_vain(tmp_path: Path, num_steps: int) -> None:
    """Its byte counted time steps beyond 240, too. Files that are older still have no evidence."""
    path, header = tmp_path / "a.npz", {"origin": [0, 0, 0], "voxel": 0.1, "shape": [1, 1, 3]}
    last_seen, steps = np.array([[[num_steps, 0, 0xFF]]], np.uint8), {"step_stamps_ns": list(range(num_steps))}
    np.savez(path, header=np.array(json.dumps(header | steps)), last_seen=last_seen)
    stamps_ns, classes = read_seen(path).look(np.array([[0.0, 0.0, 0.1 * k] for k in range(3)]))
    wanted = [EvidenceClass.FREE, EvidenceClass.OUT_OF_VIEW, EvidenceClass.UNANSWERED]
    assert (stamps_ns.tolist(), classes.tolist()) == ([num_steps - 1, -1, -1], wanted)
    np.savez(path, header=np.array(json.dumps(header)), states=np.full((1, 1, 3), 2, np.uint8))
    assert read_unrepresented(path) is None and read_seen(path) is None
    assert (read_states(path).log_odds == 20.0).all()


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"last_seen": np.full((3, 4, 5), 2, np.uint16)}, "last_seen: expected at most 1 time steps, got 2"),
        ({"last_seen": np.zeros((3, 4), np.uint16)}, "last_seen: expected uint16"),
        ({"unrepresented": np.zeros((2, 3), np.float32)}, "unrepresented: expected"),
        ({"unrepresented": np.full((1, 3), np.nan, np.float32)}, "unrepresented: expected finite"),
        ({"edges": np.zeros((2, 3), np.float32)}, "edges: expected"),
        ({"edges": np.full((1, 4), np.inf, np.float32)}, "edges: expected finite"),
    ],
)
def test_evidence_that_is_none_is_named(tmp_path: Path, changed: dict[str, NDArray[Any]], said: str) -> None:
    path = tmp_path / "a.npz"
    write_occupancy(path, known(grid(), unrepresented=[[0.0, 0.25, 0.4]]))
    savez(path, {**read_arrays(path, most=1 << 20), **changed})
    expect_refusal(said, read_known_occupancy, path)
    if "unrepresented" not in changed:
        expect_refusal(said, read_seen, path)


@pytest.mark.parametrize(
    ("run", "said"),
    [
        ("[]", "metrics: expected an object"),
        ('{"metrics": 3}', "metrics: expected an object"),
        ('{"metrics": {}}', "metrics.cameras: expected what reconstruct writes, got nothing"),
        ('{"metrics": {"cameras": 3}}', "metrics.cameras: expected what reconstruct writes, got 'int' object"),
        ('{"metrics": {"cameras": [], "background": [1]}}', "metrics.background: expected what reconstruct writes"),
        ("{", "cannot be read"),
        *(
            (f'{{"metrics": {{"cameras": []}}, "config": {{"occupancy": {{"free_below": {value}}}}}}}', FREE_BELOW)
            for value in ("1", "0", "-1", "NaN", '"x"', "[]")
        ),
    ],
)
def test_a_run_json_that_reconstruct_did_not_write_is_named(tmp_path: Path, run: str, said: str) -> None:
    folder = written(tmp_path / "scene")
    (folder / "run.json").write_text(run)
    if said == FREE_BELOW:
        expect_refusal(said, describe, folder)
    else:
        expect_refusal(said, lambda: [open_scene(folder).cameras, open_scene(folder).background])


@pytest.mark.parametrize("row", ["300", "300,snapshots/000000.ply", "x,snapshots/000000.ply,3", "300,../evil.ply,3"])
def test_a_row_of_snapshots_that_is_none_is_named(tmp_path: Path, row: str) -> None:
    file = written(tmp_path / "scene") / "snapshots.csv"
    file.write_text(f"{file.read_text()}{row}\n")
    expect_refusal(r"snapshots.csv: cannot be read", lambda: open_scene(tmp_path / "scene").splats_at(300))


def test_what_is_no_scene_is_named(tmp_path: Path) -> None:
    expect_refusal("no such scene", open_scene, tmp_path / "nowhere")
    expect_refusal("expected a scene folder", open_scene, tmp_path)
    partial = written(tmp_path / "scene.partial")
    expect_refusal("an interrupted run; continue it: .*--resume", open_scene, partial)


def test_a_foreign_or_cut_occupancy_grid_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    for foreign in ({"x": np.zeros(3)}, {"header": np.array({"a": 1}, dtype=object)}):
        np.savez(path, **foreign)
        expect_refusal("not an occupancy grid", read_occupancy, path)
    write_occupancy(path, known(grid()))
    path.write_bytes(path.read_bytes()[:-40])
    expect_refusal("not an occupancy grid", read_occupancy, path)
    expect_refusal("not the voxel states", read_states, path)

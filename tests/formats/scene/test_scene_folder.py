"""The scene folder reads back what was written, and says what is wrong with others."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError, NotEvaluableError
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
from splatctrl_cli.voxels import SWEPT, EvidenceClass, LostEdges, OccupancyGrid, Unseen
from tests.plain import known, plain_grid, plain_splats


@dataclass(frozen=True)
class Row:
    stamp_ns: int


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
        writer.audit(Row(stamp))
        writer.snapshot(stamp, splats(stamp // 100), known(grid(), stamp), grid().states(0.3, 0.7))
    writer.finish(300, splats(3), known(grid(), 300))
    writer.checkpoint({}, STATE, is_last=True)
    write_json(folder / "run.json", {"metrics": {"cameras": ["cam0"], "has_clock": True, "stamp_ns": 300}})
    return folder


def test_a_scene_is_known_by_its_newest_snapshot(tmp_path: Path) -> None:
    scene = open_scene(written(tmp_path / "scene"))
    assert [len(scene.splats_at(stamp)) for stamp in (100, 199, 200, 10_000)] == [1, 1, 2, 3]
    with pytest.raises(NotEvaluableError, match="no snapshot"):
        scene.splats_at(99)
    assert scene.cameras == ("cam0",)
    assert scene.stamp_ns == 300


def test_occupancy_comes_back_bit_by_bit(tmp_path: Path) -> None:
    write_occupancy(tmp_path / "occupancy.npz", known(grid()))
    again = read_occupancy(tmp_path / "occupancy.npz")
    want = grid()
    assert again.voxel == want.voxel
    for name in ("origin", "log_odds", "num_updates", "entity"):
        assert getattr(again, name).tobytes() == getattr(want, name).tobytes()


def test_the_same_scene_gives_the_same_bytes(tmp_path: Path) -> None:
    one, two = written(tmp_path / "one"), written(tmp_path / "two")
    for path in sorted(p.relative_to(one) for p in one.rglob("*") if p.is_file()):
        assert (one / path).read_bytes() == (two / path).read_bytes()


def test_a_checkpoint_keeps_scalars_scalar(tmp_path: Path) -> None:
    state = read_checkpoint(written(tmp_path / "scene")).state
    assert state["scalar"].shape == ()
    assert state["a"].tolist() == [0, 1, 2, 3]


def test_a_run_that_goes_on_drops_what_came_after_its_checkpoint(tmp_path: Path) -> None:
    straight, cut = tmp_path / "straight", tmp_path / "cut"
    for folder in (straight, cut):
        folder.mkdir()
        writer = SceneWriter(folder, {"frame": "world"})
        for stamp in (100, 200):
            writer.audit(Row(stamp))
            writer.snapshot(stamp, splats(2), known(grid()), grid().states(0.3, 0.7))
        writer.checkpoint({"num_read": 2}, STATE)
        if folder is cut:
            writer.audit(Row(999))
            writer.snapshot(999, splats(9), known(grid()), grid().states(0.3, 0.7))
            writer.settle()
            for name in ("audit.jsonl", "snapshots/000003.ply", f"{CHECKPOINT}.new", "splats.ply", "run.json"):
                with (folder / name).open("ab") as stream:
                    stream.write(b'{"stamp')
            again = read_checkpoint(folder)
            assert again.progress == {"num_read": 2}
            writer = SceneWriter(folder, {"frame": "world"}, again)
            assert [row["stamp_ns"] for row in writer.audited()] == [100, 200]
        writer.audit(Row(300))
        writer.snapshot(300, splats(3), known(grid()), grid().states(0.3, 0.7))
        writer.finish(300, splats(3), known(grid(), 300))
        writer.checkpoint({"num_read": 3}, STATE, is_last=True)
    files = {p.relative_to(cut): p.read_bytes() for p in cut.rglob("*") if p.is_file()}
    assert files == {p.relative_to(straight): p.read_bytes() for p in straight.rglob("*") if p.is_file()}


@pytest.mark.parametrize("name", ["audit.jsonl", "snapshots/000001.npz", CHECKPOINT])
def test_a_partial_scene_that_lacks_a_file_does_not_go_on(tmp_path: Path, name: str) -> None:
    folder = written(tmp_path / "scene.partial")
    (folder / name).unlink()
    with pytest.raises(InputError, match="start over"):
        SceneWriter(folder, {}, read_checkpoint(folder))


def test_a_snapshot_that_was_changed_since_the_checkpoint_is_not_gone_on_with(tmp_path: Path) -> None:
    folder = written(tmp_path / "scene")
    checkpoint = read_checkpoint(folder)
    file = folder / "snapshots" / "000001.npz"
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    with pytest.raises(InputError, match=r"000001.npz: was changed after it was written .*; start over"):
        SceneWriter(folder, {}, checkpoint)
    SceneWriter(folder, {}, replace(checkpoint, parts=None))  # of an older version


def test_an_interrupted_run_is_not_read_as_a_scene(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"an interrupted run; continue it: .*--resume"):
        open_scene(written(tmp_path / "scene.partial"))


def test_a_snapshot_keeps_what_was_known_of_each_voxel(tmp_path: Path) -> None:
    want = grid()
    want.num_updates[0], want.entity[0] = 0, 0
    want.num_updates[1, 0], want.entity[1, 0] = 0, SWEPT
    states = want.states(0.3, 0.7)
    assert set(states.ravel().tolist()) == {0, 1, 2, 3, 4}
    write_states(tmp_path / "a.npz", known(want), states)
    again = read_states(tmp_path / "a.npz")
    assert again.voxel == want.voxel
    assert again.origin.tobytes() == want.origin.tobytes()
    for thresholds in ((0.3, 0.7), (0.01, 0.99)):
        assert (again.states(*thresholds) == states).all()
    (tmp_path / "b.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match="not the voxel states"):
        read_states(tmp_path / "b.npz")


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
    assert again is not None
    assert (again.last_seen == want.last_seen).all()
    assert [each.tolist() for each in again.seen.look(points)] == wanted
    assert (again.edges.centers.tolist(), again.edges.radii.tolist()) == ([[0.0, 0.5, 1.0]], [0.25])
    for balls in (again.unrepresented, *(read_unrepresented(tmp_path / name) for name in ("a.npz", "b.npz"))):
        assert balls is not None and balls.centers.tolist() == want.unrepresented.centers.tolist()
        assert balls.labels.tolist() == [Label.HUMAN]
        assert balls.radius == pytest.approx(0.025 * 3**0.5)
        assert balls.volume == pytest.approx(0.05**3)
    for name in ("a.npz", "b.npz"):
        seen = read_seen(tmp_path / name)
        assert seen is not None and seen.last_seen.dtype == (np.uint8 if num_steps < 240 else np.uint16)
        assert [each.tolist() for each in seen.look(points)] == wanted
        assert (seen.edges.centers.tolist(), seen.edges.radii.tolist()) == ([[0.0, 0.5, 1.0]], [0.25])


@pytest.mark.parametrize("num_steps", [2, 245])
def test_the_largest_number_of_an_older_file_is_looked_at_in_vain(tmp_path: Path, num_steps: int) -> None:
    """In one byte, where 240 and more were time steps as well."""
    header = {"origin": [0, 0, 0], "voxel": 0.1, "shape": [1, 1, 3], "step_stamps_ns": list(range(num_steps))}
    last_seen = np.array([[[num_steps, 0, 0xFF]]], np.uint8)
    np.savez(tmp_path / "a.npz", header=np.array(json.dumps(header)), last_seen=last_seen)
    seen = read_seen(tmp_path / "a.npz")
    assert seen is not None
    stamps_ns, classes = seen.look(np.array([[0.0, 0.0, 0.1 * k] for k in range(3)]))
    assert stamps_ns.tolist() == [num_steps - 1, -1, -1]
    assert classes.tolist() == [EvidenceClass.FREE, EvidenceClass.OUT_OF_VIEW, EvidenceClass.UNANSWERED]


def test_voxel_files_of_an_older_version_are_read_without_evidence(tmp_path: Path) -> None:
    header = {"origin": [0, 0, 0], "voxel": 0.1, "shape": [1, 1, 1]}
    np.savez(tmp_path / "a.npz", header=np.array(json.dumps(header)), states=np.full((1, 1, 1), 2, np.uint8))
    assert read_unrepresented(tmp_path / "a.npz") is None and read_seen(tmp_path / "a.npz") is None
    assert read_states(tmp_path / "a.npz").log_odds.item() == 20.0


def test_a_voxel_file_without_lost_edges_is_read_as_with_none(tmp_path: Path) -> None:
    write_occupancy(tmp_path / "a.npz", known(grid()))
    arrays = {name: array for name, array in read_arrays(tmp_path / "a.npz", most=1 << 20).items() if name != "edges"}
    header = json.loads(str(arrays["header"]))
    del header["edges"]
    savez(tmp_path / "a.npz", {**arrays, "header": np.array(json.dumps(header))})
    for found in (read_seen(tmp_path / "a.npz"), read_known_occupancy(tmp_path / "a.npz")):
        assert found is not None and len(found.edges.radii) == 0


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
    write_occupancy(tmp_path / "a.npz", known(grid(), unrepresented=[[0.0, 0.25, 0.4]]))
    savez(tmp_path / "a.npz", {**read_arrays(tmp_path / "a.npz", most=1 << 20), **changed})
    with pytest.raises(InputError, match=said):
        read_known_occupancy(tmp_path / "a.npz")
    if "unrepresented" not in changed:
        with pytest.raises(InputError, match=said):
            read_seen(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("run", "said"),
    [
        ("[]", "metrics: expected an object"),
        ('{"metrics": 3}', "metrics: expected an object"),
        ('{"metrics": {}}', "metrics.cameras: expected what reconstruct writes, got nothing"),
        ('{"metrics": {"cameras": 3}}', "metrics.cameras: expected what reconstruct writes, got 'int' object"),
        ('{"metrics": {"cameras": [], "background": [1]}}', "metrics.background: expected what reconstruct writes"),
        ("{", "cannot be read"),
    ],
)
def test_a_run_json_that_reconstruct_did_not_write_is_named(tmp_path: Path, run: str, said: str) -> None:
    (written(tmp_path / "scene") / "run.json").write_text(run)
    with pytest.raises(InputError, match=said):
        scene = open_scene(tmp_path / "scene")
        assert scene.cameras == scene.background


@pytest.mark.parametrize("value", ["1", "0", "-1", "NaN", '"x"', "[]"])
def test_a_threshold_that_is_no_probability_is_named(tmp_path: Path, value: str) -> None:
    run = f'{{"metrics": {{"cameras": []}}, "config": {{"occupancy": {{"free_below": {value}}}}}}}'
    (written(tmp_path / "scene") / "run.json").write_text(run)
    with pytest.raises(InputError, match=r"run.json: config.occupancy.free_below: expected what reconstruct writes"):
        describe(tmp_path / "scene")


@pytest.mark.parametrize("row", ["300", "300,snapshots/000000.ply", "x,snapshots/000000.ply,3", "300,../evil.ply,3"])
def test_a_row_of_snapshots_that_is_none_is_named(tmp_path: Path, row: str) -> None:
    file = written(tmp_path / "scene") / "snapshots.csv"
    file.write_text(f"{file.read_text()}{row}\n")
    with pytest.raises(InputError, match=r"snapshots.csv: cannot be read"):
        open_scene(tmp_path / "scene").splats_at(300)


def test_what_is_no_scene_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such scene"):
        open_scene(tmp_path / "nowhere")
    with pytest.raises(InputError, match="expected a scene folder"):
        open_scene(tmp_path)


def test_a_foreign_or_cut_occupancy_grid_is_refused(tmp_path: Path) -> None:
    foreign, cut = tmp_path / "foreign.npz", tmp_path / "cut.npz"
    np.savez(foreign, x=np.zeros(3))
    write_occupancy(cut, known(grid()))
    cut.write_bytes(cut.read_bytes()[:-40])
    pickled = tmp_path / "pickled.npz"
    np.savez(pickled, header=np.array({"a": 1}, dtype=object))
    for path in (foreign, cut, pickled):
        with pytest.raises(InputError, match="not an occupancy grid"):
            read_occupancy(path)

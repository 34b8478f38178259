"""Joint states from HDF5 and Parquet files that a TOML file describes, and from LeRobot's datasets."""

import json
import os
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from splatctrl_cli import libraries
from splatctrl_cli.errors import UsageError
from tests.recording.log.make_states import AB, opened, refusal, states
from tests.refused import expect_refusal

NUM = 5000  # rows, more than a block

T = np.arange(NUM) * 0.01

Q = np.stack([np.linspace(0, 1, NUM), np.linspace(1, -1, NUM)], axis=1)


def described(folder: Path, **table: Any) -> Path:
    path = folder / "run.toml"
    path.write_text("[states]\n" + "\n".join(f"{key} = {json.dumps(value)}" for key, value in table.items()))
    return path


def write_h5(path: Path, **arrays: Any) -> Path:
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file.create_dataset(f"observations/{name}", data=values, compression="gzip")
    return path


def lists(values: Any, fixed: int | None = None) -> Any:
    kind = pa.list_(pa.float32()) if fixed is None else pa.list_(pa.float64(), fixed)
    return pa.array(np.asarray(values).tolist(), type=kind)


def write_parquet(path: Path, **columns: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns), path, row_group_size=1500)
    return path


@pytest.mark.parametrize("kind", ["h5", "columns", "lists", "lists of one size"])
def test_tables_of_every_form_give_the_states_that_were_written(tmp_path: Path, kind: str) -> None:
    if kind == "h5":
        file = write_h5(tmp_path / "run.h5", t=T, qpos=Q)
        time, position = "observations/t", ["/observations/qpos"]
    elif kind == "columns":
        file = write_parquet(tmp_path / "run.parquet", t=T, qa=Q[:, 0], qb=Q[:, 1])
        time, position = "t", ["qa", "qb"]
    else:
        file = write_parquet(tmp_path / "run.parquet", t=T, q=lists(Q, None if kind == "lists" else 2))
        time, position = "t", ["q"]
    found = states(described(tmp_path, file=file.name, joints=list(AB), time=time, position=position))
    assert [s.stamp_ns for s in found] == [10_000_000 * i for i in range(NUM)]
    assert np.array([s.position for s in found]) == pytest.approx(Q, abs=1e-7)
    assert found[7].velocity == pytest.approx((Q[1] - Q[0]) / 0.01, rel=1e-3)


def with_q(folder: Path, **columns: Any) -> Path:
    """A description of a table of times t and positions q."""
    write_parquet(folder / "run.parquet", **columns)
    return described(folder, file="run.parquet", joints=list(AB), time="t", position=["q"])


def test_times_of_a_type_that_says_its_unit_need_no_time_unit_and_what_is_not_there_is_no_number(
    tmp_path: Path,
) -> None:
    stamps = 1_700_000_000_000_000 + 10_000 * np.arange(20)
    found = states(with_q(tmp_path, t=pa.array(stamps, type=pa.timestamp("us")), q=lists(Q[:20])))
    assert [s.stamp_ns for s in found] == (1000 * stamps).tolist()
    write_parquet(tmp_path / "run.parquet", t=T[:20], qa=pa.array([None, *Q[1:20, 0]]), qb=Q[:20, 1])
    source = opened(described(tmp_path, file="run.parquet", joints=list(AB), time="t", position=["qa", "qb"]))
    assert (len(source.states), source.loss.damaged) == (19, 1)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    "rows",
    [
        [[0.0, 1.0], [0.0, 1.0, 2.0], [3.0]],
        [[0.0, 1.0], None, [0.0, 1.0]],
        [[0.0, 1.0]] * 4500 + [[0.0, 1.0, 2.0]] * 500,
        "h5",
    ],
    ids=["lengths", "a gap", "a later block", "h5"],
)
def test_rows_of_several_lengths_are_refused_as_ragged(tmp_path: Path, rows: Any) -> None:
    name = "run.h5" if rows == "h5" else "run.parquet"
    if rows == "h5":
        with h5py.File(tmp_path / name, "w") as file:
            file["t"] = T[:3]
            ragged = file.create_dataset("q", (3,), dtype=h5py.vlen_dtype(np.float64))
            for i, row in enumerate([[0.0, 1.0], [0.0, 1.0, 2.0], [3.0]]):
                ragged[i] = row
        path = described(tmp_path, file=name, joints=list(AB), time="t", position=["q"])
    else:
        path = with_q(tmp_path, t=T[: len(rows)], q=pa.array(rows, type=pa.list_(pa.float64())))
    remedy = "write rows of one length: an array .T, K., or a column for each joint"
    expect_refusal(f"{name}: q: ragged: its rows differ in length.*; {remedy}", opened, path)


@pytest.mark.parametrize("name", ["run.h5", "run.parquet"])
def test_a_column_that_is_not_there_text_and_damage_are_named(tmp_path: Path, name: str) -> None:
    words = ["x"] * 20
    inner = "observations/" if name == "run.h5" else ""
    if inner:
        write_h5(tmp_path / name, t=T[:20], q=Q[:20], name=words)
    else:
        write_parquet(tmp_path / name, t=T[:20], q=lists(Q[:20]), name=words)
    common: dict[str, Any] = {"file": name, "joints": list(AB), "time": f"{inner}t"}
    missing = refusal(described(tmp_path, **common, position=["angles"]))
    assert "'angles': expected an array of numbers, got none" in missing and f"{inner}q" in missing
    assert "got object of shape (20,)" in refusal(described(tmp_path, **common, position=[f"{inner}name"]))
    os.truncate(tmp_path / name, (tmp_path / name).stat().st_size // 2)
    assert "cannot be read as" in refusal(described(tmp_path, **common, position=[f"{inner}q"]))
    assert "a file of arrays, of which none is known to be joint states" in refusal(tmp_path / name)


def test_without_the_library_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "run.h5").write_bytes(b"")
    path = described(tmp_path, file="run.h5", joints=list(AB), time="t", position=["q"])
    monkeypatch.setattr(libraries, "import_module", Mock(side_effect=ImportError("No module named 'h5py'")))
    said = r"HDF5 files need the library h5py.*pip install 'splatctrl-cli\[tables\]'"
    expect_refusal(said, opened, path, error=UsageError)


def lerobot(folder: Path, version: int, *, num_episodes: int = 3, names: Any = None) -> Path:
    """A dataset; an episode's first joint begins at its number."""
    feature = {"dtype": "float32", "shape": [2], "names": ["a.pos", "b.pos"] if names is None else names}
    info = {"codebase_version": f"v{version}.0", "total_episodes": num_episodes, "fps": 50}
    (folder / "meta").mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps({**info, "features": {"observation.state": feature}}))
    numbers = list(range(num_episodes))
    if version == 2:
        files = {f"data/chunk-000/episode_{n:06d}.parquet": [n] for n in numbers}
    else:
        files = {"data/chunk-000/file-000.parquet": numbers[:2], "data/chunk-000/file-001.parquet": numbers[2:]}
    for name, episodes in files.items():
        if episodes:
            q = np.concatenate([Q[:30] + np.array([episode, 0]) for episode in episodes])
            t = np.tile(T[:30].astype(np.float32) * 2, len(episodes))
            columns = {"observation.state": lists(q), "timestamp": t, "episode_index": np.repeat(episodes, 30)}
            write_parquet(folder / name, **columns)
    return folder


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("episode", [0, 1, 2])
def test_an_episode_of_a_lerobot_dataset_is_read_by_its_preset(tmp_path: Path, version: int, episode: int) -> None:
    lerobot(tmp_path / "set", version)
    source = opened(described(tmp_path, preset="lerobot", file="set", episode=episode))
    found, expected = states(source), Q[:30] + np.array([episode, 0])
    assert (source.joint_names, np.array([s.position for s in found])) == (AB, pytest.approx(expected, abs=1e-6))
    assert [s.stamp_ns for s in found][:3] == [0, 20_000_000, pytest.approx(40_000_000, abs=10)]
    assert "no episode 7" in refusal(described(tmp_path, preset="lerobot", file="set", episode=7))


def test_a_lerobot_dataset_of_one_episode_is_read_by_itself_and_of_more_asks_which(tmp_path: Path) -> None:
    one = opened(lerobot(tmp_path / "one", 3, num_episodes=1, names={"motors": ["a", "b"]}))
    assert (len(states(one)), one.loss.notes[0]) == (30, "times are seconds from the episode's begin")
    many = lerobot(tmp_path / "many", 2)
    assert "3 episodes; choose one in a .toml: [states] preset, file, episode" in refusal(many)
    assert "3 episodes; choose one" in refusal(described(tmp_path, preset="lerobot", file="many"))


def test_joints_that_a_lerobot_dataset_does_not_name_are_given(tmp_path: Path) -> None:
    folder = lerobot(tmp_path / "set", 3, num_episodes=1, names=["motors"])
    assert "observation.state has no name for each joint; give a .toml: [states] preset" in refusal(folder)
    assert "states.joints is missing" in refusal(described(tmp_path, preset="lerobot", file="set"))
    path = described(tmp_path, preset="lerobot", file="set", joints=list(AB), unit="deg")
    assert states(path)[3].position == pytest.approx(np.radians(Q[3]), abs=1e-6)
    other = described(tmp_path, preset="leroboto", file="set")
    assert "states.preset: expected one of lerobot, got 'leroboto'" in refusal(other)
    (folder / "meta/info.json").write_text("{}")
    assert "expected total_episodes and the feature observation.state" in refusal(folder)

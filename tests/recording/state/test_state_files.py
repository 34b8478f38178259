"""Joint states from HDF5 and Parquet files that a TOML file describes, and from LeRobot's datasets."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from splatctrl_cli import libraries
from splatctrl_cli.errors import UsageError
from tests.recording.log.make_states import AB, opened, refusal, states
from tests.refused import refused

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


def test_times_of_a_type_that_says_its_unit_need_no_time_unit(tmp_path: Path) -> None:
    stamps = 1_700_000_000_000_000 + 10_000 * np.arange(20)
    times = pa.array(stamps, type=pa.timestamp("us"))
    write_parquet(tmp_path / "run.parquet", t=times, q=lists(Q[:20]))
    found = states(described(tmp_path, file="run.parquet", joints=list(AB), time="t", position=["q"]))
    assert [s.stamp_ns for s in found] == (1000 * stamps).tolist()


def test_a_value_that_is_not_there_is_no_number(tmp_path: Path) -> None:
    columns = {"t": T[:20], "qa": pa.array([None, *Q[1:20, 0]]), "qb": Q[:20, 1]}
    write_parquet(tmp_path / "run.parquet", **columns)
    source = opened(described(tmp_path, file="run.parquet", joints=list(AB), time="t", position=["qa", "qb"]))
    assert (len(source.states), source.loss.damaged) == (19, 1)  # type: ignore[attr-defined]


@pytest.mark.parametrize("kind", ["h5", "parquet", "parquet with a gap"])
def test_rows_of_several_lengths_are_refused_as_ragged(tmp_path: Path, kind: str) -> None:
    rows = [[0.0, 1.0], [0.0, 1.0, 2.0], [3.0]]
    if kind == "h5":
        with h5py.File(tmp_path / "run.h5", "w") as file:
            file["t"] = T[:3]
            ragged = file.create_dataset("q", (3,), dtype=h5py.vlen_dtype(np.float64))
            for i, row in enumerate(rows):
                ragged[i] = row
    else:
        values = pa.array(rows if kind == "parquet" else [[0.0, 1.0], None, [0.0, 1.0]], type=pa.list_(pa.float64()))
        write_parquet(tmp_path / "run.parquet", t=T[:3], q=values)
    name = "run.h5" if kind == "h5" else "run.parquet"
    message = refusal(described(tmp_path, file=name, joints=list(AB), time="t", position=["q"]))
    assert f"{name}: q: ragged: its rows differ in length" in message
    assert "write rows of one length: an array (T, K), or a column for each joint" in message


def test_a_column_that_grows_in_a_later_block_is_ragged_too(tmp_path: Path) -> None:
    rows = [[0.0, 1.0]] * 4500 + [[0.0, 1.0, 2.0]] * 500
    write_parquet(tmp_path / "run.parquet", t=T, q=pa.array(rows, type=pa.list_(pa.float64())))
    path = described(tmp_path, file="run.parquet", joints=list(AB), time="t", position=["q"])
    assert "ragged" in refusal(path)


@pytest.mark.parametrize("name", ["run.h5", "run.parquet"])
def test_a_column_that_is_not_there_text_and_damage_are_named(tmp_path: Path, name: str) -> None:
    words = ["x"] * 20
    if name == "run.h5":
        write_h5(tmp_path / name, t=T[:20], q=Q[:20], name=words)
        inner = "observations/"
    else:
        write_parquet(tmp_path / name, t=T[:20], q=lists(Q[:20]), name=words)
        inner = ""
    common: dict[str, Any] = {"file": name, "joints": list(AB), "time": f"{inner}t"}
    missing = refusal(described(tmp_path, **common, position=["angles"]))
    assert "'angles': expected an array of numbers, got none" in missing
    assert f"{inner}q" in missing
    assert "got object of shape (20,)" in refusal(described(tmp_path, **common, position=[f"{inner}name"]))
    data = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data[: len(data) // 2])
    assert "cannot be read as" in refusal(described(tmp_path, **common, position=[f"{inner}q"]))
    assert "a file of arrays, of which none is known to be joint states" in refusal(tmp_path / name)


def test_without_the_library_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> Any:
        raise ImportError(f"No module named {name!r}")

    (tmp_path / "run.h5").write_bytes(b"")
    path = described(tmp_path, file="run.h5", joints=list(AB), time="t", position=["q"])
    monkeypatch.setattr(libraries, "import_module", absent)
    refused(
        r"HDF5 files need the library h5py.*pip install 'splatctrl-cli\[tables\]'", opened, path, error=UsageError
    )


def lerobot(folder: Path, version: int, *, num_episodes: int = 3, names: Any = None) -> Path:
    """A dataset; an episode's first joint begins at its number."""
    feature = {"dtype": "float32", "shape": [2], "names": ["a.pos", "b.pos"] if names is None else names}
    info = {"codebase_version": f"v{version}.0", "total_episodes": num_episodes, "fps": 50}
    (folder / "meta").mkdir(parents=True)
    (folder / "meta/info.json").write_text(json.dumps({**info, "features": {"observation.state": feature}}))
    episodes = []
    for episode in range(num_episodes):
        q = Q[:30] + np.array([episode, 0])
        column = np.full(30, episode)
        episodes.append({"t": T[:30].astype(np.float32) * 2, "q": q, "episode": column})
    if version == 2:
        files = {f"data/chunk-000/episode_{n:06d}.parquet": [entry] for n, entry in enumerate(episodes)}
    else:
        files = {"data/chunk-000/file-000.parquet": episodes[:2], "data/chunk-000/file-001.parquet": episodes[2:]}
    for name, parts in files.items():
        if parts:
            t, q, episode_index = (np.concatenate([part[key] for part in parts]) for key in ("t", "q", "episode"))
            columns = {"observation.state": lists(q), "timestamp": t, "episode_index": episode_index}
            write_parquet(folder / name, **columns)
    return folder


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("episode", [0, 1, 2])
def test_an_episode_of_a_lerobot_dataset_is_read_by_its_preset(tmp_path: Path, version: int, episode: int) -> None:
    lerobot(tmp_path / "set", version)
    path = described(tmp_path, preset="lerobot", file="set", episode=episode)
    found = states(path)
    assert opened(path).joint_names == AB
    assert np.array([s.position for s in found]) == pytest.approx(Q[:30] + np.array([episode, 0]), abs=1e-6)
    assert [s.stamp_ns for s in found][:3] == [0, 20_000_000, pytest.approx(40_000_000, abs=10)]
    assert "no episode 7" in refusal(described(tmp_path, preset="lerobot", file="set", episode=7))


def test_a_lerobot_dataset_of_one_episode_is_read_by_itself_and_of_more_asks_which(tmp_path: Path) -> None:
    one = lerobot(tmp_path / "one", 3, num_episodes=1, names={"motors": ["a", "b"]})
    assert len(states(one)) == 30
    assert opened(one).loss.notes[0] == "times are seconds from the episode's begin"
    many = lerobot(tmp_path / "many", 2)
    assert "3 episodes; choose one in a .toml: [states] preset, file, episode" in refusal(many)
    assert "3 episodes; choose one" in refusal(described(tmp_path, preset="lerobot", file="many"))


def test_joints_that_a_lerobot_dataset_does_not_name_are_given(tmp_path: Path) -> None:
    folder = lerobot(tmp_path / "set", 3, num_episodes=1, names=["motors"])
    assert "observation.state has no name for each joint; give a .toml: [states] preset" in refusal(folder)
    assert "states.joints is missing" in refusal(described(tmp_path, preset="lerobot", file="set"))
    path = described(tmp_path, preset="lerobot", file="set", joints=list(AB), unit="deg")
    assert states(path)[3].position == pytest.approx(np.radians(Q[3]), abs=1e-6)


def test_a_preset_that_is_none_and_a_dataset_without_states_are_named(tmp_path: Path) -> None:
    said = refusal(described(tmp_path, preset="leroboto", file="set"))
    assert "states.preset: expected one of lerobot, got 'leroboto'" in said
    folder = lerobot(tmp_path / "set", 3, num_episodes=1)
    (folder / "meta/info.json").write_text("{}")
    assert "expected total_episodes and the feature observation.state" in refusal(folder)

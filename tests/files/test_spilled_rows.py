"""Rows in a file without a name, and states read from them a block at a time."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.files import spilled_rows
from splatctrl_cli.files.spilled_rows import RowFile, Rows, scratch_folder, select
from splatctrl_cli.formats import arrays
from splatctrl_cli.recording.log import state_columns
from splatctrl_cli.recording.log.state_columns import StateCollector
from splatctrl_cli.recording.log.state_topics import checked_stamps
from splatctrl_cli.recording.log.state_track import RawTrack, clean_states, differentiate, smoothed_seconds
from splatctrl_cli.recording.source import SourceOptions
from splatctrl_cli.recording.state import state_table
from splatctrl_cli.recording.state.state_source import open_states
from splatctrl_cli.records import Float64, JointState, LossReport
from tests.recording.log.make_states import START_NS, STEP_NS, states_of, write_mcap

JOINTS = tuple(f"joint{i}" for i in range(1, 8))


@pytest.fixture(params=[1, 7, 10_000])
def block(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    """So many states at once, everywhere."""
    for module in (spilled_rows, arrays, state_columns, state_table):
        monkeypatch.setattr(module, "BLOCK", request.param)
    return int(request.param)


def filled(values: Float64) -> Rows:
    file = RowFile(values.shape[1:])
    for first in range(0, len(values), 3):
        file.append(values[first : first + 3])
    return Rows(file)


@pytest.mark.parametrize("in_memory", [16, 2**20])
def test_rows_are_read_as_those_of_an_array(monkeypatch: pytest.MonkeyPatch, in_memory: int) -> None:
    monkeypatch.setattr(spilled_rows, "IN_MEMORY", in_memory)
    monkeypatch.setattr(spilled_rows, "FEW", 4)
    values = np.arange(120.0).reshape(40, 3)
    table, far = filled(values), np.array([39, 0, 17, 17])
    assert (len(table), table.shape) == (40, (40, 3))
    for at in (slice(5, 9), -1, far, slice(40, 50)):
        assert np.array_equal(table[at], values[at])
    chosen = table.select(far).select(columns=np.array([2, 0]))
    assert np.array_equal(chosen[1:4], values[far][1:4][:, [2, 0]])
    assert np.array_equal(chosen.select(np.array([3, 0]))[:2], values[[17, 39]][:, [2, 0]])
    assert np.array_equal(select(values, far), values[far])
    table[0:1][0, 0] = 9.0  # a copy
    assert table[0][0] == 0.0
    with pytest.raises(ValueError, match="expected"):
        RowFile((2,)).append(values)


def test_files_without_a_name_lie_where_tmpdir_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    assert scratch_folder() == tmp_path


def uneven(num: int) -> tuple[np.ndarray[tuple[int], np.dtype[np.int64]], Float64]:
    """Stamps with jitter, lost states and a gap, and positions (T, 7)."""
    rng = np.random.default_rng(3)
    stamps = START_NS + np.arange(num, dtype=np.int64) * STEP_NS + rng.integers(-3_000_000, 3_000_000, num)
    stamps[num // 3 :] += 5 * STEP_NS
    stamps[num // 2 :] += 2_000_000_000
    return stamps, rng.normal(0, 0.01, (num, 7)).cumsum(axis=0)


def plain_smoothed(stamps: np.ndarray[tuple[int], np.dtype[np.int64]], period: float) -> Float64:
    """The line through the 50 states before and after, fitted with everything in memory."""
    seconds = (stamps - stamps[0]) * 1e-9
    clock, number = 0.0, [0]
    for second in seconds[1:]:
        ticks = max(round((second - clock) / period), 1)
        clock += ticks * period
        clock += 0.05 * (second - clock)
        number.append(number[-1] + ticks)
    fitted = []
    for i in range(len(seconds)):
        near = slice(max(i - 50, 0), i + 51)
        fitted.append(np.polyval(np.polyfit(np.array(number[near]) - number[i], seconds[near], 1), 0.0))
    return np.array(fitted)


def test_the_clock_is_smoothed_as_by_a_line_through_the_neighbours(block: int) -> None:
    stamps = uneven(300)[0][:100]
    seconds = (stamps - stamps[0]) * 1e-9
    period = float(np.median(seconds[20:] - seconds[:-20])) / 20
    np.testing.assert_allclose(smoothed_seconds(stamps), plain_smoothed(stamps, period), atol=1e-9)
    even, loss = START_NS + np.arange(50, dtype=np.int64) * STEP_NS, LossReport()
    checked_stamps(even, even + np.where(np.arange(50) < 23, 0, 5_000_000_000), "x", loss)
    assert any("stamps step by 5.000 s against the time of logging at state 23" in note for note in loss.notes)


def test_velocities_are_the_same_to_the_bit_in_any_blocks(block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    stamps, q = uneven(300)
    found = differentiate(stamps, q)
    monkeypatch.setattr(spilled_rows, "BLOCK", 10_000)
    assert np.array_equal(found, differentiate(stamps, q))


def test_states_are_cleaned_the_same_in_any_blocks(block: int) -> None:
    stamps, q = uneven(60)
    order, loss = np.random.default_rng(0).permutation(60), LossReport()
    q[20], stamps[31] = np.nan, stamps[30]
    velocity = np.where(np.arange(60)[:, None] % 9 == 0, np.nan, 0.1) * np.ones((60, 7))
    columns = {"position": filled(q[order]), "velocity": filled(velocity[order])}
    states = clean_states(RawTrack(where="x", names=JOINTS, stamp_ns=stamps[order], **columns), loss)
    kept = [i for i in range(60) if i != 20]
    first = {int(stamps[i]): i for i in sorted(kept, key=lambda i: -list(order).index(i))}
    chosen = [first[stamp] for stamp in sorted(first)]
    assert [s.stamp_ns for s in states] == sorted(first) and len(states) == 58
    assert np.array_equal([s.position for s in states], q[chosen])
    slopes = differentiate(stamps[chosen], q[chosen])
    wanted = np.where(np.isnan(velocity[chosen]), slopes, velocity[chosen])
    assert np.array_equal([s.velocity for s in states], wanted)
    assert np.array_equal(states[-1].position, states[57].position) and len(states[3:9:2]) == 3
    num_slopes = np.isnan(velocity[chosen]).any(axis=1).sum()
    assert (loss.damaged, loss.duplicate_states, loss.differentiated_velocities) == (1, 1, num_slopes)
    assert loss.unsorted_states > 0


@pytest.mark.parametrize("form", ["csv", "npz", "mcap"])
def test_a_file_gives_the_same_states_in_any_blocks(block: int, tmp_path: Path, form: str) -> None:
    q = uneven(40)[1]
    file = tmp_path / f"x.{form}"
    if form == "mcap":
        write_mcap(file, states_of(q, JOINTS, velocity=2 * q))
    elif form == "npz":
        np.savez(file, t=np.arange(40) * 10, q=np.asfortranarray(q[:, :3]), r=q[:, 3:], v=2 * q)
    else:
        names = ["t", *(f"q{i}" for i in range(7)), *(f"v{i}" for i in range(7))]
        cells = [[repr(float(x)) for x in (10 * i, *q[i], *(2 * q[i]))] for i in range(40)]
        file.write_text("\n".join(",".join(row) for row in (names, *cells)))
    blocks = {"csv": ([f"q{i}" for i in range(7)], [f"v{i}" for i in range(7)]), "npz": (["q", "r"], ["v"])}
    if form != "mcap":
        position, velocity = blocks[form]
        table = {"file": file.name, "joints": list(JOINTS), "time": "t", "time_unit": "ms"}
        table |= {"position": position, "velocity": velocity}
        file = tmp_path / "x.toml"
        file.write_text("[states]\n" + "\n".join(f"{key} = {value!r}" for key, value in table.items()))
    states = [s for s in open_states(file, SourceOptions(), JOINTS).records() if isinstance(s, JointState)]
    assert np.diff([s.stamp_ns for s in states]).tolist() == [STEP_NS] * 39
    assert np.array_equal([np.concatenate([s.position, s.velocity]) for s in states], np.hstack([q, 2 * q]))


def test_what_some_states_lack_is_none_there(block: int) -> None:
    collector, poses = StateCollector(2), {4: np.eye(4), 7: np.eye(4)}
    for i in range(9):
        still = JointState(stamp_ns=i, position=np.full(2, i), velocity=np.zeros(2), T_world_ee=poses.get(i))
        collector.add(still)
    columns = collector.columns()
    assert [i for i, s in enumerate(columns) if s.T_world_ee is not None] == [4, 7]
    assert columns.T_base_ee is None and columns.select_joints(np.array([1, 0]))[8].position.tolist() == [8, 8]
    with pytest.raises(IndexError):
        columns[9]

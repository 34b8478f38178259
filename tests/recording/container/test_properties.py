"""Properties that hold for any recording: what was written is read, and a cut leaves a beginning."""

from io import BytesIO
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from splatctrl_cli.config.fixed import TF_GAP_NS
from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.arrays import npy_of, read_arrays, savez
from splatctrl_cli.formats.unpacking import BadBlockError
from splatctrl_cli.geometry import invert_transform
from splatctrl_cli.recording.container.mcap_file import parse_record
from splatctrl_cli.recording.folder.poses import READERS
from splatctrl_cli.recording.log.messages import decode_rvl
from splatctrl_cli.recording.log.registration import TfTree
from tests.properties import few
from tests.recording.log.test_decoder import encoded_rvl


@few(150)
@given(st.integers(0, 255), st.binary(max_size=80))
def test_bytes_that_are_no_record_of_an_mcap_are_refused_as_such(opcode: int, content: bytes) -> None:
    try:
        parse_record(opcode, content)
    except BadBlockError as error:
        assert "record" in str(error)


@few(60)
@given(st.lists(st.one_of(st.just(0), st.integers(0, 65535)), min_size=1, max_size=120))
def test_rvl_gives_back_any_image(pixels: list[int]) -> None:
    image = np.array(pixels, np.uint16)
    assert np.array_equal(decode_rvl(encoded_rvl(image), image.size), image)


NUMBER = st.floats(-10, 10)
QUAT = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1)
SAMPLES = st.lists(
    st.tuples(st.integers(1, TF_GAP_NS), st.tuples(NUMBER, NUMBER, NUMBER), QUAT), min_size=2, max_size=6
)


@few(60)
@given(SAMPLES, st.floats(0, 1), st.randoms(use_true_random=False))
def test_a_moving_frame_is_rigid_at_all_times_and_where_it_was_seen(samples: Any, share: float, order: Any) -> None:
    tree, stamps = TfTree(), np.cumsum([gap for gap, _, _ in samples]).tolist()
    shuffled = list(zip(stamps, samples, strict=True))
    order.shuffle(shuffled)
    for stamp, (_, position, quat) in shuffled:
        unit = np.array(quat) / np.linalg.norm(quat)
        tree.add("world", "camera", stamp, np.array(position), unit, static=False)
    for stamp, (_, position, _) in zip(stamps, samples, strict=True):
        T = tree.lookup("world", "camera", stamp)
        assert T[:3, 3] == pytest.approx(position, abs=1e-12)
    between = stamps[0] + int(share * (stamps[-1] - stamps[0]))
    T, back = tree.lookup("world", "camera", between), tree.lookup("camera", "world", between)
    assert T[:3, :3].T @ T[:3, :3] == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0, abs=1e-9)
    assert back == pytest.approx(invert_transform(T), abs=1e-9)
    corners = np.array([position for _, position, _ in samples])
    assert (corners.min(axis=0) - 1e-9 <= T[:3, 3]).all() and (T[:3, 3] <= corners.max(axis=0) + 1e-9).all()
    assert [tree.lookup("world", "camera", stamp) for stamp in (stamps[0] - 1, stamps[-1] + 1)] == [None, None]


@few(80)
@given(st.lists(st.one_of(st.floats(), st.floats(-1, 1)), min_size=8, max_size=8))
@example([0.0] * 4 + [2e-160, 1e-160, 0.0, 1.3e-160])  # squares that underflow
@example([0.0] * 4 + [5e-324, 0.0, 0.0, 0.0])
def test_a_line_of_poses_is_rigid_or_refused(tmp_path_factory: pytest.TempPathFactory, numbers: list[float]) -> None:
    path = tmp_path_factory.getbasetemp() / "poses.txt"
    path.write_text(" ".join(map(repr, numbers)) + "\n")
    try:
        poses = READERS["tum"](path)
    except InputError:
        return
    assert len(poses) == 1 or np.isnan(numbers[1:]).any()  # a line of NaN is no pose
    for T in poses.values():
        assert np.isfinite(T).all() and T[:3, :3].T @ T[:3, :3] == pytest.approx(np.eye(3), abs=1e-6)


KINDS = st.sampled_from(["<f4", "<f8", ">f4", "|u1", "<u2", "<i8", "<U3"])


@few(40)
@given(st.lists(st.tuples(KINDS, st.lists(st.integers(0, 4), max_size=3), st.booleans()), max_size=4))
def test_arrays_come_back_from_a_file(tmp_path_factory: pytest.TempPathFactory, kinds: Any) -> None:
    arrays = {}
    for number, (kind, shape, is_by_columns) in enumerate(kinds):
        values = np.arange(int(np.prod(shape))).reshape(shape).astype(kind)
        arrays[f"a {number}"] = np.asfortranarray(values) if is_by_columns else values
    path = tmp_path_factory.getbasetemp() / "x.npz"
    savez(path, arrays)
    found = read_arrays(path, most=sum(array.nbytes for array in arrays.values()))
    first = read_arrays(path, list(arrays)[:1], most=sum(a.nbytes for a in found.values()))
    assert (list(found), list(first)) == (list(arrays), list(arrays)[:1])
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array, strict=True)
        stream = BytesIO()
        np.save(stream, array)
        assert np.array_equal(npy_of(stream.getvalue()), array)

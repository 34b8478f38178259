"""Recordings with errors of a known size."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.recording.calibrated import ChangedSource, Perturbation
from splatctrl_cli.recording.source import SourceOptions, open_source
from splatctrl_cli.records import RgbdFrame
from tests.recording.log.make_log import LogRecipe, make_log
from tests.refused import expect_refusal


def frames(path: Path, **perturb: float) -> list[RgbdFrame]:
    options = SourceOptions(perturb={name.replace("_", "-"): value for name, value in perturb.items()})
    return [record for record in open_source(path, options).records() if isinstance(record, RgbdFrame)]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_log(tmp_path_factory.mktemp("log") / "log.mcap", LogRecipe(cameras=("cam0", "cam1")))


def test_depth_noise_has_its_size_and_grows_with_the_square() -> None:
    depth = np.repeat(np.float32([0.0, 1.0, 2.0]), [10, 90, 100])[:, None].repeat(200, axis=1)
    noisy = Perturbation(depth_noise=0.01).depth("cam0", 5, depth)
    errors = noisy - depth
    assert [np.std(errors[10:100]), np.std(errors[100:])] == pytest.approx([0.01, 0.04], rel=0.03)
    assert not noisy[:10].any() and noisy.dtype == np.float32
    assert Perturbation(depth_noise=0.02).depth("cam0", 5, depth) - depth == pytest.approx(2 * errors, abs=1e-5)
    assert (Perturbation(depth_noise=5.0).depth("cam0", 5, depth) >= 0).all()


def test_each_frame_and_camera_has_noise_of_its_own_whatever_is_read_before(log: Path) -> None:
    plain, noisy, again, other = (
        [frame.depth for frame in frames(log, **perturb)]
        for perturb in ({}, *[{"depth_noise": 0.01}] * 2, {"depth_noise": 0.01, "seed": 1})
    )
    errors = [a - b for a, b in zip(noisy, plain, strict=True)]
    assert all(error.any() for error in errors) and len({error.tobytes() for error in errors}) == len(errors)
    assert np.array_equal(noisy, again)
    assert not any(np.array_equal(a, b) for a, b in zip(noisy, other, strict=True))


def test_a_camera_is_moved_and_turned_by_as_much_as_asked_the_same_in_every_frame(log: Path) -> None:
    moved, plain = frames(log, pose_error=0.02, pose_turn=3.0), frames(log)
    between = {
        a.camera: np.linalg.inv(b.T_world_camera) @ a.T_world_camera for a, b in zip(moved, plain, strict=True)
    }
    assert len({T.round(9).tobytes() for T in between.values()}) == 2
    for T in between.values():
        turn = np.degrees(np.arccos((np.trace(T[:3, :3]) - 1) / 2))
        assert [np.linalg.norm(T[:3, 3]), turn] == pytest.approx([0.02, 3.0])
    for a, b in zip(moved, plain, strict=True):
        assert np.allclose(b.T_world_camera @ between[a.camera], a.T_world_camera) and (a.depth == b.depth).all()
    poses = open_source(log, SourceOptions(perturb={"pose-error": 0.02, "pose-turn": 3.0})).poses()
    assert all(np.allclose(T, a.T_world_camera) for (_, _, T), a in zip(poses, moved, strict=True))


def test_no_error_is_the_recording_itself_and_an_error_is_among_what_was_read(log: Path) -> None:
    assert not isinstance(open_source(log, SourceOptions(perturb={"depth-noise": 0.0, "seed": 3})), ChangedSource)
    plain, noisy = open_source(log), open_source(log, SourceOptions(perturb={"depth-noise": 0.01}))
    assert noisy.digests().items() - plain.digests().items() == {("--perturb depth-noise=0.01", "depth-noise=0.01")}
    assert "perturbed: depth-noise=0.01" in noisy.loss.notes


@pytest.mark.parametrize(
    "given", [{"noise": 0.1}, {"depth-noise": -0.1}, {"seed": 0.5}, {"pose-error": float("nan")}]
)
def test_an_error_that_is_none_is_refused(given: dict[str, float]) -> None:
    expect_refusal("--perturb", Perturbation.of, given, error=UsageError)

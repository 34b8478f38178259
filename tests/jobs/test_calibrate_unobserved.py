"""Recordings that would fool `calibrate`: what they do not show is named, and not filled in."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.calibration import SetUp
from splatctrl_cli.errors import NotEvaluableError
from splatctrl_cli.geometry import back_project, invert_transform, look_at, pose_at, transform_points
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Bool, Float64, RgbdFrame
from splatctrl_cli.simulate import tabletop
from splatctrl_cli.simulate.primitives import Primitive
from splatctrl_cli.simulate.recording import RecordingOptions, Scene
from tests.calibration.scan import calibrated, robot_in

SMALL = RecordingOptions(duration_s=3.0, fps=2.0, width=160, height=120, color_rays=0)
MIDDLE = np.array([0.45, 0.0])  # [m] of the table, where the one thing stands


class Partial(SetUp):
    """Cameras that measure only some of what is before them."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed, SMALL)
        self.scale = 1.0

    def shows(self, points_world: Float64, stamp_ns: int) -> Bool:
        """Which points (H, W, 3)."""
        raise NotImplementedError

    def frames(self) -> Iterator[RgbdFrame]:
        for frame in super().frames():
            points = back_project(frame.intrinsics, frame.depth)
            world = transform_points(frame.T_world_camera, points.reshape(-1, 3)).reshape(points.shape)
            shown = np.where(self.shows(world, frame.stamp_ns), frame.depth, 0.0)
            yield replace(frame, depth=shown.astype(np.float32))


class Round(Partial):
    """A table with one thing that looks the same from all sides, recorded rightly but for two cameras of three."""

    thing = "cylinder"

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.off["cam0"] = np.eye(4)

    def _scene(self, seed: int, options: RecordingOptions) -> Scene:
        scene = super()._scene(seed, options)
        source = next(p for p in tabletop.things() if p.kind == self.thing)
        T = pose_at([*MIDDLE, source.T_world_shape[2, 3]])
        alone: tuple[Primitive, ...] = (scene.primitives[0], replace(source, T_world_shape=T), scene.primitives[-1])
        return replace(scene, primitives=alone)

    def shows(self, points_world: Float64, stamp_ns: int) -> Bool:
        """The table within its edges, and the thing, without the arm's base."""
        x, y, z = np.moveaxis(points_world, -1, 0)
        is_table = (x > -0.4) & (x < 1.0) & (np.abs(y) < 0.75) & (z > -0.04)
        return np.asarray(is_table & ~((np.hypot(x, y) < 0.25) & (z > 0.02)))


class OneLink(Partial):
    """Nothing but one link of a robot that moves."""

    link = "link4"

    def shows(self, points_world: Float64, stamp_ns: int) -> Bool:
        pose = self.link_poses(self._motion.at((stamp_ns - self.start_ns) * 1e-9)[0])[self.link]
        return np.asarray(np.linalg.norm(points_world - pose[:3, 3], axis=-1) < 0.12)


@pytest.mark.parametrize(("thing", "seed"), [("cylinder", 2), ("sphere", 3)])
def test_turns_about_the_one_round_thing_on_a_table_are_named(thing: str, seed: int, tmp_path: Path) -> None:
    setup = Round(seed)
    setup.thing = thing
    setup.primitives = setup._scene(seed, SMALL).primitives
    with pytest.raises(NotEvaluableError) as refusal:
        calibrated(setup, tmp_path)
    assert "rotation about the table's normal" in refusal.value.message
    assert not list(tmp_path.glob("rig.toml*"))


def test_what_is_not_observed_stays_as_recorded_and_the_rest_is_found(tmp_path: Path) -> None:
    setup = Round(2)
    result = calibrated(setup, tmp_path, allow_unobserved=True)
    for camera in setup.cameras[1:]:
        found = result.calibration.cameras[camera.name]
        assert any("the table's" in direction for direction in found.unobserved)
        off = found.T @ invert_transform(camera.T_world_camera)  # of the world as it sees it
        recorded = camera.T_world_camera @ setup.off[camera.name] @ invert_transform(camera.T_world_camera)
        middle = np.array([*MIDDLE, 0.0, 1.0])
        assert abs((off @ middle)[2]) < 0.003 < abs((recorded @ middle)[2])
        assert np.degrees(np.arccos(off[2, 2])) < 0.3 < np.degrees(np.arccos(recorded[2, 2]))


def test_a_robot_of_which_one_link_is_seen_does_not_say_all(tmp_path: Path, plain_arm: Path) -> None:
    options = SourceOptions(cameras=("cam0",))
    with pytest.raises(NotEvaluableError, match=r"not observed: translation along . of the world of cam0"):
        calibrated(OneLink(2), tmp_path, options=options, **robot_in(plain_arm))


def test_a_camera_that_sees_neither_what_the_others_see_nor_the_robot_is_named(
    tmp_path: Path, plain_arm: Path
) -> None:
    setup = SetUp(2, SMALL)
    away = replace(setup.cameras[2], T_world_camera=look_at([0.6, 0.9, 0.8], [1.6, 1.3, 0.3]))
    setup.cameras = (*setup.cameras[:2], away)
    with pytest.raises(NotEvaluableError) as refusal:
        calibrated(setup, tmp_path, **robot_in(plain_arm))
    assert "of cam2" in refusal.value.message or "cam0, cam1 | cam2" in refusal.value.message
    assert "of cam0" not in refusal.value.message and "of cam1" not in refusal.value.message

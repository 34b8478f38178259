"""A reconstruction learns the robot's own parts first, keeps them in the scene's folder, and a replay takes them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from splatctrl_cli.errors import InputError
from splatctrl_cli.formats.arrays import savez
from splatctrl_cli.formats.scene.scene_folder import SELF_MODEL
from splatctrl_cli.formats.scene.scene_writer import SceneWriter, read_checkpoint
from splatctrl_cli.jobs.reconstruct import reconstruct
from splatctrl_cli.jobs.reconstruct.reconstruct import LearnRequest, ReconstructRequest, learn_robot
from splatctrl_cli.jobs.replay.inputs import grasp_contacts, open_log, read_states
from splatctrl_cli.jobs.replay.request import ReplayRequest
from splatctrl_cli.jobs.robot.logged_robot import NO_SELF_MODEL, add_self_model
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Float64
from splatctrl_cli.robot.declared_contact import Declarations
from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_model import ALWAYS, SelfModel, surface_digest
from tests.jobs.bake.baked import Said
from tests.refused import expect_refusal
from tests.robot.shapes import held_part

PLATE: Float64 = np.asarray(trimesh.creation.box((0.05, 0.05, 0.05)).triangles)
HELD = (10**9, 2 * 10**9)  # [ns]


@pytest.fixture
def request_(short_sample: Path, tmp_path: Path) -> ReconstructRequest:
    tabletop = short_sample / "tabletop"
    source = open_source(tabletop / "log.mcap", SourceOptions())
    spheres = tabletop / "robot_spheres.yaml"
    return ReconstructRequest(source=source, out=tmp_path / "scene", urdf=tabletop / "robot.urdf", spheres=spheres)


def learned(request: ReconstructRequest, *, is_new: bool = True) -> tuple[RobotModel, list[str]]:
    """The robot of a reconstruction whose folder is there already, and what was logged."""
    heard, robot = Said(), RobotModel.from_urdf(request.urdf, request.spheres)  # type: ignore[arg-type]
    robot = robot.moved_by(request.source.joint_names)
    request.out.mkdir(exist_ok=True)
    found, off = reconstruct._learn_self(robot, request, request.out, heard, is_new=is_new)
    assert not robot.surface.trees or max(row["distance_mm"] for row in off.values()) < 1.0
    return found, heard.lines


def holding(robot: RobotModel) -> SelfModel:
    found = held_part("panda_hand", PLATE, *HELD)
    return replace(found, links=tuple(robot.urdf.links), digest=surface_digest(robot.surface))


def replayed(request: ReconstructRequest, sample: Path, **more: object) -> RobotModel:
    log = sample / "tabletop" / "log.mcap"
    asked = ReplayRequest(log=log, out=request.out / "audit", urdf=request.urdf, spheres=request.spheres)
    return open_log(replace(asked, **more))[0]  # type: ignore[arg-type]


def of_primitives(plain_arm: Path) -> dict[str, Path]:
    """An arm that no mesh draws."""
    return {"urdf": plain_arm / "tabletop" / "robot.urdf", "spheres": plain_arm / "tabletop" / "robot_spheres.yaml"}


def test_what_the_recording_shows_is_kept_and_a_replay_of_the_scene_takes_it(
    request_: ReconstructRequest, short_sample: Path, plain_arm: Path
) -> None:
    robot, _ = learned(request_)
    assert robot.self_model is not None and (request_.out / SELF_MODEL).is_file()
    assert replayed(request_, short_sample, scene=request_.out).self_model is not None
    assert replayed(request_, short_sample, scene=request_.out, self_model=NO_SELF_MODEL).self_model is None
    other = of_primitives(plain_arm)
    assert replayed(request_, short_sample, scene=request_.out, **other).self_model is None
    expect_refusal("another robot", replayed, request_, short_sample, self_model=request_.out / SELF_MODEL, **other)


def test_in_lockstep_nothing_is_learned_ahead(
    request_: ReconstructRequest, short_sample: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reconstruct, "learn_from", None)
    assert replayed(request_, short_sample, lockstep=True).self_model is None


def test_a_run_that_goes_on_takes_the_file_that_is_there(
    request_: ReconstructRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reconstruct, "learn_from", None)
    assert learned(request_, is_new=False)[0].self_model is None
    savez(request_.out / SELF_MODEL, holding(RobotModel.from_urdf(request_.urdf, request_.spheres)).arrays())  # type: ignore[arg-type]
    SceneWriter(request_.out, {}).checkpoint({}, {})
    SceneWriter(request_.out, {}, read_checkpoint(request_.out)).close()
    robot, _ = learned(request_, is_new=False)
    assert robot.changes == [*HELD]


def test_without_meshes_or_with_none_nothing_is_learned_and_where_nothing_can_be_the_log_says_so(
    request_: ReconstructRequest, plain_arm: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> SelfModel:
        raise InputError("log.mcap: no link can be learned: panda_hand moves too little")

    monkeypatch.setattr(reconstruct, "learn_from", fails)
    robot, lines = learned(request_)
    assert robot.self_model is None and lines[1:] == [
        "nothing is learned of the robot's own parts: log.mcap: no link can be learned: panda_hand moves too little"
    ]
    for other in ({"self_model": NO_SELF_MODEL}, of_primitives(plain_arm)):
        assert not any("learn" in line for line in learned(replace(request_, **other))[1])  # type: ignore[arg-type]
    assert not (request_.out / SELF_MODEL).exists()


def test_a_hand_may_touch_what_it_takes_and_leaves_at_its_place_and_no_other_link_may(
    request_: ReconstructRequest, sample_data: Path
) -> None:
    log = sample_data / "tabletop" / "log.mcap"
    bare, source = open_log(ReplayRequest(log=log, out=request_.out, urdf=request_.urdf, spheres=request_.spheres))
    states = read_states(source, bare).states
    first_ns = int(states.stamp_ns[0])
    found = holding(bare)
    part = replace(found.learned[0], start_ns=first_ns + HELD[0], end_ns=first_ns + HELD[1])
    start, end = ALWAYS
    for each, words in (
        (part, "panda_hand holds an object from 1.00 to 2.00 s that protrudes by 50 mm"),
        (replace(part, end_ns=end), "panda_hand holds an object from 1.00 s on that protrudes by 50 mm"),
        (replace(part, start_ns=start), "panda_hand holds an object until 2.00 s that protrudes by 50 mm"),
        (replace(part, start_ns=start, end_ns=end), "panda_hand has a part that protrudes by 50 mm"),
    ):
        assert each.words(first_ns) == words
    model = bare.join_self_model(replace(found, learned=(part,)))
    contacts = [*grasp_contacts(model, states)]
    links = {contact.link for contact in contacts}
    assert "panda_hand" in links and "panda_link0" not in links
    taken, left = (
        model.frame_pose(states.position[np.abs(states.stamp_ns - stamp).argmin()], "panda_hand")[:3, 3]
        for stamp in (part.start_ns, part.end_ns)
    )
    assert np.linalg.norm(taken - left) > 0.1
    declared = Declarations(expected_contact=tuple(contacts))
    expected = [(taken, 0.5), (taken, 1.5), (left, 2.5)], [(taken, 2.5), (left, 1.5), (left, 3.5)]
    for times, is_expected in zip(expected, (True, False), strict=True):
        assert {declared.find_expected("panda_hand", *each) is not None for each in times} == {is_expected}
    assert [*grasp_contacts(bare, states)] == []


def test_a_log_whose_arm_is_as_its_urdf_draws_it_gives_a_self_model_without_parts(
    sample_data: Path, tmp_path: Path
) -> None:
    folder, out = sample_data / "tabletop", tmp_path / "self.npz"
    found = learn_robot(LearnRequest(log=folder / "log.mcap", urdf=folder / "robot.urdf", out=out))
    assert found.pieces() == [] and len(found.learned) > 3
    assert "panda_link0" in found.unknown
    model = RobotModel.from_urdf(folder / "robot.urdf", folder / "robot_spheres.yaml")
    assert len(add_self_model(model, out).surface.triangles) == len(model.surface.triangles)
    out.write_bytes(out.read_bytes()[:400])
    expect_refusal("not a self-model", add_self_model, model, out)

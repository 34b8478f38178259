"""Self-collision pairs: by SRDF, by structure and by sampled postures; each pair that is left out has a reason."""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.robot.model import RobotModel
from splatctrl_cli.robot.self_collision import read_srdf, self_collision_pairs
from tests.refused import expect_refusal
from tests.robot.shapes import BALL, arm_of, written


def chain(*radii: float) -> str:
    """A planar arm of links l0, l1, ... 0.2 m apart, a ball at each origin, and a pad fixed to the last."""
    links = "".join(
        f'<link name="l{i}"><collision><geometry><sphere radius="{r}"/></geometry></collision></link>'
        for i, r in enumerate(radii)
    )
    joints = "".join(
        f'<joint name="j{i}" type="revolute"><parent link="l{i - 1}"/><child link="l{i}"/><origin xyz="0 0 0.2"/>'
        '<axis xyz="0 1 0"/><limit lower="-2.5" upper="2.5" velocity="1" effort="1"/></joint>'
        for i in range(1, len(radii))
    )
    pad = '<link name="pad"><collision><geometry><sphere radius="0.02"/></geometry></collision></link>'
    glue = f'<joint name="glue" type="fixed"><parent link="l{len(radii) - 1}"/><child link="pad"/></joint>'
    return f'<robot name="c">{links}{joints}{pad}{glue}</robot>'


def reasons(found) -> dict[tuple[str, str], str | None]:  # type: ignore[no-untyped-def]
    return {pair.links: pair.left_out for pair in found.link_pairs}


@pytest.fixture
def arm(tmp_path: Path) -> RobotModel:
    return RobotModel.from_urdf(written(tmp_path, chain(0.05, 0.05, 0.05, 0.05)))


def test_neighbours_and_rigid_bodies_are_left_out_with_their_reason(arm: RobotModel) -> None:
    found = self_collision_pairs(arm)
    why = reasons(found)
    assert why["l0", "l1"] == why["l2", "l3"] == why["l2", "pad"] == "adjacent"
    assert why["l3", "pad"] == "one rigid body"
    assert [pair for pair, reason in why.items() if reason is None] == [
        ("l0", "l2"), ("l0", "l3"), ("l0", "pad"), ("l1", "l3"), ("l1", "pad"),
    ]  # fmt: skip
    np.testing.assert_array_equal(found.pairs, [[0, 2], [0, 3], [0, 4], [1, 3], [1, 4]])
    pair = next(pair for pair in found.link_pairs if pair.links == ("l0", "l2"))
    assert pair.largest_gap == pytest.approx(0.4 - 0.1, abs=1e-4)  # stretched
    assert pair.least_gap == pytest.approx(0.4 * np.cos(1.25) - 0.1, abs=1e-3)  # bent to the limit
    assert pair.hit_share == 0


def test_links_that_never_meet_are_left_out_only_when_asked_and_those_that_touch_always(
    arm: RobotModel, tmp_path: Path
) -> None:
    assert reasons(self_collision_pairs(arm, num_postures=300))["l0", "l2"] is None
    asked = reasons(self_collision_pairs(arm, num_postures=300, drop_never=True))
    assert (asked["l0", "l2"], asked["l0", "l3"]) == ("no nearer than 26 mm in 300 postures", None)
    fat = RobotModel.from_urdf(written(tmp_path, chain(0.3, 0.05, 0.3, 0.05)))
    assert reasons(self_collision_pairs(fat, num_postures=50))["l0", "l2"] == "touch in all 50 postures"


def test_the_seed_decides_the_sample(arm: RobotModel) -> None:
    one, again, other = (self_collision_pairs(arm, num_postures=40, seed=seed) for seed in (3, 3, 4))
    assert one.link_pairs == again.link_pairs and one.link_pairs != other.link_pairs


def test_a_locked_joint_makes_one_body_of_its_links(arm: RobotModel) -> None:
    why = reasons(self_collision_pairs(RobotModel.from_urdf(arm.urdf.path, locked={"j2": 1.0})))
    assert (why["l1", "l2"], why["l0", "l2"], why["l0", "l3"]) == ("one rigid body", "adjacent", None)


def test_an_srdf_takes_the_place_of_the_sample(arm: RobotModel, tmp_path: Path) -> None:
    srdf = written(
        tmp_path,
        '<robot name="c"><disable_collisions link1="l2" link2="l0" reason="Never"/>'
        '<disable_collisions link1="l0" link2="gripper" reason="Never"/></robot>',
        "c.srdf",
    )
    known, foreign = read_srdf(srdf, arm.urdf)
    assert foreign == [("l0", "gripper")]
    found = self_collision_pairs(arm, known)
    assert (reasons(found)["l0", "l2"], reasons(found)["l0", "l1"]) == ("SRDF: Never", "adjacent")
    assert (found.num_postures, len(found.pairs)) == (0, 4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("no xml", "expected an SRDF, got broken XML"),
        ("<sdf/>", "expected an SRDF, got <sdf>"),
        (arm_of(BALL, BALL), "expected an SRDF, got a URDF; give the file with <disable_collisions>"),
        ('<robot name="c"/>', "between links of the URDF, got none"),
        ('<robot name="c"><disable_collisions link1="l0"/></robot>', "expected link1 and link2, got"),
        ('<robot name="c"><disable_collisions link1="x" link2="y"/></robot>', "got 1 of links that robot.urdf lacks"),
    ],
)
def test_unusable_srdfs_are_refused_by_name(arm: RobotModel, tmp_path: Path, text: str, message: str) -> None:
    assert "c.srdf" in expect_refusal(message, read_srdf, written(tmp_path, text, "c.srdf"), arm.urdf)


def test_the_panda_srdf_names_only_links_of_the_panda(real_data: Path) -> None:
    folder = real_data / "vamp_panda/resources/panda"
    panda = RobotModel.from_urdf(folder / "panda_spherized.urdf")
    known, foreign = read_srdf(folder / "panda.srdf", panda.urdf)
    assert (len(known), len(foreign)) == (34, 0)
    by_srdf, by_sample = self_collision_pairs(panda, known), self_collision_pairs(panda)
    assert len(by_srdf.pairs) < len(by_sample.pairs)
    assert reasons(by_srdf)["panda_link2", "panda_link6"] == "SRDF: Never"

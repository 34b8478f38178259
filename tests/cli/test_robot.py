"""``splatctrl robot``: fits, measures, lists, and fails well."""

import json
from pathlib import Path

import pytest

from splatctrl_cli.cli.main import main
from splatctrl_cli.robot.sphere_files import read_spheres
from tests.robot.shapes import BALL, BOX, arm_of, l_shape, written


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    return written(tmp_path, arm_of(BOX, BALL))


def run(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    code = main(["robot", *map(str, arguments)])
    out, err = capsys.readouterr()
    return code, out, err


def result(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, object]:
    code, out, err = run(capsys, *arguments, "--json", "-q")
    assert (code, err) == (0, "")
    loaded: dict[str, object] = json.loads(out)
    return loaded


@pytest.mark.usefixtures("painted")
def test_a_fit_writes_spheres_that_a_check_finds_complete(
    capsys: pytest.CaptureFixture[str], urdf: Path, tmp_path: Path
) -> None:
    out, picture = tmp_path / "s.yaml", tmp_path / "s.png"
    fitted = result(capsys, "spheres", "--urdf", urdf, "--max-spheres", 5, "-o", out, "--picture", picture)
    checked = result(capsys, "check", "--urdf", urdf, "--spheres", out, "--require", "max_deficit<=0")
    assert fitted["metrics"] == checked["metrics"] and fitted["links"] == checked["links"]
    assert checked["metrics"]["uncovered_share"] == 0  # type: ignore[index]
    assert len(read_spheres(out).radii) == checked["metrics"]["num_spheres"] <= 5  # type: ignore[index]
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "# 5 spheres cover all of it (proven); they stick out by" in out.read_text()


@pytest.fixture
def one_sphere(tmp_path: Path) -> Path:
    """Spheres of one link alone."""
    return written(tmp_path, "collision_spheres: {tip: [{center: [0, 0, 0], radius: 0.07}]}", "s.yaml")


def test_the_table_names_links_and_what_sticks_out(
    capsys: pytest.CaptureFixture[str], urdf: Path, one_sphere: Path
) -> None:
    code, out, err = run(capsys, "check", "--urdf", urdf, "--spheres", one_sphere)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0].startswith("robot check: PASSED (1 spheres on 2 links)")
    assert (lines[2].split()[:2], lines[4].split()[0]) == (["link", "spheres"], "base")
    assert "no sphere" in lines[4] and "10.0" in lines[5]
    assert "1 spheres: 100.0 % of the surface outside" in out and "no sphere covers base" in out


@pytest.mark.parametrize(
    ("gate", "code", "said"),
    [
        (
            "uncovered_share<=0.2",
            1,
            "robot check: GATE FAILED (1 spheres on 2 links): --require uncovered_share<=0.2: uncovered_share is 1",
        ),
        ("max_deficit<=0.2", 5, "max_deficit is unknown, required <= 0.2"),
        ("deficit<=0.2", 2, "did you mean max_deficit?"),
    ],
)
def test_gates_hold_a_set_to_its_figures(
    capsys: pytest.CaptureFixture[str], urdf: Path, one_sphere: Path, gate: str, code: int, said: str
) -> None:
    found, out, err = run(capsys, "check", "--urdf", urdf, "--spheres", one_sphere, "-q", "--require", gate)
    assert found == code and said in (err if code == 2 else out)


def test_an_open_mesh_says_what_guarantee_remains(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    mesh = l_shape()
    mesh.update_faces([True] * 19 + [False])
    mesh.export(tmp_path / "ell.stl")
    urdf = written(tmp_path, arm_of('<mesh filename="ell.stl"/>', BALL))
    code, out, _ = run(capsys, "spheres", "--urdf", urdf, "--max-spheres", 3, "-o", tmp_path / "s.yaml", "-q")
    assert code == 0
    assert "cover all of the collision surface (proven)" in out
    assert "not closed: base: distances to the surface are right; without an inside" in out


def test_spheres_that_are_off_or_of_other_links_are_counted(capsys: pytest.CaptureFixture[str], urdf: Path) -> None:
    text = """collision_spheres: {tip: [{center: [0, 0, 0], radius: 0.1}, {center: [0, 0, 0], radius: -1}],
      hand: [{center: [0, 0, 0], radius: 0.1}]}"""
    code, out, _ = run(capsys, "check", "--urdf", urdf, "--spheres", written(urdf.parent, text, "s.yaml"))
    assert code == 0
    assert "1 spheres are switched off (radius 0 or less) and cover nothing" in out
    assert "spheres of hand are left out: robot.urdf has no such link" in out


def test_info_shows_limits_locks_and_bodies(capsys: pytest.CaptureFixture[str], urdf: Path) -> None:
    code, out, err = run(capsys, "info", "--urdf", urdf)
    assert (code, err) == (0, "")
    assert out.splitlines()[2].split() == ["hinge", "revolute", "-1.0000", "1.0000", "1.0000"]
    shown = result(capsys, "info", "--urdf", urdf)
    assert shown["joints"] == [{"name": "hinge", "lower": -1.0, "upper": 1.0, "velocity": 1.0}]
    assert (shown["collision_links"], shown["num_spheres"]) == (["base", "tip"], 0)


def test_pairs_are_listed_with_the_reason_of_those_left_out(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    urdf = written(tmp_path, arm_of(BALL, BALL))
    code, out, _ = run(capsys, "pairs", "--urdf", urdf, "--postures", 10)
    assert code == 0
    assert out.splitlines()[2].split() == ["base", "tip", "1", "140", "to", "140", "0.0", "adjacent"]
    srdf = written(tmp_path, '<robot name="r"><disable_collisions link1="base" link2="tip"/></robot>', "r.srdf")
    listed = result(capsys, "pairs", "--urdf", urdf, "--srdf", srdf)
    assert (listed["num_sphere_pairs"], listed["num_postures"]) == (0, 0)


@pytest.mark.parametrize(("prefix", "is_doubted"), [("panda_", True), ("fr3_", False)])
def test_spheres_of_another_robots_names_are_matched_and_doubted(
    capsys: pytest.CaptureFixture[str], urdf: Path, prefix: str, is_doubted: bool
) -> None:
    text = urdf.read_text().replace('"base"', '"fr3_base"').replace('"tip"', '"fr3_tip"')
    renamed = written(urdf.parent, text, "fr3.urdf")
    radii = ", ".join(
        f"{prefix}{link}: [{{center: [0, 0, 0], radius: {r}}}]" for link, r in (("tip", 0.07), ("base", 0.2))
    )
    spheres = written(urdf.parent, f"collision_spheres: {{{radii}}}", "s.yaml")
    for action in ("check", "pairs", "info"):
        code, out, _ = run(capsys, action, "--urdf", renamed, "--spheres", spheres)
        doubt = "matched without the first part of their names; is it the same robot?"
        assert (code, doubt in out) == (0, is_doubted), action


def test_a_robot_whose_meshes_are_not_there_is_shown_all_the_same(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    urdf = written(tmp_path, arm_of('<mesh filename="package://arm/base.stl"/>', BALL))
    shown = result(capsys, "info", "--urdf", urdf)
    (lost,) = shown["meshes_not_found"]  # type: ignore[misc]
    assert "package://arm/base.stl was not found" in lost and "--packages" in lost
    code, out, _ = run(capsys, "info", "--urdf", urdf)
    assert code == 0 and "1 of 1 meshes are not found: " in out

"""What a configuration may say, and what it is told when it may not."""

import inspect
import re
from dataclasses import fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from splatctrl_cli.checks import limits
from splatctrl_cli.config import Config, fixed, load_config
from splatctrl_cli.config.load import resolved_settings, template_of, toml_of
from splatctrl_cli.errors import InputError, SplatCtrlError, UsageError
from tests.refused import expect_refusal
from tests.robot.shapes import written


def test_assignments_win_over_the_file_and_the_file_over_the_defaults(tmp_path: Path) -> None:
    """Values may pass each other on the way, and a word that TOML takes for a number is a word."""
    assert load_config(None, []) == Config()
    text = "[scene]\nmax_splats = 7\nmin_radius = 0.03\nlambda_depth = 2\n[control]\nmargin = 0.03\n"
    given = ["scene.max_splats=9", "occupancy.rule=literal", "scene.max_radius=0.05", "occupancy.voxel=0.05"]
    config = load_config(written(tmp_path, text, "my.toml"), [*given, "field.unknown=nan"])
    assert (config.scene.max_splats, config.scene.min_radius, config.scene.max_radius) == (9, 0.03, 0.05)
    assert config.scene.lambda_depth == 2.0 and isinstance(config.scene.lambda_depth, float)
    assert (config.control.margin, config.occupancy.rule, config.field.unknown) == (0.03, "literal", "nan")


@pytest.mark.parametrize(
    ("assignments", "words"),
    [
        ("scene.max_splat=9", "unknown key scene.max_splat; did you mean scene.max_splats?"),
        ("scen.max_splats=9", "unknown key scen; did you mean scene?"),
        ("scene.zzz=9", "unknown key scene.zzz; known here: max_splats"),
        ("scene=9", "expected section.key=value; write it like --set scene.max_splats=3000"),
        ("scene.max_splats", "expected section.key=value"),
        ("scene.max_splats=2.5", "expected int, 1 to 10000000, got 2.5"),
        ("scene.max_splats=true", "expected int, 1 to 10000000, got True"),
        ("scene.fill=many", "expected float, 0.001 to 1, got 'many'"),
        ("scene.fill=nan", "scene.fill: expected 0.001 to 1, got nan"),
        ("scene.min_radius=0.5", "scene.min_radius: expected at most scene.max_radius = 0.02 m, got 0.5"),
        ("scene.max_depth_error=0.01", "scene.min_depth_error: expected at most scene.max_depth_error = 0.01 m"),
        ("occupancy.log_odds_limit=0.8", "occupancy.log_odds_limit: expected above 0.847, the log-odds of"),
        ("occupancy.max_range=0.2", "occupancy.max_range: expected above occupancy.min_range = 0.2 m, got 0.2"),
        (
            "field.length_scale=-1",
            "field.length_scale: expected 1e-10 to 1000 m, got -1.0; see splatctrl config --template",
        ),
        (
            "occupancy.free_below=0.9",
            "occupancy.free_below: expected at most occupancy.occupied_above = 0.7, got 0.9",
        ),
        ("scene.min_radius=0.03", "scene.min_radius: expected at most scene.max_radius = 0.02 m, got 0.03"),
        ("occupancy.voxel=0.01", "occupancy.voxel: expected at least scene.max_radius = 0.02 m, got 0.01"),
        (
            "control.barrier_gain=101",
            "control.barrier_gain: expected at most 1 / control.period = 100 1/s, got 101.0",
        ),
        ("control.period=0.05 control.pose_gain=21 control.barrier_gain=1", "pose_gain"),
        (
            "control.posture_gain=200",
            "control.posture_gain: expected at most 1 / control.period = 100 1/s, got 200.0",
        ),
        ("control.self_slack_cost=10", "control.self_slack_cost: expected at least control.slack_cost = 1000"),
        ("control.period=0.1 control.max_time=0.05", "control.max_time: expected at least"),
        (
            "control.max_acceleration=[1,'x']",
            "expected float or list of float, 0 or 0.01 to 1000 rad/s^2, got [1, 'x']",
        ),
        ("planner.shortest=2", "planner.shortest: expected at most planner.reach = 1.5 rad, got 2.0"),
    ],
)
def test_what_cannot_be_or_contradicts_is_named(assignments: str, words: str) -> None:
    expect_refusal(words, load_config, None, assignments.split(), error=UsageError)


def test_an_unknown_key_that_is_near_none_is_told_a_few_of_the_known() -> None:
    words = r"\.\.\. \(splatctrl config --template has all\)$"
    assert expect_refusal(words, load_config, None, ["scene.zzz=9"], error=UsageError).count(",") == 8


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        (None, InputError, r"my.toml: no such file"),
        ("[scene\n", UsageError, r"my.toml: not valid TOML"),
        ("scene = 3\n", UsageError, "scene: expected a table, got 3"),
    ],
)
def test_files_that_are_missing_or_no_toml_are_named(
    tmp_path: Path, text: str | None, error: type[SplatCtrlError], words: str
) -> None:
    if text is not None:
        (tmp_path / "my.toml").write_text(text)
    expect_refusal(words, load_config, tmp_path / "my.toml", [], error=error)


@pytest.mark.parametrize(
    "text", ["nan", "inf", "-inf", "1e308", "-1e308", "-0.05", "'0.05'", "[0.1]", "0x" + "f" * 5000]
)
def test_a_file_and_an_assignment_are_refused_alike(tmp_path: Path, text: str) -> None:
    (tmp_path / "bad.toml").write_text(f"[control]\nmargin = {text}\n")
    for path, assignments in ((tmp_path / "bad.toml", []), (None, [f"control.margin={text}"])):
        expect_refusal(
            r"control\.margin: expected (float, )?0 to 1 m, got ", load_config, path, assignments, error=UsageError
        )


@pytest.mark.parametrize(
    ("section", "changes", "words"),
    [
        ("control", {"max_linear_speed": -1.0}, r"control.max_linear_speed: expected 0.0001 to 20 m/s, got -1"),
        ("occupancy", {"rule": "bogus"}, r"occupancy.rule: expected observed or literal, got 'bogus'"),
    ],
)
def test_a_section_is_checked_however_it_is_made(section: str, changes: dict[str, Any], words: str) -> None:
    expect_refusal(words, replace, getattr(Config(), section), error=UsageError, **changes)


@pytest.mark.parametrize("name", [section.name for section in fields(Config)])
def test_every_key_is_declared_with_a_reason_and_a_range_around_its_default(name: str) -> None:
    """And every number is of one plain type."""
    values = getattr(Config(), name)
    assert values.section == name
    assert all(isinstance(value, int | float | str) for value in Config().as_dict()[name].values())
    for key, declared in values.declared.items():
        assert declared.reason and declared.holds(getattr(values, key)), key
        assert not any(declared.holds(bad) for bad in (float("nan"), float("inf"), 1e308, -1e308)), key


@pytest.mark.parametrize("module", [fixed, limits])
def test_every_fixed_number_says_what_it_decides(module: ModuleType) -> None:
    told = re.findall(r"^(\w+) = .*?  # \S", inspect.getsource(module), re.MULTILINE)
    assert told == [name for name in vars(module) if name.isupper()]


GIVEN = ["scene.max_splats=9", "preset=paper", "control.max_acceleration=[1.0, 2.5]"]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return written(tmp_path, "[scene]\nmax_splats = 7\nfill = 0.5\n[control]\nbarrier_gain = 4\n", "my.toml")


def test_each_value_says_where_it_comes_from(file: Path) -> None:
    found = {setting.name: (setting.value, setting.source) for setting in resolved_settings(file, GIVEN)}
    expected = {
        "scene.max_splats": (9, "--set"),
        "scene.fill": (0.5, str(file)),
        "control.barrier_gain": (4.0, str(file)),
        "control.program": ("printed", "--preset paper"),
        "control.margin": (Config().control.margin, "default"),
    }
    assert {name: found[name] for name in expected} == expected
    assert len(found) == sum(len(section) for section in Config().as_dict().values())


def test_what_is_printed_is_a_file_with_the_same_settings(file: Path, tmp_path: Path) -> None:
    lines = [*toml_of(resolved_settings(file, GIVEN))]
    assert load_config(written(tmp_path, "\n".join(lines), "again.toml"), []) == load_config(file, GIVEN)
    assert f"fill = 0.5  # {file} (default: 0.85)" in lines


def test_a_template_sets_nothing_and_uncommented_the_defaults(tmp_path: Path) -> None:
    """It has no value that is given."""
    lines = [*template_of(resolved_settings(None, []))]
    assert [*template_of(resolved_settings(None, GIVEN))] == lines
    keys = [line.removeprefix("# ") for line in lines if line.startswith("[") or " = " in line.split(";")[0]]
    for text in (lines, keys):
        assert load_config(written(tmp_path, "\n".join(text), "template.toml"), []) == Config()
    assert {"# budget of splats (IV-C); ten million take 2 GB; 1 to 10000000", "# max_splats = 5000"} <= {*lines}

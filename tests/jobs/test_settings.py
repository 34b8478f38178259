"""Settings with their sources, and the TOML that is made of them."""

from pathlib import Path

import pytest

from splatctrl_cli.config import Config, load_config
from splatctrl_cli.jobs.settings import resolved_settings, template_of, toml_of

GIVEN = ["scene.max_splats=9", "preset=paper", "control.max_acceleration=[1.0, 2.5]"]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "my.toml"
    path.write_text("[scene]\nmax_splats = 7\nfill = 0.5\n[control]\nbarrier_gain = 4\n")
    return path


def test_each_value_says_where_it_comes_from(file: Path) -> None:
    found = {setting.name: (setting.value, setting.source) for setting in resolved_settings(file, GIVEN)}
    assert found["scene.max_splats"] == (9, "--set")
    assert found["scene.fill"] == (0.5, str(file))
    assert found["control.barrier_gain"] == (4.0, str(file))
    assert found["control.program"] == ("printed", "--preset paper")
    assert found["control.margin"] == (Config().control.margin, "default")
    num_keys = sum(len(section) for section in Config().as_dict().values())
    assert len(found) == num_keys


def test_what_is_printed_is_a_file_with_the_same_settings(file: Path, tmp_path: Path) -> None:
    again = tmp_path / "again.toml"
    again.write_text("\n".join(toml_of(resolved_settings(file, GIVEN))))
    assert load_config(again, []) == load_config(file, GIVEN)
    assert f"fill = 0.5  # {file} (default: 0.85)" in again.read_text()


def test_a_template_sets_nothing_and_uncommented_the_defaults(tmp_path: Path) -> None:
    path, lines = tmp_path / "template.toml", [*template_of(resolved_settings(None, []))]
    path.write_text("\n".join(lines))
    assert load_config(path, []) == Config()
    keys = [line.removeprefix("# ") for line in lines if line.startswith("[") or " = " in line.split(";")[0]]
    path.write_text("\n".join(keys))
    assert load_config(path, []) == Config()
    assert "# budget of splats (IV-C); ten million take 2 GB; 1 to 10000000" in lines
    assert "# max_splats = 5000" in lines


def test_a_template_has_no_value_that_is_given() -> None:
    assert [*template_of(resolved_settings(None, GIVEN))] == [*template_of(resolved_settings(None, []))]

"""Sweeps over a simulated recording that goes through the real commands: what they run, and a flip that is known."""

import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from splatctrl_cli.cli.batch import OfThisProgram
from splatctrl_cli.cli.main import main
from splatctrl_cli.errors import UsageError
from splatctrl_cli.jobs.runs.run_folder import open_run
from splatctrl_cli.jobs.sweep.keys import chain_of, key_of
from splatctrl_cli.jobs.sweep.sweep import Runs, SweepRequest, sweep

PROGRAM = OfThisProgram(threads=1)
TOLERATED = 0.001  # [m] below the margin, which the criterion allows
SIMULATE = ("--duration", "2.5", "--width", "160", "--height", "120", "--noise", "none", "-o", "recording")


@dataclass(frozen=True)
class Recorded:
    """A folder with a simulated recording, its scene, and its audit, made by commands of relative paths."""

    folder: Path

    def command(self, *words: str) -> None:
        command = [sys.executable, "-m", "splatctrl_cli", *words, "-q"]
        subprocess.run(command, cwd=self.folder, check=True, capture_output=True)

    def words(self, *over: str, run: str = "audit") -> dict[str, list[str]]:
        """The command lines by command that a sweep would run at the values of ``KEY=VALUE``."""
        values = {name: float(text) for name, _, text in (each.partition("=") for each in over)}
        found = open_run(self.folder / run)
        chain = chain_of(found, {name: key_of(name) for name in values}, PROGRAM)
        runs = Runs(run=found, chain=chain, out=self.folder / "out", command_line=PROGRAM)
        return {node.command: list(node.words) for node in runs.nodes_at(values)}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    recorded = Recorded(tmp_path_factory.mktemp("recorded"))
    robot = ("--urdf", "recording/robot.urdf", "--spheres", "recording/robot_spheres.yaml")
    fit = ("--cameras", "cam0,cam1,cam2", "--max-splats", "2000", "--set", "scene.fill=0.8")
    recorded.command("simulate", *SIMULATE)
    recorded.command("reconstruct", "recording/log.mcap", *robot, *fit, "-o", "scene")
    truth = ("--truth", "recording/truth.json", "--worst-frames", "0")
    recorded.command("replay", "recording/log.mcap", "--scene", "scene", *robot, *truth, "-o", "audit")
    return recorded


def test_the_margin_flips_at_the_clearance_of_the_run(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = open_run(recorded.folder / "audit")
    clearance = min(float(run.metrics[name]) for name in ("min_clearance", "min_clearance_true"))
    request = SweepRequest(
        replay=run.path, over=("margin=0.02:0.06",), out=tmp_path / "sweep", tolerance=1 / 16, workers=2
    )
    flip = sweep(request, PROGRAM).flips[0]
    assert flip.last is not None and flip.first is not None
    assert flip.last.values["margin"] <= clearance + TOLERATED < flip.first.values["margin"]
    assert flip.first.values["margin"] - flip.last.values["margin"] <= 0.04 / 16 * (1 + 1e-9)
    assert (flip.last.label, flip.first.label) == ("safe", "margin broken")
    again = open_run(tmp_path / "sweep" / flip.start.folder)  # 0.02 is what the run had: the same comes out again
    assert (again.metrics, again.verdict["reasons"]) == (run.metrics, run.verdict["reasons"])
    assert (again.path / "steps.csv").read_bytes() == (run.path / "steps.csv").read_bytes()
    words = ["sweep", str(run.path), "--over", "margin=0.02:0.06", "--tolerance", "0.0625", "-o", str(request.out)]
    assert main([*words, "-v"]) == 0
    said = capsys.readouterr().out
    assert flip.sentence in said and "7 runs, 0 of them new" in said
    assert main([*words, "--over", "margin=0.1:0.1"]) == 2


def test_a_key_of_the_replay_leaves_the_scene_as_it_is(recorded: Recorded) -> None:
    words = recorded.words("latency=0.25")
    assert list(words) == ["replay"]
    assert {"--latency=0.25", f"--scene={recorded.folder / 'scene'}", "--worst-frames=0"} <= set(words["replay"])


def test_a_key_of_the_map_makes_it_again_with_its_own_options(recorded: Recorded) -> None:
    words = recorded.words("splats=700", "scene.max_gap=0.02", "depth-noise=0.004")
    kept = {"--max-splats=700", "--set=scene.fill=0.8", "--set=scene.max_gap=0.02", "--cameras=cam0,cam1,cam2"}
    assert {*kept, "--perturb=depth-noise=0.004"} <= set(words["reconstruct"])
    assert "--perturb=depth-noise=0.004" in words["replay"]
    out = next(word for word in words["reconstruct"] if word.startswith("--out=")).removeprefix("--out=")
    assert f"--scene={out}" in words["replay"]
    assert "--cameras=cam0" in recorded.words("cameras-out=2")["reconstruct"]


def test_an_obstacle_is_simulated_again_and_all_read_that(recorded: Recorded) -> None:
    words = recorded.words("obstacle-radius=0.1", "obstacle-x=0.5")
    assert {"--visitor=0.5,0.08,0.1", "--duration=2.5", "--noise=none"} <= set(words["simulate"])
    out = next(word for word in words["simulate"] if word.startswith("--out=")).removeprefix("--out=")
    assert words["reconstruct"][-1] == words["replay"][-1] == f"{out}/log.mcap"
    assert f"--truth={out}/truth.json" in words["replay"]


def test_a_margin_can_turn_a_driven_arm_more_than_once_and_is_searched(recorded: Recorded) -> None:
    for mode, is_monotone in (("audit", True), ("closed-loop", False)):
        run = open_run(recorded.folder / "audit")
        run = replace(run, words=(*run.arguments, "--mode", mode))
        chain = chain_of(run, {"margin": key_of("margin")}, PROGRAM)
        assert chain.keys["margin"].is_monotone == is_monotone


def test_the_options_of_a_run_are_taken_over_as_they_were_given(recorded: Recorded) -> None:
    for name in ("audit", "scene"):
        given = open_run(recorded.folder / name).arguments
        options = PROGRAM.options_of(given)
        assert PROGRAM.options_of(PROGRAM.parsed(given[0], options, Path())[0]) == options


def test_a_key_without_a_map_to_change_is_refused(recorded: Recorded) -> None:
    run = json.loads((recorded.folder / "audit" / "run.json").read_text())
    lockstep = recorded.folder / "lockstep"
    lockstep.mkdir()
    words = [word for word in run["arguments"] if word not in ("--scene", "scene")] + ["--lockstep"]
    del run["inputs"]["splats.ply"]
    (lockstep / "run.json").write_text(json.dumps(run | {"arguments": words}))
    assert "--set=scene.max_splats=700" in recorded.words("splats=700", run="lockstep")["replay"]
    with pytest.raises(UsageError, match="does not say which cameras trained"):
        recorded.words("cameras-out=1", run="lockstep")

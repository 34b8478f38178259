"""The command line as a person meets it: help, exit codes, one line per error, nothing left.

Tests of imports, signals and streams run processes; the others run in this one.
"""

import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name

import pytest

from splatctrl_cli.cli.commands import COMMANDS, Command, build_parser
from splatctrl_cli.cli.main import main
from tests.cli.here import checked, splatctrl
from tests.conftest import ROOT
from tests.recording.log.make_log import LogRecipe, make_log

NO_OUTPUT = (  # or one where it goes on
    *("audit", "info", "check", "batch", "sweep", "compare", "config", "completion", "help"),
)
WRITERS = [command for command in COMMANDS if command not in NO_OUTPUT]
HEAVY = ("torch", "pinocchio", "cv2", "open3d", "numpy", "scipy", "matplotlib", "trimesh", "mcap", "clarabel")
QUICK = (
    *("--max-splats", "60", "--threads", "1", "--set", "scene.first_iterations=2"),
    *("--set", "scene.iterations_per_step=1", "--box=-3,-3,-1,3,3,3", "--set", "occupancy.voxel=0.1"),
)
ARM = """<robot name="r"><link name="base"/><link name="a"/><link name="b">
<collision><geometry><sphere radius="0.02"/></geometry></collision></link>
<joint name="{0}" type="revolute"><parent link="base"/><child link="a"/><origin xyz="0 0 0.2"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="2" effort="9"/></joint>
<joint name="{1}" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 0.2"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="2" effort="9"/></joint></robot>"""


@dataclass(frozen=True)
class Work:
    """A folder in which a small log went through the main job once."""

    folder: Path

    @property
    def log(self) -> Path:
        return self.folder / "log.mcap"

    def arguments(self, command: str, out: Path) -> list[object]:
        """Arguments with which `command` succeeds and writes `out`."""
        scene, urdf = self.folder / "scene", self.folder / "robot.urdf"
        given: dict[str, list[object]] = {
            "simulate": ["--duration", "1", "--width", "64", "--height", "48"],
            "ingest": [self.log],
            "reconstruct": [self.log, "--cameras", "cam0", *QUICK],
            "calibrate": [self.log, "--allow-unobserved"],
            "export": [scene],
            "sdf-bake": [scene, "--voxel", "0.5", "--set", "field.max_loss=1"],
            "query": [scene, self.folder / "points.csv"],
            "score": [scene, "--reference", self.log, "--cameras", "cam1", "--threads", "1"],
            "robot": ["spheres", "--urdf", urdf],
            "replay": [self.log, "--scene", scene, "--urdf", urdf, "--max-unknown", "1"],
            "render": [scene],
            "report": [scene],
            "view": [scene, "--no-open"],
            "demo": [],
        }
        return [command, *given[command], "-o", out]


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Work:
    """A log of two cameras, its scene, and a two-joint arm whose joints are in the log."""
    work = Work(tmp_path_factory.mktemp("work"))
    make_log(work.log, LogRecipe(cameras=("cam0", "cam1")))
    (work.folder / "points.csv").write_text("x,y,z\n0,0,1\n")
    (work.folder / "robot.urdf").write_text(ARM.format("joint_a", "joint_b"))
    done = splatctrl(*work.arguments("reconstruct", work.folder / "scene"), "-q")
    assert done.returncode == 0, done.stderr
    return work


def assert_refused(done: subprocess.CompletedProcess[str], code: int, *words: str) -> None:
    """It ended with `code` after one line on stderr that holds `words`, and nothing on stdout."""
    assert (done.returncode, done.stdout) == (code, ""), done.stderr
    assert done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("splatctrl: ")
    for word in words:
        assert word in done.stderr


def run_process(words: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)


def test_help_imports_nothing_heavy_and_fits_a_screen() -> None:
    """Of a command: its usage, the options that people use, two examples, and where to find the rest."""
    program = f"""
import contextlib, io, json, sys
from splatctrl_cli.cli.main import main
found = {{}}
for command in {["", *COMMANDS]!r}:
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.suppress(SystemExit):
        main([*command.split(), "--help"])
    found[command] = said.getvalue(), [name for name in {HEAVY!r} if name in sys.modules]
print(json.dumps(found))
"""
    words = [sys.executable, "-c", program]
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=os.environ | {"COLUMNS": "100"})
    found = json.loads(done.stdout)
    for command, (said, heavy) in found.items():
        assert said.startswith(f"usage: splatctrl {command}") and "show this help" in said
        assert not heavy and len(said.splitlines()) <= 40, command
        assert not command or len(re.findall(f"^  splatctrl {command}", said, flags=re.MULTILINE)) == 2, command
    assert all(f"    {name}" in found[""][0] for name in COMMANDS) and "130 interrupted" in found[""][0]


@pytest.mark.parametrize(
    ("command", "word"),
    [
        *(("replay", option) for option in ("--evidence", "--controller", "--junit")),
        *((command, "--junit") for command in ("check", "reconstruct", "score", "batch", "compare", "demo")),
        *((command, "--holdout") for command in ("ingest", "reconstruct", "score", "check")),
    ],
)
def test_what_people_look_for_is_in_the_short_help(
    command: str, word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        build_parser(command).parse_args([command, "--help"])
    assert re.search(rf"(^|\s){word}\b", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("words", "page"),
    [("ci", "docs/ci.md"), ("scannet", "docs/examples/scannet.toml"), ("", "docs/README.md")],
)
def test_help_prints_a_page(words: str, page: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["help", *words.split()]) == 0
    assert capsys.readouterr().out == (ROOT / page).read_text()


def test_help_prints_the_settings_and_names_the_nearest_page_for_a_wrong_word() -> None:
    done = [splatctrl(*words.split()) for words in ("help settings", "config --template", "help info")]
    shown, template, info = (each.stdout for each in done)
    assert {each.returncode for each in done} == {0} and "--intrinsics" in info
    assert shown.split("[scene]\n", 1)[1].strip() == template.split("[scene]\n", 1)[1].strip()
    assert_refused(splatctrl("help", "replays"), 2, "splatctrl: help: no page 'replays'; did you mean replay?\n")
    assert_refused(splatctrl("help", "margins"), 2, "splatctrl: help: no page 'margins'; see robot\n")


def leaves(commands: dict[str, Command]) -> Iterator[tuple[list[str], Command]]:
    for name, command in commands.items():
        below = {} if command.actions is None else command.actions
        yield from (([name, *words], one) for words, one in leaves(below)) if below else [([name], command)]


@pytest.mark.parametrize(("words", "command"), [*leaves(COMMANDS)], ids=lambda value: str(value)[:20])
def test_all_help_shows_every_option_and_the_command_has_a_function(
    capsys: pytest.CaptureFixture[str], words: list[str], command: Command
) -> None:
    assert callable(resolve_name(f"splatctrl_cli.cli.{command.run}"))
    with pytest.raises(SystemExit) as ended:
        build_parser(words[0]).parse_args([*words, "--help-all"])
    shown = capsys.readouterr().out
    assert ended.value.code in (0, None)
    assert shown.startswith(f"usage: splatctrl {' '.join(words)}")
    assert "\nrun:\n" in shown and "--quiet" in shown and (("\ninput:\n" in shown) == ("--cameras" in shown))


@pytest.mark.parametrize("command", [name for name, command in COMMANDS.items() if not command.actions])
def test_examples_are_taken(command: str) -> None:
    for example in COMMANDS[command].examples:
        assert build_parser(command).parse_args(shlex.split(example)).command == command


def test_a_command_runs_without_the_files_of_the_others(
    sample_data: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "splatctrl_cli.cli.replay", None)  # importing it fails
    assert main(["info", str(sample_data / "tabletop" / "truth.json")]) == 0
    capsys.readouterr()
    assert main(["replay", "a", "--field", "b", "--urdf", "c"]) == 70
    assert "splatctrl_cli.cli.replay" in capsys.readouterr().err


@pytest.mark.parametrize("command", WRITERS)
def test_an_unknown_option_is_exit_2_and_named(work: Work, tmp_path: Path, command: str) -> None:
    done = splatctrl(*work.arguments(command, tmp_path / "out"), "--colour")
    action = {"robot": " spheres"}.get(command, "")
    assert_refused(done, 2, f"{command}{action}: unrecognized arguments: --colour; ")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "command",
    [
        *("audit", "ingest", "info", "check", "calibrate", "reconstruct", "export", "sdf-bake", "query", "score"),
        *("render", "replay", "demo"),
    ],
)
def test_a_missing_input_is_exit_4_and_named(work: Work, tmp_path: Path, command: str) -> None:
    absent = tmp_path / "absent"
    arguments: dict[str, Sequence[object]] = {
        "query": (absent, work.folder / "points.csv"),
        "score": (absent, "--reference", work.log),
        "replay": (absent, "--scene", work.folder / "scene", "--urdf", work.folder / "robot.urdf"),
        "demo": ("--data", absent),
    }
    output = () if command not in WRITERS else ("-o", tmp_path / "out")
    assert_refused(splatctrl(command, *arguments.get(command, (absent,)), *output), 4, "absent: ", "; ")
    assert not list(tmp_path.iterdir())


FILE_WRITERS = ("calibrate", "export", "query", "report", "view", "robot")  # the others write a folder


@pytest.mark.parametrize("command", WRITERS)
@pytest.mark.parametrize("what", ["there already", "of somebody else", "below a file"])
def test_an_output_that_exists_or_cannot_be_written_is_refused(
    work: Work, tmp_path: Path, command: str, what: str
) -> None:
    """Also with --force what no command wrote is kept."""
    is_file = command in FILE_WRITERS
    not_ours = "is a folder, expected a file" if is_file else "was not written by splatctrl (no run.json)"
    there, out, force, said = {
        "there already": ("out" if is_file else "out/run.json", "out", [], ["out: already exists; give --force"]),
        "of somebody else": ("out/precious", "out", ["--force"], [not_ours, "another --out"]),
        "below a file": ("file", "file/out", [], ["cannot be written", "another --out"]),
    }[what]
    file = tmp_path / there
    file.parent.mkdir(exist_ok=True)
    file.write_text("precious")
    assert_refused(splatctrl(*work.arguments(command, tmp_path / out), "-q", *force), 2, *said)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [file] and file.read_text() == "precious"


@pytest.mark.parametrize(
    "command",
    ["simulate", "ingest", "reconstruct", "robot", "export", "sdf-bake", "query", "score", "replay"],
)
def test_what_a_command_prints_as_json_is_as_the_schema_says(work: Work, tmp_path: Path, command: str) -> None:
    """The last five take what reconstruct wrote."""
    more = ["--report-only"] if command == "replay" else []
    done = splatctrl(*work.arguments(command, tmp_path / "out"), "--json", *more)
    assert done.returncode == 0 and (tmp_path / "out").exists(), done.stderr


@pytest.mark.parametrize(
    "words", ["info {log}", "check {log}", "config", "config --schema", "completion bash", "robot info --urdf {urdf}"]
)
def test_what_is_only_printed_is_as_the_schema_says(work: Work, words: str) -> None:
    done = splatctrl(*words.format(log=work.log, urdf=work.folder / "robot.urdf").split(), "--json", "-q")
    assert done.returncode == 0, done.stderr


def test_an_interrupted_run_is_exit_130_and_leaves_only_what_is_partial(sample_data: Path, tmp_path: Path) -> None:
    # The handler is set by hand: a shell starts background jobs with SIGINT ignored, which a child inherits.
    program = """
import signal, sys
from splatctrl_cli.cli.main import main
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.exit(main(sys.argv[1:]))
"""
    out, partial = tmp_path / "scene", tmp_path / "scene.partial"
    arguments = ["reconstruct", str(sample_data / "tabletop" / "log.mcap"), "--threads", "1", "-o", str(out)]
    running = subprocess.Popen([sys.executable, "-c", program, *arguments], stderr=subprocess.PIPE, text=True)
    end = time.monotonic() + 30.0
    while not partial.is_dir() and time.monotonic() < end:
        time.sleep(0.05)
    running.send_signal(signal.SIGINT)
    stderr = running.communicate(timeout=30)[1]
    last = "splatctrl: interrupted before its first checkpoint; run the same command again"
    assert (running.returncode, stderr.splitlines()[-1]) == (130, last) and "Traceback" not in stderr
    assert [path.name for path in tmp_path.iterdir()] == [partial.name]


def test_a_failed_gate_is_exit_1_an_object_with_its_verdict_and_keeps_the_output(work: Work, tmp_path: Path) -> None:
    arguments = work.arguments("reconstruct", tmp_path / "scene")
    done = splatctrl(*arguments, "-q", "--json", "--require", "splats>1000000")
    assert done.returncode == 1 and checked(done.stdout, 1)["verdict"]["outcome"] == "failed"
    assert "splats is " in done.stderr
    assert (tmp_path / "scene" / "run.json").is_file()


def test_our_own_bug_is_an_object_too(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "splatctrl_cli.cli.config", None)  # importing it fails
    assert main(["config", "--json"]) == 70
    found = checked(capsys.readouterr().out, 70)
    assert found["error"]["message"].startswith("internal error: ") and found["error"]["remedy"] == "please report it"


def test_an_error_with_v_shows_where_it_came_from(tmp_path: Path) -> None:
    done = splatctrl("info", tmp_path / "absent", "-v")
    assert done.returncode == 4 and "Traceback" in done.stderr
    assert done.stderr.splitlines()[-1].startswith("splatctrl: ")


@pytest.mark.parametrize(
    ("closed", "words", "code", "said"),
    [
        (">&-", ["config"], 6, "splatctrl: stdout: closed, so the result was not printed"),
        (">&-", ["config", "absent", "--json"], 4, "splatctrl: absent: no such file"),
        (">/dev/full", ["config"], 6, "splatctrl: output: writing failed: No space left on device; make room"),
        (">/dev/full", ["config", "absent", "--json"], 4, "splatctrl: absent: no such file"),
        (">/dev/full", ["config", "--json"], 6, "splatctrl: output: writing failed: No space left"),
        ("2>&-", ["config", "absent"], 4, ""),
        ("<&- >&- 2>&-", ["config"], 6, ""),
    ],
)
def test_a_stream_that_is_closed_is_told_where_there_was_something_to_print(
    closed: str, words: list[str], code: int, said: str
) -> None:
    shell = ["sh", "-c", f'"$@" {closed}', "sh", sys.executable, "-m", "splatctrl_cli", *words]
    done = run_process(shell)
    assert (done.returncode, done.stdout) == (code, "")
    assert done.stderr.startswith(said) and done.stderr.count("\n") == bool(said)


@pytest.mark.parametrize(
    ("words", "reader", "first"),
    [(["info", "{log}"], "head -1", ["log.mcap"]), (["replay", "--help-all"], "true", [])],  # `true` reads nothing
)
def test_a_reader_that_stops_after_the_first_line_ends_the_program_quietly(
    work: Work, words: list[str], reader: str, first: list[str]
) -> None:
    program = [str(Path(sys.executable).with_name("splatctrl")), *(word.format(log=work.log) for word in words)]
    shell = ["bash", "-c", f'"$@" | {reader}; echo "code ${{PIPESTATUS[0]}}"', "bash", *program]
    done = run_process(shell)
    *lines, code = done.stdout.splitlines()
    assert (code, done.stderr, [Path(line.split(":")[0]).name for line in lines]) == ("code 0", "", first)


def test_an_output_is_written_though_stdout_is_closed(work: Work, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "splatctrl_cli", "ingest", str(work.log), "-o", str(tmp_path / "x.capture")]
    shell = ["sh", "-c", '"$@" >&-', "sh", *command]
    done = run_process(shell)
    assert done.returncode == 6 and "stdout: closed" in done.stderr
    assert (tmp_path / "x.capture/run.json").is_file()


def test_a_partial_that_is_an_input_is_not_replaced(work: Work, tmp_path: Path) -> None:
    given = tmp_path / "log.partial"
    given.write_bytes(work.log.read_bytes())
    assert_refused(splatctrl("ingest", given, "-o", tmp_path / "log", "--force"), 2, "would replace the input")
    assert given.read_bytes() == work.log.read_bytes()

"""What each command refuses: one line on stderr with its remedy, its exit code, and nothing is printed or written."""

import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.formats.splat.splats import write_ply
from splatctrl_cli.records import Label
from tests.cli import here
from tests.cli.replay_desk import BALL, START, splats_of, write_scene
from tests.jobs.export.test_export_run import ball
from tests.recording.log.make_log import LogRecipe, make_log
from tests.recording.log.make_states import START_NS, states_of, write_mcap
from tests.robot.shapes import BALL as SPHERE
from tests.robot.shapes import BOX, arm_of, written

ROBOT = "--urdf robot.urdf --spheres robot_spheres.yaml"
REPLAY = f"replay states.mcap --scene scene {ROBOT}"
DRIVE, ASK = f"{REPLAY} --mode closed-loop", f"{REPLAY} --mode open-loop"
BAKE = "sdf-bake splats.ply"
Refusal = tuple[str, int, str]
REFUSED: dict[str, list[Refusal]] = {
    "": [
        ("", 2, "required: COMMAND; see splatctrl --help"),
        ("scor", 2, "did you mean score?"),
    ],
    "simulate": [
        ("--duration 0.1", 2, "argument --duration: expected 0.5 to 600 s, got '0.1'"),
        (
            "--urdf bare.urdf -o new",
            4,
            "expected collision geometry, got none; give a URDF with <collision> elements",
        ),
    ],
    "ingest": [
        ("none.mcap -o notes.txt/a/new", 2, "notes.txt is no folder; give another --out"),
        ("log.mcap --depth-scale -1", 2, "--depth-scale"),
        ("log.mcap --camera cam0", 2, "--camera cam0: expected NAME=COLOR,DEPTH"),
        ("log.mcap --camera ../x=/a,/b", 2, "--camera ../x=/a,/b"),
        ("log.mcap --camera-pose cam0=1,2,3", 2, "--camera-pose cam0=1,2,3: expected NAME=X,Y,Z"),
        ("log.mcap --camera-pose cam0=0,0,0,0,0,0,0", 2, "with a unit quaternion, or NAME=identity"),
        ("log.mcap --human-topic cam0", 2, "--human-topic cam0: expected NAME=TOPIC"),
        ("log.mcap --pairing-tolerance -0.1", 2, "--pairing-tolerance"),
        *(
            (f"log.mcap {o}={t!r}", 2, f"{o} '{' '.join(t.split())}")
            for o in ("--cameras", "--holdout")
            for t in ("", ",")
        ),
    ],
    "check log.mcap": [
        ("--quick 0", 2, "--quick 0: expected 1 or more"),
        ("--spheres x.yaml", 2, "--spheres: needs the robot"),
        ("--fail-on note", 2, "invalid choice"),
        ("--urdf robot.urdf --base 0,0,0,0,0,0,3", 2, "argument --base: expected a unit quaternion"),
    ],
    "export": [
        ("-o out.ply", 2, "required: SCENE; see splatctrl export --help"),
        ("none", 4, "none: no such scene"),
        ("empty", 4, "empty: has no splats.ply"),
        ("scene --labels cat", 2, "unknown label 'cat'; known here: object, robot, human"),
        ("scene -o scene/splats.ply --force", 2, "is the input itself"),
        ("splats.ply", 2, "splats.ply: is the input itself; give another --out"),
        ("scene -o out.stl", 2, "out.stl: expected a suffix of .ply, .splat, .spz, .glb, .usda, .usdc"),
        ("scene -o out.spz --layout full", 2, "--layout full: out.spz is not a PLY"),
        ("notes.txt", 4, "notes.txt: expected a suffix of .ply, .splat, .spz"),
        ("scene -o taken.ply", 2, "taken.ply: already exists; give --force"),
        ("cut.ply -o out.ply", 4, "cut.ply: cut short: expected"),
        ("robot.ply --labels human -o out.ply", 5, "no splat to write among 3"),
    ],
    "reconstruct": [
        ("", 2, "expected a SOURCE or --dtu ROOT, and not both"),
        *(
            (f"log.mcap --device {word!r}", 2, f"--device: expected auto, cpu, cuda or cuda:N, got '{word}'")
            for word in ("gpu", "cuda:", "cuda:x", "cuda:-1", "CPU", "")
        ),
        ("log.mcap --device cuda:99", 2, "or give --device cpu"),
        ("log.mcap --spheres x.yaml", 2, "give --urdf"),
        ("log.mcap --urdf arm.urdf --spheres ball.yaml", 4, "joints not in the log: hinge; the log has: joint_a"),
        (
            "log.mcap --urdf still.urdf -o new",
            4,
            "still.urdf: expected movable joints, got none; an unexpanded xacro",
        ),
        ("log.mcap -o log.mcap --force", 2, "would replace the input"),
        ("logs/log.mcap -o logs --force", 2, "would replace the input"),
        ("none.mcap -o notes.txt/a/new", 2, "notes.txt is no folder; give another --out"),
        ("log.mcap --max-splats 0", 2, "--max-splats"),
        ("log.mcap --box 1,2,3", 2, "x0,y0,z0,x1,y1,z1"),
        ("log.mcap --box=0,0,0,1,1,-1", 2, "x0 < x1"),
        ("log.mcap --cameras cam9", 4, "cam0"),
        ("log.mcap --box=50,50,50,51,51,51 -o new", 4, "no pixel"),
        ("--dtu dtu --holdout a", 2, "'a'"),
        ("log.mcap --require pnsr>=3", 2, "did you mean psnr"),
        ("log.mcap --config none.toml", 4, "none.toml: no such file"),
        ("log.mcap --config bad.toml", 2, "bad.toml: not valid TOML"),
        ("log.mcap --config odd.toml", 2, "did you mean control?"),
        ("log.mcap --config .", 4, "cannot be read: Is a directory; check the path"),
        ("log.mcap --set scene.max_splat=9", 2, "did you mean scene.max_splats?"),
        ("log.mcap --seed=-1", 2, "argument --seed: expected a whole number, 0 to 2147483647"),
    ],
    "sdf-bake": [
        ("none", 4, "none: no such file or folder; give what reconstruct wrote"),
        ("scene --at -1", 5, "no snapshot at or before"),
        ("a --box -1,-1,0,1,1,1", 2, "expected one argument; write --box=VALUE"),
        ("a -o -x", 2, "expected one argument; write --out=VALUE"),
    ],
    BAKE: [
        ("--urdf still.urdf", 4, "still.urdf: expected movable joints, got none"),
        ("--box=1,2", 2, "--box 1,2: expected finite x0,y0,z0,x1,y1,z1"),
        ("--box=0,0,0,1,1,0", 2, "--box 0,0,0,1,1,0: expected finite x0,y0,z0,x1,y1,z1 [m] with x0 < x1"),
        ("--box=1e300,0,0,2e300,1,1", 2, "z0 < z1, within 1e6"),
        ("--require 'num_cell>1'", 2, "unknown metric; did you mean num_cells?"),
        ("--require 'seen.hard.0_2cm.rmse<1'", 2, "unknown metric; known here: num_splats"),
        ("--require num_cells=1", 2, "expected METRIC>=NUMBER (or <=, >, <); quote it for the shell"),
        ("--formats off", 2, "--formats off: expected some of: npz, vti, nrrd, vdb, curobo, moveit, ply"),
        ("--channels sdf,colour", 2, "--channels sdf,colour: expected some of: sdf, gradient, bound"),
        ("--channels sdf --formats moveit", 2, "expected one of the channels bound, hard, got sdf"),
        ("--distance tsdf", 2, "invalid choice: 'tsdf' (choose from"),
        ("--channels bound --set field.unknown=nan", 2, "bake the channel observed as well"),
        ("--channels bound --set field.unknown=obstacle", 2, "bake the channel observed as well"),
        ("--set field.unknown=nan", 5, "field.unknown = nan: expected a cell that a camera saw"),
        ("--set field.unknown=obstacle", 5, "field.unknown = obstacle: expected a cell that a camera saw"),
        ("--held-out log.mcap:cam9", 2, "--held-out: log.mcap has no camera cam9; it has: cam0"),
        ("--held-out none.mcap", 4, "none.mcap: no such file"),
        ("--reference-mesh none.ply", 4, "none.ply: no such file or folder"),
        ("--channels sdf --reference-mesh a.ply", 2, "--reference-mesh: needs the exact distance"),
        ("--previous-scene scene", 2, "belongs to --update"),
        ("--update nowhere", 4, "--update nowhere: no such folder"),
        ("--include cat", 2, "--include cat: expected some of: robot, human"),
        ("--voxel 0.00001", 2, "GiB of memory"),
        ("--voxel nan", 2, "argument --voxel: expected 1e-06 to 10 m, got 'nan'"),
        ("--voxel 0.3", 2, "field.voxel: expected at most 0.023 m, which loses up to field.max_loss = 0.04"),
        ("--voxel 0.06 --set field.max_loss=0.1", 2, "field.voxel: expected at most 0.0577 m"),
        ("--length-scale -1", 2, "argument --length-scale: expected 1e-10 to 1000 m, got '-1'"),
        ("--at inf", 2, "argument --at: expected -100000000 to 100000000 s, got 'inf'"),
        ("--at 3", 2, "is one splat set"),
        ("--truth truth.json", 2, "expected both or neither"),
    ],
    "completion": [("fish", 2, "invalid choice: 'fish' (choose from"), ("", 2, "required: SHELL")],
    "config": [
        ("none.toml", 4, "none.toml: no such file; give an existing TOML file"),
        ("bad.toml", 2, "bad.toml: not valid TOML"),
        ("odd.toml", 2, "odd.toml: unknown key contrl; did you mean control?"),
        ("misspelt.toml", 2, "misspelt.toml: unknown key scene.max_splat; did you mean scene.max_splats?"),
        ("--set scene.fill=2", 2, "scene.fill: expected 0.001 to 1, got 2"),
    ],
    "query": [
        ("scene", 2, "required: POINTS; see splatctrl query --help"),
        ("scene none.csv", 4, "none.csv: no such file; give a CSV file with the columns x,y,z"),
        (
            "scene f.csv",
            4,
            "f.csv: no column x: expected a header with x, y and z, or three numbers a line, got 'a,b'",
        ),
        ("scene far.csv", 4, "far.csv: line 3: column x: expected a finite number up to 1e+06 m, got 'nan'"),
        ("scene log.mcap", 4, "log.mcap: no UTF-8 text"),
        ("notes.txt far.csv", 4, "notes.txt: "),
        ("log.mcap far.csv", 4, "log.mcap: "),
        ("empty far.csv", 4, "empty: expected a scene folder with splats.ply and run.json"),
        ("scene far.csv --scene scene", 2, "--scene: belongs to a field, and scene is a scene"),
        ("scene far.csv --include cat", 2, "--include cat: expected some of: robot, human"),
        ("scene far.csv --set field.unknown=obstacle", 2, "only a baked field has it; bake it with sdf-bake"),
        ("robot.ply far.csv", 5, "none of 3 is labelled object, human"),
        ("scene far.csv -o taken.ply", 2, "taken.ply: already exists; give --force"),
    ],
    "score": [
        ("a --reference b --thread 3", 2, "--thread 3; did you mean --threads?"),
        ("a --refrence b", 2, "--refrence; did you mean --reference?"),
        ("a --reference b --snapshots fin", 2, "did you mean final?"),
        ("--reference b", 2, "required: SCENE; see splatctrl score --help"),
        ("empty --reference log.mcap", 4, "expected a scene folder with splats.ply and run.json"),
    ],
    "score scene --reference log.mcap": [
        ("--cameras cam9", 4, "log.mcap: no camera 'cam9'; use one of: cam0, cam1"),
        ("--require sharpness>=1", 2, "unknown metric; known here: num_views, valid_share, "),
        ("--require sharpness>=1", 2, ", chamfer, accuracy_beyond, "),
        ("--require psnr_sen>=1", 2, "unknown metric; did you mean psnr_seen?"),
        ("--require psnr_seen", 2, "--require psnr_seen: expected METRIC>=NUMBER"),
        ("--scan scan1", 2, "--scan scan1: only with --dtu"),
        ("--dtu root", 2, "not allowed with argument"),
        ("--images all", 2, "--images all: expected a folder for them; give -o"),
        ("--cloud-unit 1", 2, "--cloud-unit: only with --cloud"),
        ("--cloud a.ply --cloud-max 0", 2, "--cloud-max: expected 1e-06 to 1000 m, got '0'"),
    ],
    "replay states.mcap --scene scene": [
        ("--urdf still.urdf", 4, "still.urdf: expected movable joints, got none"),
    ],
    f"replay states.mcap {ROBOT}": [
        ("", 2, "one of the arguments --field --scene --lockstep is required"),
        ("--lockstep", 4, "expected cameras, got joint states alone"),
        ("--lockstep --scene x", 2, "not allowed with"),
        ("--lockstep --latency=-1", 2, "argument --latency: expected 0 to 100000000 s, got '-1'"),
        ("--field x --latency 0.1", 2, "one scene for all times"),
        ("--field x --evidence cam9", 2, "a baked field does not say which cameras made it; give --scene"),
        ("--scene x --allow-disagreement", 2, "expected --lockstep"),
        (
            "--lockstep --evidence cam1 --cameras cam0,cam1",
            2,
            "--evidence cam1: --cameras names it as a training camera; leave it out of --cameras",
        ),
        ("--scene nowhere --require min_clearence>=0", 2, "unknown metric; did you mean min_clearance"),
    ],
    REPLAY: [
        ("--goal 1,2,3", 2, "expected 7 numbers"),
        ("--goal 0,0,1,0,0,0,2", 2, "unit quaternion"),
        ("--goal 0,0,1,0,0,0,1", 2, "--goal: expected --mode open-loop or closed-loop, got audit"),
        ("--goal-joints a,b", 2, "expected finite numbers joined by commas"),
        ("--follow", 2, "--follow: expected --mode open-loop or closed-loop, got audit"),
        ("--base nan,0,0,0,0,0,1", 2, "finite"),
        ("--set control.perod=1", 2, "did you mean control.period"),
        ("--lock joint7", 2, "--lock joint7: expected JOINT=VALUE"),
        ("--lock nose=0", 4, "no joint 'nose' to lock"),
        ("--truth nowhere.json", 4, "nowhere.json"),
        ("--require clearence>=1", 2, "unknown metric"),
        ("--require intervention_share<=0", 2, "a figure of --mode"),
        ("--require num_detours<=0", 2, "--require num_detours<=0: a figure of --mode closed-loop"),
        ("--start-time nan", 2, "expected 0 to 100000000 s or first-map"),
        ("--start-time 60", 4, "--start-time: expected at most"),
        ("--worst-frames x", 2, "argument --worst-frames"),
        ("--max-map-age nan", 2, "argument --max-map-age: expected 0.001 to 100000000 s, got 'nan'"),
        ("--max-unknown nan", 2, "argument --max-unknown: expected 0 to 1, got 'nan'"),
        ("--twist-topic /cmd", 2, "an audit uses no controller"),
        ("--twist-frame link0", 2, "expected --twist-topic"),
        ("--evidence 1", 2, "--evidence 1: expected a camera, or a number of frame sets from 2"),
        ("--evidence cam0", 2, "was made from its depth"),
        ("--evidence cam9 --set verdict.evidence_reach=nan", 2, "expected 0.001 to 10 m"),
    ],
    ASK: [
        ("--re-anchor 1", 2, "--re-anchor: expected --mode closed-loop, got open-loop"),
        ("--twist-topic /cmd --follow", 2, "not allowed with"),
    ],
    DRIVE: [
        ("--goal 9,0,0,0,0,0,1", 4, "goal: expected within"),
        ("--goal=nan,0,0,0,0,0,1", 2, "expected finite numbers joined by commas"),
        ("--goal=1e300,0,0,0,0,0,1", 2, "expected finite numbers joined by commas, up to 1e6, got"),
        ("--goal-joints 0,0", 4, "--goal-joints: expected 7 joints"),
        ("--goal-joints=0,0,0,-2,0,2,9", 4, "goal: joint joint7: expected within ["),
        ("--start-time 60", 4, "--start-time: expected at most"),
        ("--frame nose", 4, "no frame 'nose'"),
        ("--re-anchor 0", 2, "argument --re-anchor: expected 0.001 to 100000000 s, got '0'"),
        ("--waypoints nowhere.toml", 4, "nowhere.toml: cannot be read"),
        ("--waypoints a.toml", 4, "waypoint 0: expected pose"),
        ("--waypoints b.toml", 4, "waypoint 0: expected 7 numbers"),
        ("--waypoints c.toml", 4, "waypoint 0: expected 7 joints"),
        ("--waypoints d.toml", 4, "expected at least one waypoint, got none"),
        ("--waypoints bad.toml", 4, "not valid TOML"),
        ("--waypoints f.csv", 4, "expected the columns x,y,z,qx,qy,qz,qw or joint1"),
        ("--waypoints g.csv", 4, "waypoint 0: expected numbers"),
    ],
    "robot": [
        ("", 2, "required: ACTION"),
        ("sphere", 2, "did you mean spheres?"),
        ("spheres --urdf none.urdf", 4, "none.urdf: cannot be read"),
        ("spheres --urdf arm.urdf --max-spheres 1 -q", 2, "1 spheres for 2 links"),
        ("spheres --urdf arm.urdf --max-protrusion 1e-4 -q", 2, "largest protrusion: expected at least"),
        ("spheres --urdf arm.urdf --max-spheres 9 --max-protrusion 1", 2, "not allowed with"),
        ("spheres --urdf arm.urdf --max-deficit=-1", 2, "argument --max-deficit: expected 0 to 10 m, got '-1'"),
        ("spheres --urdf arm.urdf --seed=-1", 2, "--seed: expected a whole number, 0 to"),
        ("check --urdf arm.urdf", 4, "expected collision geometry of spheres only, got 1 other shapes"),
        ("check --urdf arm.urdf --spheres none.yaml", 4, "none.yaml: cannot be read"),
        ("info --urdf arm.urdf --lock elbow=0", 4, "no joint 'elbow' to lock; movable joints there: hinge"),
        ("info --urdf arm.urdf --lock hinge", 2, "expected JOINT=VALUE"),
        ("info --urdf arm.urdf --lock hinge=0", 4, "every joint is locked"),
        ("pairs --urdf arm.urdf --postures 0", 2, "--postures: expected a whole number, 1 to"),
    ],
}
TEXTS = {
    "notes.txt": "notes",
    "still.urdf": "<robot name='r'><link name='base'/></robot>",
    "ball.yaml": "collision_spheres: {tip: [{center: [0, 0, 0], radius: 0.05}]}",
    "taken.ply": "taken",
    "bad.toml": "[scene\n",
    "misspelt.toml": "[scene]\nmax_splat = 3\n",
    "odd.toml": "[contrl]\nmargin = 0.1\n",
    "a.toml": "waypoint = 3",
    "b.toml": "[[waypoint]]\npose = [1, 2]",
    "c.toml": "[[waypoint]]\njoints = [1, 2]",
    "d.toml": "",
    "f.csv": "a,b\n1,2\n",
    "far.csv": "x,y,z\n1,2,3\nnan,2,3\n",
    "g.csv": "x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,a\n",
}


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    """A folder with something of every kind that the table names."""
    folder = tmp_path_factory.mktemp("world")
    sample_data, plain_arm = (request.getfixturevalue(name) for name in ("sample_data", "plain_arm"))
    for path in ("dtu", "tabletop/truth.json"):
        (folder / Path(path).name).symlink_to(sample_data / path)
    for path in ("robot.urdf", "robot_spheres.yaml"):
        (folder / path).symlink_to(plain_arm / "tabletop" / path)
    for name, text in TEXTS.items():
        (folder / name).write_text(text)
    for name in ("empty", "logs"):
        (folder / name).mkdir()
    make_log(folder / "log.mcap", LogRecipe(cameras=("cam0", "cam1")))
    make_log(folder / "logs" / "log.mcap", LogRecipe(num_frames=1))
    joints = tuple(f"joint{i}" for i in range(1, 8))
    write_mcap(folder / "states.mcap", states_of(np.tile(START, (11, 1)), joints))
    write_scene(folder / "scene", (START_NS, splats_of(BALL)))
    written(folder, arm_of(BOX, SPHERE), "arm.urdf")
    written(folder, arm_of(BOX, SPHERE).replace("collision>", "visual>"), "bare.urdf")
    write_ply(folder / "splats.ply", ball(), {})
    (folder / "cut.ply").write_bytes((folder / "splats.ply").read_bytes()[:-5])
    write_ply(folder / "robot.ply", replace(ball(3), labels=np.full(3, Label.ROBOT, np.uint8)), {})
    return folder


def refusals() -> Iterator[Refusal]:
    for command, rows in REFUSED.items():
        yield from ((f"{command} {words}".strip(), code, said) for words, code, said in rows)


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("words", "code", "said"), [*refusals()])
def test_what_cannot_be_done_is_one_line_with_its_code_and_leaves_nothing(
    world: Path, monkeypatch: pytest.MonkeyPatch, words: str, code: int, said: str
) -> None:
    monkeypatch.chdir(world)
    before = contents(world)
    done = here.splatctrl(*shlex.split(words))
    assert (done.returncode, done.stdout) == (code, ""), done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("splatctrl: ")]
    assert len(lines) == 1 and said in lines[0], done.stderr
    assert contents(world) == before


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        *((f"{command} {rows[0][0]}".strip(), *rows[0][1:]) for command, rows in REFUSED.items() if rows[0][0]),
        ("query scene far.csv", 4, "far.csv: line 3"),
        ("scor", 2, "did you mean score?"),
        ("query robot.ply far.csv", 5, "none of 3 is labelled"),
    ],
)
def test_with_json_a_refusal_is_an_object_too(
    world: Path, monkeypatch: pytest.MonkeyPatch, words: str, code: int, said: str
) -> None:
    monkeypatch.chdir(world)
    done = here.splatctrl(*shlex.split(words), "--json")
    error = here.checked(done.stdout, code)["error"]
    told = f"{error['message']}; {error['remedy']}" if error["remedy"] else error["message"]
    assert said in " ".join(told.split())
    assert done.stderr.splitlines()[-1] == f"splatctrl: {' '.join(told.split())}"

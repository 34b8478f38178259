"""A suite's file, its graph, and the ledger of its runs."""

import sqlite3
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from splatctrl_cli.cli.batch import OfThisProgram
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.jobs.batch.graph import COMMANDS, Node, columns_of, nodes_of, select_shard
from splatctrl_cli.jobs.batch.ledger import NAME, VERSION, Ledger, Run, write_csv
from splatctrl_cli.jobs.batch.suite import read_suite
from tests.refused import expect_refusal

RECORDINGS = '[[recordings]]\npaths = ["*.mcap"]\n'
ROBOT = 'urdf = "arm.urdf"\n'


def touch(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def nodes(folder: Path, text: str, shard: tuple[int, int] = (1, 1)) -> list[Node]:
    """The graph of a suite's text beside two logs."""
    touch(folder, "a.mcap", "b.mcap", "arm.urdf")
    (folder / "suite.toml").write_text(text)
    suite = read_suite(folder / "suite.toml", COMMANDS)
    return select_shard(nodes_of(suite, folder / "out", OfThisProgram(threads=1)), shard)


def options(node: Node) -> dict[str, str]:
    pairs = (word.partition("=") for word in node.words if word.startswith("--"))
    return {name: value for name, _, value in pairs}


def test_each_recording_goes_through_each_job_with_what_the_jobs_before_made(tmp_path: Path) -> None:
    jobs = f"[jobs.ingest]\n[jobs.scene]\ncommand = 'reconstruct'\n{ROBOT}[jobs.check]\n"
    jobs += f"[jobs.audit]\ncommand = 'replay'\n{ROBOT}"
    found = {node.name: node for node in nodes(tmp_path, RECORDINGS + jobs)}
    assert set(found) == {f"{name}/{job}" for name in "ab" for job in ("ingest", "scene", "check", "audit")}
    audit, out, check = found["a/audit"], tmp_path / "out/a", found["b/check"]
    assert (set(audit.needs), audit.inputs) == ({"a/ingest", "a/scene"}, (tmp_path / "arm.urdf",))
    assert options(audit)["--scene"] == str(out / "scene") and audit.words[-1] == str(out / "ingest.capture")
    assert (check.words[-1], check.out) == (str(tmp_path / "b.mcap"), None)
    names = list(found)
    assert all(names.index(need) < names.index(name) for name, node in found.items() for need in node.needs)


def test_a_matrix_makes_variants_that_go_on_in_what_needs_them(tmp_path: Path) -> None:
    jobs = (
        "[jobs.reconstruct]\nmatrix = { max-splats = [100, 200], 'set.scene.window' = [2, 4] }\n"
        f"[jobs.sdf-bake]\n[jobs.replay]\n{ROBOT}scene = '{{reconstruct}}'\nlog = '{{recording}}'\n"
        "matrix = { field = ['{sdf-bake}'] }\n"
    )
    found = nodes(tmp_path, RECORDINGS + jobs.replace("scene = '{reconstruct}'\n", ""), shard=(1, 2))
    of = {job: [node for node in found if node.job.name == job] for job in ("reconstruct", "sdf-bake", "replay")}
    assert [len(each) for each in of.values()] == [4, 4, 4]
    assert {(options(n)["--max-splats"], options(n)["--set"]) for n in of["reconstruct"]} == {
        (splats, f"scene.window={window}") for splats in ("100", "200") for window in (2, 4)
    }
    bake = next(
        n
        for n in of["sdf-bake"]
        if dict(n.variant) == {"reconstruct.max-splats": 100, "reconstruct.set.scene.window": 4}
    )
    assert bake.name == "a/sdf-bake+max-splats=100+scene.window=4"
    assert options(of["replay"][0])["--field"].endswith(of["replay"][0].needs[0])
    assert "--scene" not in options(of["replay"][0])


def test_a_replay_in_lockstep_needs_no_scene_and_errors_of_its_frames_vary(tmp_path: Path) -> None:
    jobs = f"[jobs.simulate]\n[jobs.replay]\nlog = '{{simulate}}/log.mcap'\nlockstep = true\n{ROBOT}"
    errors = "perturb = { pose-error = 0.01 }\nmatrix = { 'perturb.depth-noise' = [0.0, 0.004] }\n"
    found = nodes(tmp_path, RECORDINGS + jobs + errors, shard=(1, 2))
    assert [node.name for node in found] == [
        "a/simulate",
        *(f"a/replay+perturb.depth-noise={v}" for v in (0.0, 0.004)),
    ]
    assert found[2].needs == ("a/simulate",) and found[2].words[-1] == f"{found[0].out}/log.mcap"
    assert {"--perturb=pose-error=0.01", "--perturb=depth-noise=0.004"} <= set(found[2].words)


def test_nodes_and_columns_come_in_the_order_of_the_suite(tmp_path: Path) -> None:
    jobs = f"[jobs.audit]\ncommand = 'replay'\n{ROBOT}[jobs.scene]\ncommand = 'reconstruct'\n"
    found = nodes(tmp_path, RECORDINGS + jobs + "[jobs.ingest]\n[jobs.check]\n")
    assert [node.name for node in found[:4]] == ["a/ingest", "a/scene", "a/audit", "a/check"]
    few = "[[recordings]]\npaths = ['a.mcap']\nonly = ['check']\n[[recordings]]\npaths = ['b.mcap']\n"
    found = nodes(tmp_path, few + "[jobs.ingest]\n[jobs.check]\nmatrix = { quick = [10, 9] }\n")
    columns = columns_of(((node.job.name, node.name.split("/")[1]) for node in found), ["ingest", "check"])
    assert columns == ["ingest", "check+quick=10", "check+quick=9"]


def test_the_names_of_variants_say_only_what_differs(tmp_path: Path) -> None:
    touch(tmp_path / "arms", "a/panda.urdf", "b/panda.urdf", "a/wrist.yaml", "b/coarse.yaml")
    jobs = """
[jobs.scene]
command = "reconstruct"
matrix = { cameras = [["cam0"], ["cam0", "cam1"]], "set.scene.max_splats" = [100] }
[jobs.audit]
command = "replay"
matrix = { urdf = ["arms/a/panda.urdf", "arms/b/panda.urdf"], spheres = ["arms/a/wrist.yaml", "arms/b/coarse.yaml"] }
"""
    found = [n.name for n in nodes(tmp_path, "[[recordings]]\npaths = ['a.mcap']\n" + jobs) if n.job.name == "audit"]
    assert found[0] == "a/audit+cameras=cam0+scene.max_splats=100+urdf=a+spheres=a_wrist.yaml"
    assert found[-1] == "a/audit+cameras=cam0_cam1+scene.max_splats=100+urdf=b+spheres=b_coarse.yaml"
    seeds = "matrix = { seed = [1, 2] }\n"
    both = f"[jobs.scene]\ncommand = 'reconstruct'\n{seeds}[jobs.sdf-bake]\n{seeds}"
    found = [n.name for n in nodes(tmp_path, RECORDINGS + both)]
    assert "a/scene+seed=1" in found and "a/sdf-bake+scene.seed=1+sdf-bake.seed=2" in found


def test_a_recording_may_have_a_job_otherwise_or_not_at_all(tmp_path: Path) -> None:
    own = (
        "[[recordings]]\npaths = ['a.mcap']\n[recordings.jobs.check]\nfail-on = 'warning'\nexpect = 'exit 1'\n"
        "[[recordings]]\nname = 'both'\nsession = ['*.mcap']\nonly = ['check']\n"
    )
    found = {
        n.name: n for n in nodes(tmp_path, own + "[jobs.check]\ntimeout = '2 min'\nmemory = '1 GiB'\n[jobs.ingest]\n")
    }
    assert set(found) == {"a/check", "a/ingest", "both/check"}
    assert (options(found["a/check"])["--fail-on"], found["a/check"].job.expect) == ("warning", "exit 1")
    check, both = found["a/check"], found["both/check"]
    assert both.words[-2:] == (str(tmp_path / "a.mcap"), str(tmp_path / "b.mcap"))
    assert (both.job.expect, check.job.timeout, check.job.memory) == ("passed", 120.0, 2**30)


def test_recordings_of_one_file_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    touch(
        tmp_path, "a/2025/log.mcap", "b/2025/log.mcap", "b/2025/arm.bag", "c/arm.mcap", "c/wrist.mcap", "c/wrist.bag"
    )
    text = "[[recordings]]\npaths = ['**/*.mcap', '**/*.bag']\n[[recordings]]\nname = 'arm'\npaths = ['a.mcap']\n"
    found = [node.recording for node in nodes(tmp_path, text + "[jobs.check]\n".replace("'a.mcap'", "'c/arm.mcap'"))]
    assert found == ["2025-arm", "a", "a-2025-log", "arm", "b", "b-2025-log", "c-arm", "wrist.bag", "wrist.mcap"]


def test_shards_hold_every_recording_once(tmp_path: Path) -> None:
    found = [[node.name for node in nodes(tmp_path, RECORDINGS + "[jobs.check]\n", (k, 3))] for k in (1, 2, 3)]
    assert found == [["a/check"], ["b/check"], []]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[jobs.check\n", "is not TOML"),
        (RECORDINGS, "expected [[recordings]] and [jobs.NAME], got none of the second"),
        ("[jobs.check]\n", "got none of the first"),
        (RECORDINGS + "[job.check]\n", "unknown key 'job'; did you mean jobs?"),
        (RECORDINGS + "[jobs.chek]\n", "no job is called 'chek'; did you mean check?"),
        (
            RECORDINGS + "[jobs.check]\nfail_on = 'error'\n",
            "[jobs.check] of a: check has no option 'fail_on'; did you mean fail-on?",
        ),
        (RECORDINGS + "[jobs.check]\nfail-on = 'all'\n", "invalid choice: 'all'"),
        (RECORDINGS + "[jobs.check]\nquick = true\n", "expected a number of images"),
        (RECORDINGS + "[jobs.check]\nout = 'x'\n", "a batch gives out itself; leave it out"),
        (RECORDINGS + "[jobs.ingest]\nset = { scene.window = 2 }\n", "has no option 'set'"),
        (RECORDINGS + "[jobs.map]\ncommand = 'reconstruct'\nset = { scene.windw = 2 }\n", "[jobs.map] of a: --set"),
        (
            RECORDINGS + "[jobs.check]\ntimeout = '2 weeks'\n",
            "timeout: expected a number, 0 or more or with one of s,",
        ),
        (RECORDINGS + "[jobs.check]\nexpect = 'saf'\n", "expect: no verdict is called 'saf'; did you mean safe?"),
        (RECORDINGS + "[jobs.check]\nmemory = -1\n", "memory: expected a number, 0 or more"),
        (RECORDINGS + "[jobs.check]\nmatrix = { fail-on = 'error' }\n", "matrix: expected OPTION = [VALUE, ...]"),
        (RECORDINGS + "[jobs.check]\nurdf = '{arm}'\n", "{arm} is no job; known here: recording, name, check"),
        (RECORDINGS + "[jobs.replay]\nurdf = 'arm.urdf'\n", "expected a job of reconstruct before it; or give scene"),
        (
            RECORDINGS + "[jobs.one]\ncommand='reconstruct'\n[jobs.two]\ncommand='reconstruct'\n[jobs.export]\n",
            "2 jobs of reconstruct come before it; say '{one}' or '{two}'",
        ),
        (
            RECORDINGS + "[jobs.x]\ncommand='check'\nurdf='{y}'\n[jobs.y]\ncommand='check'\nurdf='{x}'\n",
            "needs x; break the circle",
        ),
        ("[[recordings]]\npaths = ['none*.mcap']\n[jobs.check]\n", "nothing matches 'none*.mcap'"),
        ("[[recordings]]\npaths = []\n[jobs.check]\n", "paths: expected a list, got []"),
        ("[[recordings]]\nname = 'x'\n[jobs.check]\n", "expected paths or session, and not both"),
        ("[[recordings]]\nname = 'x'\npaths = ['*.mcap']\n[jobs.check]\n", "name = 'x': 2 recordings match"),
        ("[[recordings]]\nname = '../x'\npaths = ['a.mcap']\n[jobs.check]\n", "'../x' is no name of a folder"),
        (RECORDINGS * 2 + "[jobs.check]\n", "two recordings are called 'a'"),
        (RECORDINGS + "jobs.chek.quick = 3\n[jobs.check]\n", "[recordings.jobs.chek]: no job has this name; did you"),
        (
            RECORDINGS + "only = ['info']\njobs.check.quick = 3\n[jobs.check]\n[jobs.info]\n",
            "[recordings.jobs.check]: no job has this name",
        ),
        (RECORDINGS + "only = ['chek']\n[jobs.check]\n", "only: no job is called 'chek'; did you mean check?"),
        (RECORDINGS + "only = []\n[jobs.check]\n", "only: expected a list, got []"),
        ("recordings = ['*.mcap']\n[jobs.check]\n", "[[recordings]]: expected a table, got '*.mcap'; give it paths"),
        (
            RECORDINGS + "[jobs.check]\nmatrix = { fail-on = ['error', 'error'] }\n",
            "two outputs are called a/check+fail-on=error",
        ),
    ],
)
def test_what_makes_no_graph_is_refused_in_a_line(tmp_path: Path, text: str, said: str) -> None:
    expect_refusal(said, nodes, tmp_path, text, error=(UsageError, InputError))


def run(node: str, **more: object) -> Run:
    recording, job = node.split("/")
    given = {"command": job, "key": "k", "state": "done", "expect": "passed", **more}
    return Run(node=node, recording=recording, job=job, **given)  # type: ignore[arg-type]


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    ledger = Ledger(tmp_path)
    ledger.record(run("a/audit", seconds=9.0, state="failed"))
    ledger.record(run("a/audit", seconds=2.0, exit_code=0))
    ledger.record(run("b/audit", seconds=30.0, state="error"))
    return ledger


@pytest.mark.parametrize(
    ("conditions", "nodes"),
    [
        ((), ["a/audit", "b/audit"]),
        (("state=error",), ["b/audit"]),
        (("job=audit", "seconds < 10"), ["a/audit"]),
        (("seconds>=2", "recording!=a"), ["b/audit"]),
        (("node=a/*", "state==done"), ["a/audit"]),
        (("node!=*a*",), []),
        (("node!=a*",), ["b/audit"]),
    ],
)
def test_runs_are_asked_for_by_column(ledger: Ledger, conditions: tuple[str, ...], nodes: list[str]) -> None:
    with ledger:
        assert [each.node for each in ledger.runs(conditions)] == nodes


@pytest.mark.parametrize(
    "condition", ["state", "nothing=1", "seconds>soon", "1=1; DROP TABLE runs", "state=x' OR '1'='1"]
)
def test_a_condition_that_is_none_is_refused_or_finds_nothing(ledger: Ledger, condition: str) -> None:
    with ledger:
        try:
            assert list(ledger.runs((condition,))) == []
        except UsageError as error:
            assert "--where" in str(error)
        assert len(list(ledger.runs(only_last=False))) == 3


def test_a_table_has_every_column_and_run(ledger: Ledger, tmp_path: Path) -> None:
    with ledger:
        write_csv(tmp_path / "runs.csv", ledger.runs())
    header, first, _ = (tmp_path / "runs.csv").read_text().splitlines()
    assert header.startswith("node,recording,job,command,key,state") and first.startswith("a/audit,a,audit")


def test_a_node_is_run_by_one_process_alone(tmp_path: Path) -> None:
    with Ledger(tmp_path) as one, Ledger(tmp_path) as other:
        assert one.claim("a/audit")
        assert not other.claim("a/audit")
        one.record(run("a/audit"))
        assert other.claim("a/audit")
    with Ledger(tmp_path) as third:
        assert third.claim("a/audit"), "who held it is gone"


def test_a_digest_follows_the_content(tmp_path: Path) -> None:
    folder, file = tmp_path / "images", tmp_path / "images/a.png"
    folder.mkdir()
    file.write_text("one")
    with Ledger(tmp_path / "ledger") as ledger:
        before = ledger.digest(folder), ledger.digest(file)
        assert before == (ledger.digest(folder), ledger.digest(file))
        file.write_text("two")
        after = ledger.digest(folder), ledger.digest(file)
        assert before[0] != after[0] and before[1] != after[1]
        (folder / "b.png").write_text("")
        assert ledger.digest(folder) != after[0]


def test_what_is_no_ledger_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / NAME).write_bytes(b"not a database, but long enough to look at" * 40)
    expect_refusal("is no ledger", Ledger, tmp_path)
    newer = tmp_path / "newer"
    with Ledger(newer):
        pass
    with sqlite3.connect(newer / NAME) as base:
        base.execute(f"PRAGMA user_version = {VERSION + 1}")
    base.close()
    expect_refusal(f"is of version {VERSION + 1}, expected {VERSION}; use a newer", Ledger, newer)


class Refusing(sqlite3.Connection):
    """Refuses to change the journal twice, as where another process changes it at that moment."""

    refusals = 2

    def execute(self, sql: str, *given: Any) -> sqlite3.Cursor:
        if sql.endswith("= WAL") and self.refusals:
            self.refusals -= 1
            raise sqlite3.OperationalError("database is locked")
        return super().execute(sql, *given)


def test_ledgers_that_open_at_one_moment_wait_for_each_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sqlite3.connect", partial(sqlite3.connect, factory=Refusing))
    with Ledger(tmp_path) as ledger:
        assert ledger.claim("a")
    with sqlite3.connect(tmp_path / NAME) as base:
        assert base.execute("PRAGMA journal_mode").fetchone()[0] == "wal"
    monkeypatch.setattr("splatctrl_cli.jobs.batch.ledger.BUSY_S", 0.0)
    expect_refusal("database is locked", Ledger, tmp_path / "busy")

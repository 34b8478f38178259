"""What a batch does with its nodes, here or on a Dask cluster: runs each once, within limits, and goes on."""

import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from splatctrl_cli.files.output import partial_path
from splatctrl_cli.jobs.batch.batch import verdict_of_runs
from splatctrl_cli.jobs.batch.graph import Node
from splatctrl_cli.jobs.batch.ledger import Ledger, Run
from splatctrl_cli.jobs.batch.run import DONE, ERROR, FAILED, SKIPPED, Clock, Scheduler, local_executor
from splatctrl_cli.jobs.batch.task import End, Task, run_task, stop_runners
from splatctrl_cli.jobs.running.progress import SILENT
from splatctrl_cli.kernels.cuda import memory as driver
from tests.jobs.bake.baked import Said
from tests.jobs.batch.desk import ENTRY, batch_of, node, states


def count(told: Path) -> int:
    return len(told.read_text().splitlines()) if told.exists() else 0


def test_what_is_done_is_kept_and_what_changed_runs_again_with_what_needs_it(tmp_path: Path) -> None:
    given = tmp_path / "given"
    given.write_text("one")
    first = node(tmp_path, "a/first", "tell", str(tmp_path / "t1"), "say", str(given), inputs=(given,))
    second = node(tmp_path, "a/second", "tell", str(tmp_path / "t2"), needs=["a/first"])
    other = node(tmp_path, "b/first", "tell", str(tmp_path / "t3"))
    nodes = [first, second, other]

    def counts(nodes: Sequence[Node], **more: bool) -> list[int]:
        """Run a batch of these nodes; return how often each of the three has run."""
        assert {*states(batch_of(tmp_path, nodes, **more)).values()} == {DONE}
        return [count(tmp_path / f"t{k}") for k in (1, 2, 3)]

    assert [counts(nodes), counts(nodes)] == [[1, 1, 1]] * 2
    given.write_text("two")
    assert counts(nodes) == [2, 2, 1], "the input of the first changed"
    assert counts([first, replace(second, words=(*second.words, "say", "more")), other]) == [2, 3, 1], "words changed"
    (tmp_path / "b/first/run.json").write_text("changed by hand")
    assert counts(nodes[2:]) == [2, 3, 2]
    assert counts(nodes[2:], again=True) == [2, 3, 3]


def test_one_node_that_fails_stops_only_what_needs_its_output(tmp_path: Path) -> None:
    nodes = [
        node(tmp_path, "a/broken", "say", "splatctrl: x: cannot be read", "exit", "4"),
        node(tmp_path, "a/after", needs=["a/broken"]),
        node(tmp_path, "b/judged", "verdict", "failed", "contact", "exit", "1"),
        node(tmp_path, "b/after", needs=["b/judged"]),
    ]
    runs = batch_of(tmp_path, nodes)
    assert states(runs) == {"a/broken": ERROR, "a/after": SKIPPED, "b/judged": FAILED, "b/after": DONE}
    assert (runs["a/broken"].label, runs["a/broken"].sentence) == ("exit 4", "x: cannot be read")
    assert runs["a/after"].cause == "needs a/broken, which left nothing"
    verdict = verdict_of_runs(list(runs.values()))
    assert (verdict.exit_code, verdict.decisive[0].criterion) == (1, "a/broken")
    assert "CONTACT, expected passed" in str(verdict.decisive[1])


def test_an_output_of_other_words_is_not_taken_for_this_ones(tmp_path: Path) -> None:
    first, after = node(tmp_path, "a/first"), node(tmp_path, "a/after", needs=["a/first"])
    batch_of(tmp_path, [first, after])
    runs = batch_of(tmp_path, [replace(first, words=("exit", "4")), after])
    assert states(runs) == {"a/first": ERROR, "a/after": SKIPPED}
    assert not (tmp_path / "a/first").exists()


EXPECTED = [
    ("contact", ("verdict", "failed", "contact", "exit", "1"), DONE),
    ("failed", ("verdict", "failed", "contact", "exit", "1"), DONE),
    ("exit 4", ("exit", "4"), DONE),
    ("passed", (), DONE),
    ("passed", ("exit", "3"), DONE),
    ("passed", ("verdict", "not evaluable", "not evaluable", "exit", "5"), FAILED),
    ("contact", ("verdict", "passed", "safe"), FAILED),
    ("exit 4", (), FAILED),
]


def test_an_expected_outcome_is_the_good_one(tmp_path: Path) -> None:
    nodes = [node(tmp_path, f"r{k}/job", *words, expect=expect) for k, (expect, words, _) in enumerate(EXPECTED)]
    found = states(batch_of(tmp_path, nodes, workers=1))
    assert found == {f"r{k}/job": state for k, (_, _, state) in enumerate(EXPECTED)}


def test_an_expected_error_stands_too(tmp_path: Path) -> None:
    job = node(tmp_path, "a/job", "tell", str(tmp_path / "told"), "exit", "4", expect="exit 4")
    nodes = [replace(job, words=job.words[:4])]  # writes nothing
    assert states(batch_of(tmp_path, nodes)) == states(batch_of(tmp_path, nodes)) == {"a/job": DONE}
    assert count(tmp_path / "told") == 1


@pytest.mark.parametrize(
    ("words", "limits", "cause"),
    [
        (("say", "the last line", "sleep", "30"), {"timeout": 0.3}, "timed out after 0.3 s"),
        (("allocate", "400"), {"memory": 300 * 10**6}, "took more memory than 300 MB"),
        (("die", "SIGSEGV"), {}, "killed by SIGSEGV"),
    ],
)
def test_a_killed_node_is_a_result_with_its_cause(
    tmp_path: Path, words: tuple[str, ...], limits: dict[str, float], cause: str
) -> None:
    start = time.monotonic()
    runs = batch_of(tmp_path, [node(tmp_path, "a/job", *words, **limits), node(tmp_path, "b/job")])
    assert time.monotonic() - start < 25
    assert (states(runs), runs["a/job"].cause) == ({"a/job": ERROR, "b/job": DONE}, cause)
    assert runs["a/job"].peak_mb > (290 if limits.get("memory") else 5)


def test_what_may_pass_is_tried_again_and_nothing_else(tmp_path: Path) -> None:
    nodes = [
        node(tmp_path, "a/job", "once", str(tmp_path / "died")),
        node(tmp_path, "b/job", "once", str(tmp_path / "died too"), retries=0),
        node(tmp_path, "c/job", "tell", str(tmp_path / "told"), "exit", "4"),
    ]
    assert states(batch_of(tmp_path, nodes)) == {"a/job": DONE, "b/job": ERROR, "c/job": ERROR}
    assert count(tmp_path / "told") == 1


PROGRAM = """
import sys
from pathlib import Path
from tests.jobs.batch.desk import batch_of, node
folder = Path(sys.argv[1])
words = ("tell", "{0}/begun{1}", "sleep", "0.1", "tell", "{0}/told{1}")
nodes = [node(folder, f"r{k}/job", *(word.format(folder, k) for word in words)) for k in range(12)]
runs = batch_of(folder, nodes)
print([run.state for run in runs.values()].count("done"))
"""


def started(folder: Path) -> "subprocess.Popen[str]":
    return subprocess.Popen([sys.executable, "-c", PROGRAM, str(folder)], stdout=subprocess.PIPE, text=True)


def test_two_batches_on_one_folder_run_each_node_once(tmp_path: Path) -> None:
    both = [started(tmp_path) for _ in range(2)]
    assert [program.communicate(timeout=60)[0].strip() for program in both] == ["12", "12"]
    assert [count(tmp_path / f"told{k}") for k in range(12)] == [1] * 12


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_batch_that_is_killed_again_and_again_loses_nothing_and_does_nothing_twice(
    tmp_path: Path, number: signal.Signals
) -> None:
    waits = (0.6, 0.9, 0.75, 1.0)
    for wait in waits:
        program = started(tmp_path)
        time.sleep(wait)
        program.send_signal(number)
        program.communicate(timeout=30)
    assert started(tmp_path).communicate(timeout=60)[0].strip() == "12"
    told = [count(tmp_path / f"told{k}") for k in range(12)]
    assert min(told) == 1 and sum(told) <= 12 + 2 * len(waits), "only what a kill broke off ran again"
    with Ledger(tmp_path) as ledger:
        assert [run.state for run in ledger.runs(only_last=False)].count(DONE) == 12


def test_what_runs_ends_with_the_batch_that_started_it(tmp_path: Path) -> None:
    program = subprocess.Popen([sys.executable, "-c", PROGRAM.replace('"0.1"', '"60"'), str(tmp_path)])
    begun = tmp_path / "begun0"
    until(begun.exists)
    program.kill()
    program.wait()
    pid = int(begun.read_text())
    until(lambda: not alive(pid))


def until(holds: Callable[[], bool]) -> None:
    for _ in range(600):
        if holds():
            return
        time.sleep(0.05)
    raise AssertionError


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except OSError:
        return False


def test_a_node_goes_on_only_where_something_was_begun(tmp_path: Path) -> None:
    words, out = tmp_path / "words", tmp_path / "a/job"
    nodes = [node(tmp_path, "a/job", "words", str(words), "--resume", "exit", "1")]
    batch_of(tmp_path, nodes)
    assert "--resume" not in words.read_text()
    partial_path(out).mkdir()
    batch_of(tmp_path, nodes, again=True)
    assert "--resume" in words.read_text()


def test_a_runner_that_is_killed_is_replaced(tmp_path: Path) -> None:
    runs = batch_of(tmp_path, [node(tmp_path, "a/job", "kill-parent", retries=0), node(tmp_path, "b/job")], workers=1)
    assert states(runs) == {"a/job": ERROR, "b/job": DONE}
    assert runs["a/job"].cause == "its runner was killed twice"


@pytest.mark.parametrize(("cards", "given", "seen"), [(2, None, {"0", "1"}), (1, None, {"any"}), (2, "5", {"5"})])
def test_each_worker_has_a_card_of_its_own_where_there_are_several(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cards: int, given: str | None, seen: set[str]
) -> None:
    monkeypatch.setattr(driver, "CARDS", tmp_path / "gpus")
    for k in range(cards):
        (tmp_path / f"gpus/0000:0{k}:00.0").mkdir(parents=True)
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if given is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", given)
    stop_runners()
    files = {name: tmp_path / f"{name}.txt" for name in "abc"}
    nodes = [node(tmp_path, f"{name}/job", "card", str(files[name]), "cuda", "sleep", "0.5") for name in "ab"]
    nodes.append(node(tmp_path, "c/job", "card", str(files["c"]), "cuda:1", needs=["a/job"]))
    batch_of(tmp_path, nodes)
    assert {files[name].read_text() for name in "ab"} == seen
    assert files["c"].read_text() == (given or "any")  # a card that is named is one of all


def test_a_runner_that_was_stopped_is_not_replaced(tmp_path: Path) -> None:
    begun, ends = tmp_path / "begun", list[End]()
    places = {name: str(tmp_path / name) for name in ("out", "result", "log", "end")}
    task = Task(entry=ENTRY, words=("tell", str(begun), "sleep", "60"), key="k", **places)
    thread = threading.Thread(target=lambda: ends.append(run_task(task)))
    thread.start()
    until(begun.exists)
    stop_runners()
    thread.join(30)
    assert [end.cause for end in ends] == ["ended with its batch"]
    assert count(begun) == 1


def test_the_time_left_is_that_of_the_jobs_that_are_left(tmp_path: Path) -> None:
    names = ("a/check", "b/check", "b/fit", "c/check", "c/bake")
    clock = Clock([node(tmp_path, name) for name in names], {"bake": 100.0}, slots=1)

    def ended(name: str, seconds: float, *, state: str = DONE, before: float = 0.0) -> str:
        recording, job = name.split("/")
        at = clock.started + 1 - before
        run = Run(node=name, recording=recording, job=job, command=job, key="", state=state, expect="passed")
        return clock.passed(replace(run, seconds=seconds, started=at)) + clock.left()

    assert ended("a/check", 30.0, before=60) == "[1/5], over 2 min left", "one that stands says nothing of checks"
    assert ended("b/check", 2.0) == "[2/5], over 2 min left", "no fit was ever timed"
    assert ended("b/fit", 50.0) == "[3/5], about 2 min left"
    assert ended("c/bake", 0.0, state=SKIPPED) == "[4/5], about 2 s left"
    assert ended("c/check", 4.0) == "[5/5]"


def test_a_long_wait_says_what_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatctrl_cli.jobs.batch.run.STILL_S", 0.2)
    said = Said()
    with Ledger(tmp_path) as ledger, local_executor(2) as executor:
        scheduler = Scheduler(
            ledger=ledger, entry=ENTRY, executor=executor, slots=2, progress=said, hint=lambda: ": it is late"
        )
        scheduler.run([node(tmp_path, name, "sleep", "1.0") for name in ("a/job", "b/job")])
    assert said.lines[0] == "batch: still waits for a/job and 1 more: it is late"
    assert not any("still" in line for line in said.lines[-1:])


distributed = pytest.importorskip("distributed")
NUM = 30


def test_every_node_is_done_once_although_workers_die(tmp_path: Path) -> None:
    said = [("sleep", "0.05", "tell", str(tmp_path / f"told{k}")) for k in range(NUM)]
    nodes = [node(tmp_path / "out", f"r{k}/job", *words, retries=5) for k, words in enumerate(said)]
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", local_directory=str(tmp_path)
    )
    with cluster, distributed.Client(cluster) as client, Ledger(tmp_path / "out") as ledger:
        over, killed = threading.Event(), list[int]()
        killer = threading.Thread(target=kill_workers, args=(cluster, over, killed))
        killer.start()
        try:
            executor = client.get_executor(pure=False, retries=5)
            scheduler = Scheduler(ledger=ledger, entry=ENTRY, executor=executor, slots=4, progress=SILENT)
            runs = scheduler.run(nodes)
        finally:
            over.set()
            killer.join()
        assert [run.state for run in runs.values()] == [DONE] * NUM
        assert [run.state for run in ledger.runs(only_last=False)].count(DONE) == NUM
    before = [len((tmp_path / f"told{k}").read_text().splitlines()) for k in range(NUM)]
    assert sum(before) <= NUM + 2 * len(killed), "only what a kill broke off ran again"
    assert killed
    again = batch_of(tmp_path / "out", nodes)
    assert [run.key for run in again.values()] == [run.key for run in runs.values()], "the same nodes here"
    assert [len((tmp_path / f"told{k}").read_text().splitlines()) for k in range(NUM)] == before


def kill_workers(cluster: "distributed.LocalCluster", over: threading.Event, killed: list[int]) -> None:
    """One of them at a time, while all run: Dask may wait for ever for a worker that dies as it starts."""
    chosen = random.Random(0)
    while not over.wait(0.5):
        nannies = [*cluster.workers.values()]
        if all(nanny.process and nanny.process.status == distributed.Status.running for nanny in nannies):
            killed.append(chosen.choice(nannies).pid)
            os.kill(killed[-1], signal.SIGKILL)

"""A graph on a Dask cluster of this machine whose workers are killed."""

import os
import random
import signal
import threading
from pathlib import Path

import pytest

from splatctrl_cli.jobs.batch.ledger import Ledger
from splatctrl_cli.jobs.batch.run import DONE, Scheduler
from splatctrl_cli.jobs.running.progress import SILENT
from tests.jobs.batch.desk import ENTRY, batch_of, node

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

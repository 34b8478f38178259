"""Nodes and batches of tests."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from splatctrl_cli.jobs.batch.graph import Node
from splatctrl_cli.jobs.batch.ledger import Ledger, Run
from splatctrl_cli.jobs.batch.run import Scheduler, local_executor
from splatctrl_cli.jobs.batch.suite import Job
from splatctrl_cli.jobs.running.progress import SILENT

ENTRY = "tests.jobs.batch.entry:main"


def node(folder: Path, name: str, *words: str, needs: Sequence[str] = (), **more: Any) -> Node:
    """A node that writes its output; its words come before that, and its limits by name."""
    out = folder / name
    of_job = {key: more.pop(key) for key in ("expect", "timeout", "memory", "retries") if key in more}
    said = (*words, "write", str(out), "text")
    recording, job = name.split("/")
    return Node(
        name=name,
        recording=recording,
        job=Job(name=job, command=job, **of_job),
        words=said,
        needs=tuple(needs),
        out=out,
        **more,
    )


def batch_of(folder: Path, nodes: Sequence[Node], *, workers: int = 2, again: bool = False) -> dict[str, Run]:
    """Run nodes, and their runs by name."""
    with Ledger(folder) as ledger, local_executor(workers) as executor:
        scheduler = Scheduler(
            ledger=ledger, entry=ENTRY, executor=executor, slots=workers, progress=SILENT, again=again
        )
        return scheduler.run(nodes)


def states(runs: dict[str, Run]) -> dict[str, str]:
    return {name: run.state for name, run in runs.items()}

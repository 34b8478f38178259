"""The ledger: what ran, asked by column, and files that are none."""

import sqlite3
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.jobs.batch.ledger import NAME, VERSION, Ledger, Run, write_csv


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
    with pytest.raises(InputError, match="is no ledger"):
        Ledger(tmp_path)
    newer = tmp_path / "newer"
    with Ledger(newer):
        pass
    with sqlite3.connect(newer / NAME) as base:
        base.execute(f"PRAGMA user_version = {VERSION + 1}")
    base.close()
    with pytest.raises(InputError, match=f"is of version {VERSION + 1}, expected {VERSION}; use a newer"):
        Ledger(newer)


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
    with pytest.raises(InputError, match="database is locked"):
        Ledger(tmp_path / "busy")

"""Outputs appear whole or not at all."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from splatctrl_cli.errors import InputError, UsageError, WriteError
from splatctrl_cli.files import output
from splatctrl_cli.files.output import check_can_be_written, output_path, partial_path, write_durably
from tests.refused import expect_refusal

FULL = OSError(28, "No space left on device", "a")


def not_begun(path: Path, words: str, *, force: bool, is_folder: bool) -> None:
    """The output is not begun, and what is there stays as it is."""
    with pytest.raises(UsageError, match=words), output_path(path, force=force, is_folder=is_folder):
        pytest.fail("must not get here")


@pytest.mark.parametrize(
    ("there", "name", "is_folder", "force", "words"),
    [
        ("out", "out", False, False, "--force"),
        ("out/scan1/run.json", "out", True, False, r"not written by splatctrl \(no run.json\); give another --out"),
        ("out/scan1/run.json", "out", True, True, r"not written by splatctrl \(no run.json\); give another --out"),
        ("out", "out", True, True, "out: is a file, expected a folder to write; give another --out"),
        ("out/run.json", "out", False, True, "out: is a folder, expected a file to write; give another --out"),
        ("file", "file/out", True, False, "cannot be written"),
    ],
)
def test_what_must_not_be_replaced_is_refused_untouched(
    tmp_path: Path, there: str, name: str, is_folder: bool, force: bool, words: str
) -> None:
    precious = tmp_path / there
    precious.parent.mkdir(parents=True, exist_ok=True)
    precious.write_text("mine")
    not_begun(tmp_path / name, words, force=force, is_folder=is_folder)
    assert [p for p in tmp_path.rglob("*") if p.is_file()] == [precious] and precious.read_text() == "mine"


@pytest.mark.parametrize("name", ["run.json", "capture.json", None])
def test_force_replaces_a_folder_of_a_command_or_an_empty_one_whole(tmp_path: Path, name: str | None) -> None:
    for folder in ("out", "out.old"):
        (tmp_path / folder).mkdir()
    if name:
        (tmp_path / "out" / name).write_text("{}")
    with output_path(tmp_path / "out", force=True, is_folder=True) as partial:
        (partial / "new").write_text("y")
        assert names(tmp_path / "out") == ([name] if name else [])
    assert (names(tmp_path / "out"), names(tmp_path)) == (["new"], ["out", "out.old"])


@pytest.mark.parametrize("force", [False, True])
@pytest.mark.parametrize("name", ["", ".", "..", "/", "sub/.."])
def test_an_output_without_a_name_of_its_own_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, force: bool
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    not_begun(Path(name), "has no name of its own", force=force, is_folder=True)
    assert [p.name for p in tmp_path.rglob("*")] == ["here"]


def fails_as(error: BaseException) -> Callable[[Path], None]:
    def work(partial: Path) -> None:
        (partial / "a").write_text("1")
        raise error

    return work


@pytest.mark.parametrize(
    ("work", "error", "words"),
    [
        (fails_as(InputError("bad")), InputError, "bad"),
        (fails_as(ZeroDivisionError("a fault of our own")), ZeroDivisionError, "fault"),
        (fails_as(FULL), WriteError, "No space left"),
        (lambda partial: partial.write_text("a folder"), WriteError, r"Is a directory.*another --out"),
        (lambda partial: (partial.parent / "input").read_text(), FileNotFoundError, "input"),
    ],
    ids=["refused input", "a fault of our own", "a full disk", "an output that cannot be written", "no input"],
)
def test_a_failure_leaves_nothing(
    tmp_path: Path, work: Callable[[Path], object], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words), output_path(tmp_path / "out", force=False, is_folder=True) as partial:
        work(partial)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("resume", "error", "is_kept"),
    [
        (False, FULL, True),
        (False, KeyboardInterrupt(), True),
        (False, InputError("bad"), False),
        (False, ZeroDivisionError(), False),
        (True, FULL, True),
        (True, InputError("another log"), True),
        (True, ZeroDivisionError(), True),
    ],
)
def test_a_failure_leaves_what_a_run_can_go_on_from(
    tmp_path: Path, resume: bool, error: BaseException, is_kept: bool
) -> None:
    out, partial = tmp_path / "out", tmp_path / "out.partial"
    checkpoint = "" if isinstance(error, KeyboardInterrupt) else "state"
    if resume:
        partial.mkdir()
        (partial / "state").write_text("1")
    with (
        pytest.raises(WriteError if error is FULL else type(error)),
        output_path(out, force=False, is_folder=True, checkpoint=checkpoint, resume=resume) as folder,
    ):
        assert (folder / "state").exists() == resume
        (folder / "state").write_text("1")
        raise error
    assert names(tmp_path) == ["out.partial"] * is_kept


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "state"

    def half(p: Path) -> None:
        p.write_text("ne")
        raise OSError(28, "No space left on device")

    for text in ("old", "new"):
        write_durably(path, lambda p, text=text: p.write_text(text))
        with pytest.raises(OSError, match="No space"):
            write_durably(path, half)
        assert (path.read_text(), names(tmp_path)) == (text, ["state"])


HOLDER = """
import sys
from pathlib import Path
from splatctrl_cli.files.output import output_path
with output_path(Path(sys.argv[1]), force=False, is_folder=sys.argv[2] == "folder", checkpoint="state") as partial:
    if partial.is_dir():
        (partial / "state").write_text("half")
    print("writing", flush=True)
    sys.stdin.readline()
"""


@contextmanager
def another_writer(out: Path, kind: str) -> Iterator["subprocess.Popen[str]"]:
    """A process that is in the middle of writing an output until a line is sent to it."""
    command = [sys.executable, "-c", HOLDER, str(out), kind]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "writing\n"
        try:
            yield process
        finally:
            process.kill()


@pytest.mark.parametrize("kind", ["folder", "file"])
@pytest.mark.parametrize("resume", [False, True])
def test_the_second_of_two_writers_is_refused_and_the_first_ends_well(
    tmp_path: Path, kind: str, resume: bool
) -> None:
    out = tmp_path / "out"
    with another_writer(out, kind) as first:
        with (
            pytest.raises(UsageError, match=rf"out.partial: another run \(process {first.pid}\) writes it; wait"),
            output_path(out, force=True, is_folder=kind == "folder", checkpoint="state", resume=resume),
        ):
            pytest.fail("must not get here")
        first.communicate("\n")
        assert first.returncode == 0
    assert names(tmp_path) == ["out"]
    assert kind == "file" or (out / "state").read_text() == "half"


@pytest.mark.parametrize(("kind", "resume"), [("folder", False), ("file", False), ("folder", True)])
def test_a_killed_writer_leaves_no_lock_and_can_be_gone_on_from(tmp_path: Path, kind: str, resume: bool) -> None:
    out, checkpoint = tmp_path / "out", "state" if resume else ""
    with another_writer(out, kind) as first:
        first.send_signal(signal.SIGKILL)
        first.wait()
    assert names(tmp_path) == ["out.partial"]
    with output_path(out, force=False, is_folder=kind == "folder", checkpoint=checkpoint, resume=resume) as partial:
        assert (partial / "state").exists() == resume
    assert names(tmp_path) == ["out"]
    assert not resume or (out / "state").read_text() == "half"


def test_an_output_that_appeared_meanwhile_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"

    held = output.lock_output

    @contextmanager
    def held_late(partial: Path, *, is_folder: bool) -> Iterator[None]:
        out.mkdir()  # the other run ended between the look at the output and the lock
        with held(partial, is_folder=is_folder):
            yield

    monkeypatch.setattr(output, "lock_output", held_late)
    with pytest.raises(UsageError, match="already exists"), output_path(out, force=False, is_folder=True):
        pytest.fail("must not get here")
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize("is_folder", [True, False])
def test_a_link_stays_and_what_it_leads_to_is_replaced(tmp_path: Path, is_folder: bool) -> None:
    (tmp_path / "disk").mkdir()
    target, link = tmp_path / "disk" / "real", tmp_path / "link"
    if is_folder:
        target.mkdir()
        (target / "run.json").write_text("{}")
    else:
        target.write_text("old")
    link.symlink_to(target)
    with output_path(link, force=True, is_folder=is_folder) as partial:
        assert partial == tmp_path / "disk" / "real.partial" == partial_path(link)
        (partial / "new" if is_folder else partial).write_text("new")
    assert link.is_symlink() and link.readlink() == target
    assert (target / "new" if is_folder else target).read_text() == "new"
    assert sorted(path.name for path in tmp_path.rglob("re*")) == ["real"]


def test_a_link_to_itself_and_a_place_of_a_disk_are_refused(tmp_path: Path) -> None:
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    not_begun(tmp_path / "loop", "is a link to itself", force=True, is_folder=True)
    not_begun(Path("/proc"), r"/proc: .*", force=True, is_folder=True)


def test_whether_an_output_can_be_written_is_known_without_trying(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("x")
    check_can_be_written(tmp_path / "a" / "b" / "c")
    expect_refusal("file is no folder", check_can_be_written, tmp_path / "file" / "a" / "b", error=UsageError)
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    expect_refusal("is read-only", check_can_be_written, tmp_path / "a" / "b" / "c", error=UsageError)
    assert names(tmp_path) == ["file"]


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("link", [False, True])
def test_a_folder_appears_when_it_is_done_within_another_output_or_behind_a_link(tmp_path: Path, link: bool) -> None:
    (tmp_path / "out.partial.old").mkdir()  # which a killed replacement left
    (tmp_path / "out.partial").mkdir()
    (tmp_path / "out.partial" / "rest").write_text("1")  # without a checkpoint: begun again
    if link:
        (tmp_path / "out").symlink_to(tmp_path / "disk" / "real")
    with output_path(tmp_path / "out", force=False, is_folder=True, checkpoint="state", resume=not link) as partial:
        assert not list(partial.iterdir())
        (partial / "a").write_text("1")
        with output_path(partial / "in", force=False, is_folder=True) as inner:
            (inner / "b").write_text("2")
        assert not (tmp_path / "out").exists()
    assert (tmp_path / "out" / "a").read_text() + (tmp_path / "out" / "in" / "b").read_text() == "12"
    assert (tmp_path / "out").is_symlink() == link and (link or names(tmp_path) == ["out"])

"""Judge the tool by recordings with exact truth: ``python -m tools.mujoco campaign --runs 100 --seed 0``.

Missing recordings are made, ``splatctrl batch`` runs on all, and a table compares the answers with the truth. The
same command line continues after an interruption.
"""

import argparse
import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

from tools.mujoco.judge import SCENE, Clearances, Node, Recording, judge_replay, read_recording
from tools.mujoco.report import has_grave_error, report, write_worst
from tools.mujoco.table import AUDIT, DRIVEN, RECORD, Row, merge_rows, read_rows, write_rows

HERE = Path(__file__).parent
JUDGES = ("__main__.py", "campaign.py", "judge.py", "report.py", "table.py")  # decide nothing in a recording
STAMP, RECORDINGS, SPHERES, BATCH = "recorder.sha256", "recordings", "spheres", "batch"
TIMEOUT = "30 min"  # of a command

Record = Callable[[int, int, Path], None]
RunBatch = Callable[[Path, int], Mapping[str, Node]]
FitSpheres = Callable[[Path, Path], str]


@dataclass(frozen=True, kw_only=True)
class Request:
    """The recordings of a campaign, its folder, and how many processes work at once."""

    seed: int
    indices: Sequence[int]
    out: Path
    jobs: int


@dataclass(frozen=True, kw_only=True)
class Machinery:
    """The recorder, the truth of driven motions, and the tool under test.

    fit_spheres: writes a URDF's spheres to a file, and returns why it failed. run_batch: runs a suite's file, and
    returns nodes by RECORDING/JOB.
    """

    record: Record
    clearances: Clearances
    fit_spheres: FitSpheres
    run_batch: RunBatch


def campaign(arguments: Sequence[str]) -> int:
    """Judge, and print the report; return 1 if a run truly in contact was called safe."""
    args = _make_parser().parse_args(arguments)
    if args.report:
        rows = list[Row]()
        for path in args.report:
            rows = merge_rows(rows, read_rows(path))
    else:
        from tools.mujoco.recording import record  # MuJoCo is an optional extra
        from tools.mujoco.truth import clearances

        indices = choose_indices(args.first, args.runs, args.shard)
        request = Request(seed=args.seed, indices=indices, out=args.out.absolute(), jobs=args.jobs)
        rows = judge(
            request, Machinery(record=record, clearances=clearances, fit_spheres=fit_spheres, run_batch=run_batch)
        )
        write_worst(request.out, rows, request.out / BATCH)
        if args.table is not None:
            write_rows(args.table, merge_rows(read_rows(args.table), rows))
    print("\n".join(report(rows, markdown=args.markdown)))
    return int(has_grave_error(rows))


def judge(request: Request, machinery: Machinery) -> list[Row]:
    """The rows of a campaign, by index and mode."""
    failures = make_recordings(request, machinery.record)
    made = list[Recording]()
    for index in request.indices:
        if index not in failures:
            recording = read_recording(_place(request, index), request.out / SPHERES)
            cause = "" if recording.spheres.is_file() else machinery.fit_spheres(recording.urdf, recording.spheres)
            failures |= {index: cause} if cause else {}
            made += [] if cause else [recording]
    rows = [Row(seed=request.seed, index=index, mode=RECORD, reason=text) for index, text in failures.items()]
    if made:
        suite = request.out / "suite.toml"
        suite.write_text(write_suite(made, num_threads=1 if request.jobs > 1 else None), encoding="utf-8")
        nodes = machinery.run_batch(suite, request.jobs)
        for recording in made:
            name = recording.row.name
            mine = {job: nodes[f"{name}/{job}"] for job in (SCENE, AUDIT, DRIVEN)}
            folder = request.out / BATCH / name
            rows += [judge_replay(recording, mode, mine, folder, machinery.clearances) for mode in (AUDIT, DRIVEN)]
    return merge_rows([], rows)


def choose_indices(first: int, runs: int, shard: tuple[int, int]) -> range:
    """The indices of a shard (K, M): every M-th from the K-th on."""
    part, count = shard
    return range(first, first + runs)[part - 1 :: count]


def make_recordings(request: Request, record: Record) -> dict[int, str]:
    """Make recordings that are missing or of other sources; return reasons of failures by index."""
    digest = hash_sources(HERE)
    missing = [index for index in request.indices if _read_stamp(_place(request, index)) != digest]
    return _record_all(request, missing, record, digest)


def hash_sources(folder: Path) -> str:
    """SHA-256 of the sources that decide the content of a recording."""
    sources = [path for path in sorted(folder.glob("*.py")) if path.name not in JUDGES]
    return hashlib.sha256(b"".join(path.name.encode() + path.read_bytes() for path in sources)).hexdigest()


def write_suite(recordings: Sequence[Recording], *, num_threads: int | None) -> str:
    """The suite's TOML: a scene, an audit and a closed loop of each recording, at default settings."""
    limits = [f"timeout = {json.dumps(TIMEOUT)}", *([f"threads = {num_threads}"] if num_threads else [])]
    jobs = {SCENE: ['command = "reconstruct"'], AUDIT: ['command = "replay"']}
    jobs[DRIVEN] = ['command = "replay"', 'mode = "closed-loop"']
    lines = ['name = "mujoco"', f"out = {json.dumps(BATCH)}"]
    for job, words in jobs.items():
        lines += ["", f"[jobs.{job}]", *words, *limits]
    for recording in recordings:
        lines += ["", "[[recordings]]", f"name = {json.dumps(recording.row.name)}"]
        lines += [f"paths = [{json.dumps(str(recording.log))}]"]
        urdf, spheres = json.dumps(str(recording.urdf)), json.dumps(str(recording.spheres))
        lines += ["[recordings.jobs]", *(f"{job} = {{ urdf = {urdf}, spheres = {spheres} }}" for job in jobs)]
    return "\n".join(lines) + "\n"


def find_tool() -> list[str]:
    """The command line of the tool under test: next to this Python, else its package."""
    executable = Path(sys.executable).with_name("splatctrl")
    return [str(executable)] if executable.is_file() else [sys.executable, "-m", "splatctrl_cli"]


def fit_spheres(urdf: Path, spheres: Path) -> str:
    """Fit a robot's spheres in a process of the tool; return why it failed, or ""."""
    spheres.parent.mkdir(parents=True, exist_ok=True)
    words = [*find_tool(), "robot", "spheres", "--urdf", str(urdf), "-o", str(spheres), "--force", "-q"]
    ended = subprocess.run(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False)
    return "" if spheres.is_file() else f"robot spheres: exit {ended.returncode}: {ended.stderr.strip()}"[:120]


def run_batch(suite: Path, workers: int) -> dict[str, Node]:
    """Run a suite in a process of the tool, and return how each node ended. Raises RuntimeError without an answer."""
    words = [*find_tool(), "batch", str(suite), "--workers", str(workers), "--json"]
    ended = subprocess.run(words, stdout=subprocess.PIPE, text=True, check=False)
    document = json.loads(ended.stdout or "{}")
    if "nodes" not in document:
        raise RuntimeError(f"splatctrl batch: expected nodes, got exit {ended.returncode}: {document.get('error')}")
    names = ("state", "exit_code", "cause", "sentence", "seconds")
    return {node["id"]: Node(**{name: node[name] for name in names}) for node in document["nodes"]}


def record_one(record: Record, seed: int, index: int, folder: Path, digest: str) -> str:
    """Make a new recording and stamp it; return why it failed, or ""."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        record(seed, index, folder)
        read_recording(folder, folder)
    except Exception as error:  # any failure is a row of the table
        return f"{type(error).__name__}: {error}"[:120]
    (folder / STAMP).write_text(digest, encoding="utf-8")
    return ""


def _record_all(request: Request, indices: Sequence[int], record: Record, digest: str) -> dict[int, str]:
    """Make recordings in parallel; return reasons of failures by index. If a process dies, each unanswered recording
    gets its own process.
    """
    failures, lost = dict[int, str](), list[int]()
    with ProcessPoolExecutor(request.jobs, mp_context=get_context("spawn")) as pool:
        futures = {
            index: pool.submit(record_one, record, request.seed, index, _place(request, index), digest)
            for index in indices
        }
        for index, future in futures.items():
            try:
                failures[index] = future.result()
            except BrokenProcessPool:
                lost.append(index)
    if len(indices) == 1 and lost:
        return {lost[0]: "the recorder's process died"}
    for index in lost:
        failures |= _record_all(request, [index], record, digest)
    return {index: text for index, text in failures.items() if text}


def _place(request: Request, index: int) -> Path:
    return request.out / RECORDINGS / f"{request.seed}-{index}"


def _read_stamp(folder: Path) -> str:
    stamp = folder / STAMP
    return stamp.read_text(encoding="utf-8") if stamp.is_file() else ""


def _parse_shard(text: str) -> tuple[int, int]:
    part, _, count = text.partition("/")
    if not (part.isdecimal() and count.isdecimal() and 1 <= int(part) <= int(count)):
        raise argparse.ArgumentTypeError(f"expected K/M with K from 1 to M, got {text!r}")
    return int(part), int(count)


def _make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tools.mujoco campaign", description=__doc__, allow_abbrev=False)
    add = parser.add_argument
    add("--runs", type=int, default=100, metavar="N", help="number of recordings (default: 100)")
    add("--seed", type=int, default=0, metavar="S", help="seed of the campaign (default: 0)")
    add("--first", type=int, default=0, metavar="I", help="index of the first recording (default: 0)")
    add("--shard", type=_parse_shard, default=(1, 1), metavar="K/M", help="every M-th recording from the K-th on")
    add("--jobs", type=int, default=os.cpu_count() or 1, metavar="N", help="processes (default: one per core)")
    add(
        "-o",
        "--out",
        type=Path,
        default=Path("mujoco.out"),
        metavar="DIR",
        help="the campaign's folder, one for each shard that runs at the same time (default: mujoco.out)",
    )
    add("--table", type=Path, metavar="FILE.csv", help="put the rows into it, in the place of earlier ones")
    add("--report", type=Path, nargs="+", metavar="FILE.csv", help="report on these tables, and run nothing")
    add("--markdown", action="store_true", help="print the report's tables as Markdown")
    return parser

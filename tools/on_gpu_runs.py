"""Commands on an NVIDIA card: ``python -m tools.on_gpu_runs -o FILE.md [--recording NAME=SOURCE]``, for docs/gpu.md.

Each recording is reconstructed on the processor and twice on the card, scored, and timed by part. Then failures of a
card are provoked. Without pinocchio, a stand-in lets commands start, and recordings need no robot.
"""

import argparse
import functools
import hashlib
import importlib.util
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent
STREAM, STILL = "sample_data/tabletop/log.mcap --cameras cam0,cam1,cam2", "--dtu sample_data/dtu --holdout 1,4"
ROBOT = "--urdf sample_data/tabletop/robot.urdf --spheres sample_data/tabletop/robot_spheres.yaml"
RECORDINGS = {"tabletop": f"{STREAM} {ROBOT}" if importlib.util.find_spec("pinocchio") else STREAM, "dtu": STILL}
SCORED = {"tabletop": "sample_data/tabletop/log.mcap --cameras cam3", "dtu": STILL}
OF_THE_MAP = {"--max-splats", "--urdf", "--spheres"}  # options with a value that are not of a reference
DEVICES = ("cpu", "cuda", "cuda")
LIMIT_S = 240
LEFT, MANY = 1_300_000_000, "2000000"  # bytes left free on a full card, a process takes some 500 MB; splats
STAND_INS = {"pinocchio": "pin", "coal": "coal"}  # the distribution of each, whose version run.json has
PARTS = {  # of SceneFitter, as the table calls them
    "_find_mounted": "mounted", "_seed": "seeding", "_fill_gaps": "gaps", "_show_contact": "contact",
    "_prune": "removal", "_remove": "removal", "_use_idle": "relocation", "_audit": "audit",
    "known_voxels": "snapshots",
}  # fmt: skip


def main() -> None:
    """Everything, or one command with its parts timed."""
    if sys.argv[1:2] == ["--timed"]:
        raise SystemExit(timed(sys.argv[2:]))
    parser = argparse.ArgumentParser(description=__doc__, allow_abbrev=False)
    parser.add_argument("-o", "--out", type=Path, help="Markdown, written as far as it has come")
    parser.add_argument("--recording", action="append", default=[], metavar="NAME=SOURCE ...")
    parser.add_argument("--device", default="cuda", help="cpu to try the program where there is no card")
    given = parser.parse_args()
    recordings = RECORDINGS | dict(one.split("=", 1) for one in given.recording)
    with tempfile.TemporaryDirectory() as folder:
        desk = Desk(Path(folder), given.device)
        parts: dict[str, Callable[[], list[str]]] = {
            "Reconstructions": lambda: reconstructions(desk, recordings),
            "What goes wrong": lambda: failures(desk, STREAM),
        }
        lines: list[str] = []
        for title, part in parts.items():
            rows = part()
            print("\n".join(["", title, *rows]), flush=True)
            lines += [f"### {title}", "", *rows, ""]
            if given.out:
                given.out.write_text("\n".join(lines))


class Desk:
    """Runs commands of this tree in `folder`."""

    def __init__(self, folder: Path, device: str) -> None:
        self.folder, self.device = folder, device
        self.path = os.pathsep.join([*stand_ins(folder / "stand_ins"), str(ROOT), os.environ.get("PYTHONPATH", "")])

    def start(self, words: Sequence[str], **variables: str) -> "subprocess.Popen[str]":
        """A process of the command line."""
        return subprocess.Popen(
            [sys.executable, "-m", *words],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": self.path, **variables},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def run(self, words: Sequence[str], **variables: str) -> tuple[int, str, str, float]:
        """Exit code (124 at the time limit), stdout, stderr and seconds."""
        begin = time.perf_counter()
        process = self.start(words, **variables)
        try:
            out, err = process.communicate(timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            out, err = process.communicate()
            return 124, out, err, time.perf_counter() - begin
        return process.returncode, out, err, time.perf_counter() - begin

    def reconstruct(self, source: str, out: str, device: str, *options: str) -> list[str]:
        """The words that do it."""
        device = device if self.device == "cuda" else "cpu"
        words = ["splatctrl_cli", "reconstruct", *shlex.split(source), "-o", str(self.folder / out)]
        return [*words, "--device", device, *options]


def stand_ins(folder: Path, names: Sequence[str] | None = None) -> list[str]:
    """A folder with empty modules for `names`, by default for missing packages. No run without a robot calls them."""
    missing = [name for name in STAND_INS if importlib.util.find_spec(name) is None] if names is None else names
    for name in missing:
        (folder / name).mkdir(parents=True)
        (folder / name / "__init__.py").write_text(
            "from unittest.mock import MagicMock\n\n\ndef __getattr__(name):\n    return MagicMock()\n"
        )
        kept = folder / f"{STAND_INS[name]}-0.dist-info"
        kept.mkdir()
        (kept / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {STAND_INS[name]}\nVersion: 0\n")
    return [str(folder)] if missing else []


def timed(words: Sequence[str]) -> int:
    """Run the command line; then print to stderr, as JSON, each part's seconds, without nested parts."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line has it, before NumPy is imported
    from splatctrl_cli.cli.main import main as command
    from splatctrl_cli.scene import fitter
    from splatctrl_cli.scene.descent import Descent
    from splatctrl_cli.scene.occupancy import PeopleMemory

    seconds: dict[str, float] = defaultdict(float)
    within: list[float] = []

    def watch(owner: Any, name: str, label: str) -> None:
        real = getattr(owner, name)

        @functools.wraps(real)
        def call(*given: Any, **named: Any) -> Any:
            if threading.current_thread() is not threading.main_thread():
                return real(*given, **named)
            begin = time.perf_counter()
            within.append(0.0)
            try:
                return real(*given, **named)
            finally:
                spent = time.perf_counter() - begin
                seconds[label] += spent - within.pop()
                if within:
                    within[-1] += spent

        setattr(owner, name, call)

    watch(Descent, "run", "iterations")
    watch(Descent, "rendering", "M_add")
    watch(Descent, "misfits", "misfits")
    watch(PeopleMemory, "take_in", "occupancy")
    watch(fitter.SceneFitter, "step", "self-mask, labels")
    for name, label in PARTS.items():
        watch(fitter.SceneFitter, name, label)
    code = command(list(words))
    print(json.dumps(seconds), file=sys.stderr)
    return code


def digest(folder: Path) -> str:
    """Digest of every file except run.json and the checkpoint, which contains the path."""
    names = sorted(p for p in folder.rglob("*") if p.is_file() and p.name not in {"run.json", "state.npz"})
    whole = b"".join(str(p.relative_to(folder)).encode() + p.read_bytes() for p in names)
    return hashlib.sha256(whole).hexdigest()[:12]


def reconstructions(desk: Desk, recordings: Mapping[str, str]) -> list[str]:
    """Rows by run: quality, times and bytes; then the shares of its parts."""
    rows = [
        "Seconds: of the process, and of the fit in it. Scores: views that did not train where there are any.",
        "",
        "| recording | device | s | fit s | iterations | splats | training dB | dB seen | depth error mm | bytes |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    shares = ["", "| recording | device | seconds of the fit's parts, the largest first |", "|---|---|---|"]
    for name, source in recordings.items():
        known = ""
        for number, device in enumerate(DEVICES):
            out = f"{name}{number}"
            words = desk.reconstruct(source, out, device)
            code, _, err, wall = desk.run(["tools.on_gpu_runs", "--timed", *words[1:]])
            if code not in (0, 3):
                rows.append(f"| {name} | {device} | exit {code}: {err.strip()[-300:]} |" + " |" * 7)
                continue
            run = json.loads((desk.folder / out / "run.json").read_text())
            metrics, bytes_ = run["metrics"], digest(desk.folder / out)
            same = "" if device == "cpu" or not known else " equal" if bytes_ == known else " DIFFERENT"
            known = bytes_ if device != "cpu" else known
            cells = [
                *(name, metrics["devices"][-1]["device"], f"{wall:.1f}", f"{run['seconds']['fit']:.1f}"),
                *(f"{metrics['iterations']}", f"{metrics['splats']}", f"{metrics['psnr']:.2f}"),
                *(scored(desk, SCORED.get(name, f"{source} --allow-training"), out), bytes_ + same),
            ]
            rows.append(f"| {' | '.join(cells)} |")
            parts = sorted(json.loads(err.strip().splitlines()[-1]).items(), key=lambda part: -part[1])
            shares.append(f"| {name} | {device} | {', '.join(f'{label} {s:.2f}' for label, s in parts)} |")
    return rows + shares


def of_reference(recording: str) -> list[str]:
    """Arguments of `score` for a recording, from those of `reconstruct`."""
    given = shlex.split(recording)
    kept = [word for word, last in zip(given, ["", *given], strict=False) if not {word, last} & OF_THE_MAP]
    return kept if kept[0].startswith("--") else ["--reference", *kept]


def scored(desk: Desk, reference: str, scene: str) -> str:
    """dB and mm over the pixels seen, as two cells."""
    words = of_reference(reference)
    code, out, err, _ = desk.run(["splatctrl_cli", "score", str(desk.folder / scene), *words, "--json", "-q"])
    if code not in (0, 3):
        return f"exit {code} {err.strip()[-120:]} | -"
    metrics = json.loads(out)["metrics"]
    depth = metrics["depth_median_seen"]
    return f"{metrics['psnr_seen']:.2f} | {'-' if depth is None else f'{1e3 * depth:.2f}'}"


def failures(desk: Desk, source: str) -> list[str]:
    """Rows by failure: the expected and the actual result, and seconds."""
    rows = ["| what | expected | came | s |", "|---|---|---|---|"]

    def row(what: str, expected: str, came: str, seconds: float, *, is_good: bool) -> None:
        came = " ".join(came.split()).replace("|", "/")[-330:]
        rows.append(
            f"| {what} | {expected} | {'as expected' if is_good else 'NOT AS EXPECTED'}: {came} | {seconds:.1f} |"
        )

    def ends(what: str, words: Sequence[str], code: int, message: str, **variables: str) -> str:
        got, _, err, seconds = desk.run(words, **variables)
        row(what, f"exit {code}, {message}", f"exit {got}: {err}", seconds, is_good=got == code and message in err)
        return err

    ends("no such card", desk.reconstruct(source, "a", "cuda:99"), 2, "no such card")
    hidden = {"CUDA_VISIBLE_DEVICES": ""}
    ends("cards are hidden", desk.reconstruct(source, "b", "cuda"), 2, "finds no card", **hidden)
    ends("cards are hidden, auto", desk.reconstruct(source, "c", "auto"), 0, "computes on the CPU", **hidden)
    ends("auto", desk.reconstruct(source, "d", "auto"), 0, "computes on cuda:0")
    with tempfile.NamedTemporaryFile() as file:
        caches = {"XDG_CACHE_HOME": file.name, "HOME": file.name, "CUDA_CACHE_PATH": file.name}
        ends("the cache cannot be written", desk.reconstruct(source, "e", "cuda", "-q"), 0, "", **caches)
    if desk.device == "cuda":
        too_full(desk, ends)
    for what, rest in (("killed, then on the card", "cuda"), ("killed, then on the processor", "cpu")):
        killed(desk, source, what, rest, row)
    begin = time.perf_counter()
    both = [desk.start(desk.reconstruct(source, name, "cuda", "-q")) for name in ("two0", "two1")]
    errors = [process.communicate(timeout=LIMIT_S)[1] for process in both]
    whole = [digest(desk.folder / name) for name in ("d", "two0", "two1") if (desk.folder / name).is_dir()]
    is_good = len(whole) == 3 and len(set(whole)) == 1
    row("two at once", "bytes of one alone", f"{whole} {errors}", time.perf_counter() - begin, is_good=is_good)
    return rows


def too_full(desk: Desk, ends: Callable[..., str]) -> None:
    """A card of which another process holds nearly everything."""
    from splatctrl_cli.kernels.cuda.card import CudaDevice

    card = CudaDevice()
    held = card.allocate(card.available() - LEFT)
    few = ("--set", "scene.first_iterations=20", "--set", "scene.refine_iterations=10", "--max-splats")
    err = ends("too little memory", desk.reconstruct(STILL, "f", "cuda", *few, MANY), 2, "splats would fit")
    fits = err.partition("a budget of ")[2].partition(" ")[0] or "1000"
    ends("the budget that it named", desk.reconstruct(STILL, "g", "cuda", *few, fits), 0, "")
    ends(
        "too little memory, auto",
        desk.reconstruct(STILL, "h", "auto", *few, MANY),
        0,
        "computes on the CPU (too little memory",
    )
    card.free(held)


def killed(desk: Desk, source: str, what: str, rest: str, row: Callable[..., None]) -> None:
    """A run is killed after its third checkpoint, and goes on."""
    out, always = f"killed-{rest}", ("--set", "scene.checkpoint_period=0")
    begin = time.perf_counter()
    process = desk.start([*desk.reconstruct(source, out, "cuda", *always), "-q"])
    audit = desk.folder / f"{out}.partial" / "audit.jsonl"
    while process.poll() is None and (not audit.is_file() or audit.read_bytes().count(b"\n") < 4):
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.communicate()
    code, _, err, _ = desk.run([*desk.reconstruct(source, out, rest, *always), "--resume"])
    seconds = time.perf_counter() - begin
    if code:
        row(what, "exit 0", f"exit {code}: {err}", seconds, is_good=False)
        return
    devices = [
        each["device"] for each in json.loads((desk.folder / out / "run.json").read_text())["metrics"]["devices"]
    ]
    is_same = (desk.folder / "d").is_dir() and digest(desk.folder / out) == digest(desk.folder / "d")
    wanted = ["cuda:0"] if rest == "cuda" else ["cuda:0", "cpu"]
    came = f"devices {devices}, bytes {'equal' if is_same else 'different'}"
    row(
        what,
        f"{wanted}, same bytes: {rest == 'cuda'}",
        came,
        seconds,
        is_good=devices == wanted and is_same == (rest == "cuda"),
    )
    shutil.rmtree(desk.folder / out)


if __name__ == "__main__":
    main()

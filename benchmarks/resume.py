"""Kills `reconstruct` at random moments, resumes it, and compares every byte with a run that was left alone.

    python -m benchmarks.resume [--kills 10] [--threads 1 2 4] [--seed 0] [--set section.key=value ...]

Runs on the recording in sample_data/. Each thread count is one run that is killed (SIGKILL) again and again: after a
random time from its start, or from its last resume. Exits with 1 where a byte differs; `run.json` is compared without
its timings.
"""

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SAMPLE = Path(__file__).parent.parent / "sample_data" / "tabletop"


def main() -> int:
    """Run it and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--set", action="append", default=[])
    args = parser.parse_args()
    settings = [word for setting in args.set for word in ("--set", setting)]
    moments = random.Random(args.seed)
    differing = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        start = time.perf_counter()
        subprocess.run(_command(folder / "alone" / "scene", settings), check=True)
        alone = time.perf_counter() - start
        want = contents(folder / "alone" / "scene")
        print(f"left alone: {alone:.1f} s, {len(want)} files", flush=True)
        for threads in args.threads:
            out = folder / str(threads) / "scene"
            command = _command(out, [*settings, "--threads", str(threads)])
            when = _run_killed(command, out, args.kills, moments, 3.0 * alone / args.kills)
            got = contents(out)
            names = sorted(n for n in want.keys() | got.keys() if want.get(n) != got.get(n))
            differing += len(names)
            print(
                f"{threads} threads, killed after {when} time steps: {', '.join(names) or 'the same bytes'}",
                flush=True,
            )
    return 1 if differing else 0


def _run_killed(command: list[str], out: Path, num_kills: int, moments: random.Random, longest: float) -> list[int]:
    """Run to the end, killed `num_kills` times on the way; returns the audit rows on disk at each kill."""
    steps: list[int] = []
    while len(steps) < num_kills:
        process = subprocess.Popen([*command, "--resume"])
        try:
            process.wait(moments.uniform(0.0, longest))
            return steps  # it came to its end first
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        assert not out.exists()
        audit = out.with_name("scene.partial") / "audit.jsonl"
        steps.append(len(audit.read_text().splitlines()) if audit.is_file() else 0)
    subprocess.run([*command, "--resume"], check=True)
    return steps


def contents(folder: Path) -> dict[str, bytes]:
    """Every file's bytes by name; of run.json all but the timings and the arguments that differ by design."""
    found = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    run = json.loads(found["run.json"])
    del run["seconds"], run["arguments"]
    return found | {"run.json": json.dumps(run).encode()}


def _command(out: Path, options: list[str]) -> list[str]:
    robot = ["--urdf", str(SAMPLE / "robot.urdf"), "--spheres", str(SAMPLE / "robot_spheres.yaml")]
    log = [str(SAMPLE / "log.mcap"), "--cameras", "cam0,cam1,cam2"]
    tool = [sys.executable, "-m", "splatctrl_cli", "reconstruct"]
    return [*tool, *log, *robot, "-o", str(out), "-q", "--json", *options]


if __name__ == "__main__":
    sys.exit(main())

"""A replay for tests that takes no time: its log says for which values of its options it comes to which verdict."""

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from splatctrl_cli.cli.batch import OfThisProgram
from splatctrl_cli.cli.commands import build_parser
from splatctrl_cli.files.output import sha256, write_json

CODES = {"passed": 0, "failed": 1, "not evaluable": 5}
LABELS = {"passed": "safe", "failed": "margin broken", "not evaluable": "not evaluable"}


class Told(OfThisProgram):
    """Options are those of this program; what runs is `main`."""

    entry = "tests.jobs.sweep.entry:main"


def document_of(outcome: str, **more: Any) -> dict[str, Any]:
    verdict = {"outcome": outcome, "label": LABELS[outcome], "sentence": f"replay: {LABELS[outcome].upper()}"}
    return {"command": "replay", "verdict": verdict | {"reasons": []}, "metrics": {}, **more}


def config_of(margin: float = 0.02, period: float = 0.01) -> dict[str, Any]:
    return {"control": {"margin": margin, "period": period}}


def main(words: list[str]) -> int:
    """Judge the values in the words as the log says, tell of it in a file beside the log, and write the folder."""
    args = build_parser("replay").parse_args(words)
    told = json.loads(args.log.read_text())
    settings = dict(text.split("=") for text in args.set)
    values = {"latency": args.latency, "margin": float(settings.get("control.margin", 0.02))}
    with (args.log.parent / "told.txt").open("a") as stream:
        stream.write(f"{values}\n")
    time.sleep(told.get("sleep", 0.0))
    if values["latency"] > told.get("refuses", 9.0):
        sys.stderr.write("splatctrl: not so\n")
        return int(told.get("code", 4))
    total = sum(slope * values[name] for name, slope in told.get("slope", {}).items())

    def holds(kind: str) -> bool:
        spans = told.get(kind, {})
        return any(low <= values[name] < high for name in spans for low, high in spans[name])

    outcome = "failed" if holds("failed") or total >= 1 else "not evaluable" if holds("lacking") else "passed"
    args.out.mkdir(parents=True, exist_ok=True)
    more = {"arguments": words, "inputs": {"log": sha256(args.log)}, "config": config_of(values["margin"])}
    write_json(args.out / "run.json", document_of(outcome, **more))
    sys.stdout.write(json.dumps(document_of(outcome)))
    return CODES[outcome]


if __name__ == "__main__":  # a sweep in a process of its own, which a test kills
    from splatctrl_cli.jobs.sweep.sweep import SweepRequest, sweep

    sweep(SweepRequest(replay=Path(sys.argv[1]), over=sys.argv[3:], out=Path(sys.argv[2])), Told(threads=1))
    os._exit(0)

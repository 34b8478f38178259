"""Recordings by MuJoCo and the tool's answers: ``python -m tools.mujoco record | campaign | facade``."""

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path


def main(arguments: Sequence[str] | None = None) -> int:
    """Record one, or run a campaign."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    words = list(sys.argv[1:] if arguments is None else arguments)
    if words[:1] == ["campaign"]:
        from tools.mujoco.campaign import campaign

        return campaign(words[1:])
    if words[:1] == ["facade"]:
        from tools.mujoco import facade

        return facade.main(words[1:])
    from tools.mujoco.recording import record

    parser = argparse.ArgumentParser(prog="python -m tools.mujoco", description=__doc__, allow_abbrev=False)
    parser.add_argument("command", choices=("record", "campaign", "facade"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--index", type=int, default=0)
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="the recording's folder")
    given = parser.parse_args(words)
    record(given.seed, given.index, given.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())

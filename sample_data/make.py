"""Writes everything in sample_data/ anew: ``.venv/bin/python sample_data/make.py``. The same bytes every time."""

import shutil
import sys
import tempfile
from pathlib import Path

from splatctrl_cli.cli.main import main

HERE = Path(__file__).parent
FILES = ("log.mcap", "truth.json", "robot.urdf", "robot_spheres.yaml")


def make(destination: Path) -> int:
    """Simulate with the default options, a DTU scan too; keep all but run.json, which holds timings."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "simulated"
        code = main(["simulate", "--out", str(out), "--dtu", "--quiet"])
        if code != 0:
            return code
        (destination / "tabletop").mkdir(parents=True, exist_ok=True)
        for name in FILES:
            shutil.copyfile(out / name, destination / "tabletop" / name)
        shutil.rmtree(destination / "dtu", ignore_errors=True)
        shutil.copytree(out / "dtu", destination / "dtu")
    return 0


if __name__ == "__main__":
    sys.exit(make(HERE if len(sys.argv) < 2 else Path(sys.argv[1])))

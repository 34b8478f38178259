"""What tests of replays share with those of the command, and with those of what reads replays."""

from tests.cli.conftest import arm, coverage_once, desk, unpainted, without_plots
from tests.jobs.runs import run

__all__ = ["arm", "coverage_once", "desk", "run", "unpainted", "without_plots"]

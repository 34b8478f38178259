"""What tests of replays share with those of the command."""

from tests.cli.conftest import arm, coverage_once, desk, unpainted, without_plots

__all__ = ["arm", "coverage_once", "desk", "unpainted", "without_plots"]

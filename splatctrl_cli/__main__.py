"""Runs the command line as ``python -m splatctrl_cli``."""

from splatctrl_cli.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main())

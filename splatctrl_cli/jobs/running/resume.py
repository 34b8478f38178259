"""Resumption of an interrupted run, and what must be equal."""

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from splatctrl_cli import __version__
from splatctrl_cli.config import Config
from splatctrl_cli.errors import UsageError, refuse_if
from splatctrl_cli.files.output import sha256
from splatctrl_cli.formats.scene.scene_writer import Checkpoint, read_checkpoint
from splatctrl_cli.jobs.running.progress import Progress
from splatctrl_cli.kernels import arithmetic

DECIDING_OPTIONS: Mapping[str, object] = {  # defaults that decide a scene's bytes, besides its configuration
    **{"cameras": None, "camera": [], "camera_pose": [], "world_frame": None, "depth_scale": None},
    **{
        "pairing_tolerance": 0.02,
        "joint_topic": None,
        "holdout": None,
        "scan": None,
        "box": None,
        "refine_poses": False,
        "refine_exposure": False,
    },
}


def identity(
    options: Mapping[str, object], files: Mapping[str, Path | None], config: Config, inputs: Mapping[str, str]
) -> dict[str, Any]:
    """Plain values that decide the bytes of a run; the number of threads does not.

    options, files: by option name, files by content. inputs: sha256 of the recording's files.
    """
    values = {
        **deciding_versions(),
        **{f"--{name.replace('_', '-')}": value for name, value in options.items()},
        **{f"--{name}": sha256(path) for name, path in files.items() if path is not None},
        "sha256": dict(inputs),
        **config.as_dict(),
    }
    plain: dict[str, Any] = json.loads(json.dumps(values, default=str))
    return plain


def deciding_versions() -> dict[str, str]:
    """Versions of program, kernels and packages that may change a bit."""
    return {
        "splatctrl": __version__,
        "kernels": arithmetic(),
        # packages whose versions may change a bit
        **{name: metadata.version(name) for name in ("numpy", "scipy", "opencv-python-headless", "pin")},
    }


@contextmanager
def advise_resumption(checkpoint: Path, kept: Path | None = None) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        if not checkpoint.is_file():
            raise KeyboardInterrupt("interrupted before its first checkpoint; run the same command again") from None
        kept = kept or checkpoint.parent.parent
        raise KeyboardInterrupt(
            f"interrupted: {kept} is kept; continue it with the same command and --resume"
        ) from None


def check_resumption(checkpoint: Path, what: str, progress: Progress, *, resume: bool) -> bool:
    """True if --resume finds a checkpoint; log one that is missing or replaced.

    what: "run" or "bake".
    """
    partial, is_there = checkpoint.parent.parent, checkpoint.is_file()
    if resume and not is_there:
        progress.log(f"{partial}: has no checkpoint to continue from; starts at the beginning")
    elif is_there and not resume:
        progress.log(f"warning: {partial}: an interrupted {what} is replaced; --resume would have continued it")
    return resume and is_there


def checkpoint_to_go_on_from(folder: Path, now: Mapping[str, Any]) -> Checkpoint:
    """Read a partial folder's checkpoint. Raises UsageError naming differences."""
    checkpoint = read_checkpoint(folder)
    check_same_run(folder, checkpoint.progress["run"], now)
    return checkpoint


def check_same_run(folder: Path, run: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise UsageError naming deciding values that differ from the interrupted run."""
    before, after = dict(_flat(run)), dict(_flat(now))
    differing = [name for name in {**before, **after} if before.get(name) != after.get(name)]
    changes = ", ".join(
        f"{n} was {_format_value(before.get(n))}, is {_format_value(after.get(n))}" for n in differing[:3]
    )
    more = f" and {len(differing) - 3} more" if len(differing) > 3 else ""
    refuse_if(
        differing,
        f"{folder}: --resume: the interrupted run differs: {changes}{more}",
        remedy="give the same options, or start over without --resume",
        error=UsageError,
    )


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}{' of ' if name == 'sha256' else '.'}")
        else:
            yield f"{prefix}{name}", value


def _format_value(value: object) -> str:
    text = "not given" if value is None or value == [] else str(value)
    return text if len(text) <= 40 else f"{text[:12]}..."

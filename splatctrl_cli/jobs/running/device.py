"""Device of a fit or bake, and the continuation of an interrupted run."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

from splatctrl_cli import __version__
from splatctrl_cli.config import Config
from splatctrl_cli.config.fixed import CARD_LEAST_WORK
from splatctrl_cli.errors import DeviceFault, DeviceFull, UsageError, refuse_if
from splatctrl_cli.files.output import sha256
from splatctrl_cli.formats.scene.scene_writer import Checkpoint, read_checkpoint
from splatctrl_cli.jobs.running.progress import Progress
from splatctrl_cli.kernels import arithmetic
from splatctrl_cli.kernels.cuda.fit import DeviceFit, bytes_needed
from splatctrl_cli.kernels.cuda.memory import FIELD, FIT, Card, DeviceError, Memory, OutOfMemory, usable_card
from splatctrl_cli.libraries import is_installed
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.scene.fitter import SceneFitter

AUTO, CPU, CUDA = "auto", "cpu", "cuda"
EXTRA = ("cuda.core", "cuda.bindings")
TO_CPU = "give --device cpu"
INSTALL = "pip install 'splatctrl-cli[cuda]'"


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of a job; threads: 0 for one per core; device: text of --device."""

    config: Config = field(default_factory=Config)
    force: bool = False
    seed: int = 0
    threads: int = 0
    device: str = "auto"


@dataclass(frozen=True, kw_only=True)
class Device:
    """Device cpu, or cuda:N with its card and memory."""

    name: str = CPU
    card: Card | None = None
    memory: Memory | None = field(default=None, repr=False)

    def as_dict(self) -> dict[str, Any]:
        known = {} if self.card is None else {"card": self.card.name, "driver": self.card.driver}
        return {"device": self.name, **known}


def open_device(name: str, source: str = FIT) -> Device:
    """Open ``cuda`` or ``cuda:N`` for a source's kernels. Raises DeviceError with a remedy."""
    if missing := [module for module in EXTRA if not is_installed(module)]:
        raise DeviceError(f"the extra [cuda] is not installed ({missing[0]})", remedy=INSTALL)
    index = int(name.partition(":")[2] or 0)
    card = usable_card(index)
    try:
        from splatctrl_cli.kernels.cuda.card import CudaDevice

        memory = CudaDevice(card, source=source)
    except ImportError as error:
        raise DeviceError(f"the extra [cuda] cannot be used: {error}", remedy=INSTALL) from error
    return Device(name=f"{CUDA}:{index}", card=card, memory=memory)


def demand_device(name: str, source: str = FIT) -> Device | None:
    """Device of --device; None for auto. Raises UsageError if unusable."""
    if name in (AUTO, CPU):
        return None if name == AUTO else Device()
    try:
        return open_device(name, source)
    except DeviceError as error:
        raise UsageError(
            f"--device {name}: {error}", remedy=f"{error.remedy}, or {TO_CPU}" if error.remedy else TO_CPU
        ) from error


def automatic(
    progress: Progress, too_little: str = "", *, name: str = CUDA, source: str = FIT, needed: int = 0
) -> Device:
    """Choose a card with `needed` free bytes if the work is enough; log the choice."""
    try:
        refuse_if(too_little, too_little, error=DeviceError)
        device = open_device(name, source)
        assert device.memory is not None
        refuse_if(needed > device.memory.available(), "too little memory is free on the card", error=DeviceError)
    except DeviceError as error:
        progress.log(f"computes on the CPU ({error})")
        return Device()
    progress.log(f"computes on {describe_device(device.as_dict())}")
    return device


def choose_device(name: str, is_enough: bool, progress: Progress) -> Device:
    """Device of --device for fields; auto uses a card if the work is enough.

    Raises UsageError if it is unusable.
    """
    return demand_device(name, FIELD) or (automatic(progress, source=FIELD) if is_enough else Device())


class FitDevice:
    """Device of a fit, and its earlier devices.

    history: devices as in ``run.json``, with first iterations. auto uses a card for enough work, and resumes on the
    last device if usable. Raises UsageError for an unusable device.
    """

    def __init__(self, name: str = CPU) -> None:
        self.device = demand_device(name)
        self._fit: DeviceFit | None = None
        self.history: list[dict[str, Any]] = []

    def give(self, fitter: SceneFitter, frames: Sequence[RgbdFrame], progress: Progress) -> None:
        """Move a fitter to the device; `frames` are those of its first time step."""
        num_splats, window = fitter.config.max_splats, fitter.config.window
        sizes = [(frame.intrinsics.height, frame.intrinsics.width) for frame in frames]
        sizes += [max(sizes)] * window
        if self.device is None:
            self.device = self._choose(num_splats, sizes, progress)
        device, last = self.device, self.history[-1] if self.history else None
        if last is None or any(last.get(name) != device.as_dict().get(name) for name in ("device", "card")):
            begins = fitter.descent.num_iterations
            self.history.append({**device.as_dict(), "from_iteration": begins})
            if last is not None:
                progress.log(
                    f"warning: computed on {describe_device(last)} before iteration {begins}, on"
                    f" {describe_device(device.as_dict())} from there; for the bytes of one of them alone start over"
                )
        if device.memory is not None:
            self._fit = fitter.descent.device = DeviceFit(device.memory, num_splats, sizes)

    def _choose(self, num_splats: int, sizes: Sequence[tuple[int, int]], progress: Progress) -> Device:
        last = self.history[-1]["device"] if self.history else ""
        if last == CPU:
            return Device()
        num_pixels = max(height * width for height, width in sizes)
        is_enough = last or num_splats * num_pixels >= CARD_LEAST_WORK
        too_little = "" if is_enough else f"{num_splats} splats on {num_pixels} pixels are too little work for a card"
        return automatic(progress, too_little, name=last or CUDA, needed=bytes_needed(num_splats, sizes))

    def close(self) -> None:
        if self._fit is not None:
            with suppress(DeviceError):  # its failure was reported already
                self._fit.close()


@contextmanager
def explain_faults(device: Device | FitDevice | None, checkpoint: Path | None = None) -> Iterator[None]:
    """Raise a device's failure as DeviceFault or DeviceFull; an existing `checkpoint` changes the remedy."""
    try:
        yield
    except DeviceError as error:
        used = device.device if isinstance(device, FitDevice) else device
        what = "device" if used is None else describe_device(used.as_dict())
        remedy = "start over, with --device cpu if it fails again"
        if checkpoint is not None and checkpoint.is_file():
            remedy = f"{checkpoint.parent.parent} is kept: continue with --resume, and --device cpu if it fails again"
        kind = DeviceFull if isinstance(error, OutOfMemory) else DeviceFault
        raise kind(f"{what}: {error}", remedy=f"{error.remedy}; {remedy}" if error.remedy else remedy) from error


def describe_device(device: dict[str, Any]) -> str:
    card = f" ({device['card']}, driver {device['driver']})" if "card" in device else ""
    return f"{device['device']}{card}"


DECIDING_OPTIONS: Mapping[str, object] = {  # defaults of options that decide a scene's bytes, like its configuration
    **{"cameras": None, "camera": [], "camera_pose": [], "world_frame": None, "depth_scale": None},
    **{
        "pairing_tolerance": 0.02,
        "joint_topic": None,
        "base": None,
        "lock": [],
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

    options, files: by option name; a file counts by its content. inputs: sha256 of the recording's files.
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
    """Versions of program, kernels and packages that may change a byte."""
    return {
        "splatctrl": __version__,
        "kernels": arithmetic(),
        # packages whose versions may change a byte
        **{name: metadata.version(name) for name in ("numpy", "scipy", "opencv-python-headless", "pin")},
    }


@contextmanager
def advise_resumption(checkpoint: Path, folder: Path | None = None) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        if not checkpoint.is_file():
            raise KeyboardInterrupt("interrupted before its first checkpoint; run the same command again") from None
        folder = folder or checkpoint.parent.parent
        raise KeyboardInterrupt(
            f"interrupted: {folder} is kept; continue it with the same command and --resume"
        ) from None


def check_resumption(checkpoint: Path, what: str, progress: Progress, *, resume: bool) -> bool:
    """True if --resume finds a checkpoint; log a missing or replaced checkpoint.

    what: "run" or "bake".
    """
    partial, is_there = checkpoint.parent.parent, checkpoint.is_file()
    if resume and not is_there:
        progress.log(f"{partial}: has no checkpoint to continue from; starts at the beginning")
    elif is_there and not resume:
        progress.log(f"warning: {partial}: an interrupted {what} is replaced; --resume would have continued it")
    return resume and is_there


def checkpoint_to_go_on_from(folder: Path, now: Mapping[str, Any]) -> Checkpoint:
    """Read a partial folder's checkpoint. Raises UsageError naming differences from `now`."""
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

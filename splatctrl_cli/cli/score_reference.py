"""What `score` compares with: the recording, which of its views are scored by which protocol, and their masks."""

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from splatctrl_cli.captures.capture import is_capture
from splatctrl_cli.cli.common import Console
from splatctrl_cli.cli.numbers import whole
from splatctrl_cli.cli.source_options import source_options
from splatctrl_cli.containers.bag_log import is_bag_folder
from splatctrl_cli.datasets.dtu_source import DtuSource, view_numbers
from splatctrl_cli.datasets.protocols import ScoreProtocol, Split, score_protocol
from splatctrl_cli.errors import InputError, UsageError
from splatctrl_cli.evaluate.recording import changed_files, differences
from splatctrl_cli.records import Bool, RecordSource, RgbdFrame
from splatctrl_cli.scene_files.scene_folder import SceneFolder
from splatctrl_cli.sources.source import open_source


@dataclass(frozen=True, kw_only=True)
class Reference:
    """source: the recording with all its cameras. scan: its name in a data set of several. protocol and split where
    one was named; training_stamps_ns: of the views that it trains on. mask: of a frame, the pixels that the mask rule
    selects; mask_rule says it in words. Without depth, nothing says what a training camera saw. doubts: what speaks
    against the scores, in words.
    """

    source: "RecordSource"
    layout: str
    scan: str | None = None
    protocol: "ScoreProtocol | None" = None
    split: "Split | None" = None
    training_stamps_ns: frozenset[int] = frozenset()
    mask: "Callable[[RgbdFrame], Bool | None] | None" = None
    mask_rule: str = "none"
    numbered_by_stamp: bool = False
    has_depth: bool = True
    doubts: tuple[str, ...] = ()

    @property
    def scores_training(self) -> bool:
        """Whether the protocol scores the views that trained."""
        return self.protocol is not None and self.protocol.scores_training


def add_scan(parser: argparse.ArgumentParser) -> None:
    """``--scan``, ``--protocol`` and ``--depths``: what `reconstruct` and `score` ask of a DTU scan."""
    parser.add_argument("--scan", metavar="NAME", help="which scan of --dtu (default: the only one)")
    parser.add_argument(
        "--protocol",
        metavar="NAME",
        help="which views train and which are scored: dtu-train, dtu-holdout8, regnerf-3, regnerf-6, regnerf-9, "
        "mvsnerf, holdout:everyN, holdout:everyN+FIRST or holdout:2,5 (docs/score.md)",
    )
    parser.add_argument(
        "--depths", type=Path, metavar="DIR", help="depth_map_0000.pfm and so on of a scan in IDR's layout"
    )
    parser.add_argument(
        "--downscale",
        type=whole(1, 64),
        metavar="N",
        help="make images of --dtu N times smaller (default: down to the size of the protocol, if a whole factor)",
    )


def open_dtu(args: argparse.Namespace, masks: Path | None = None) -> "DtuSource":
    """The scan that --dtu, --scan, --holdout, --protocol and --depths name."""
    protocol = None if args.protocol is None else score_protocol(args.protocol)
    holdout = view_numbers(words(args.holdout or ""))
    return DtuSource(
        args.dtu, args.scan, holdout, protocol=protocol, masks=masks, depths=args.depths, downscale=args.downscale
    )


def open_held_out(args: argparse.Namespace, path: Path) -> tuple["RecordSource", "ScoreProtocol", "Split"]:
    """An image folder with the views held out that --protocol holdout:RULE names, by their places in it."""
    protocol = score_protocol(args.protocol)
    if not is_folder_of_views(path) or not args.protocol.startswith("holdout:"):
        raise UsageError(
            f"--protocol {args.protocol}: expected --dtu, or holdout:RULE and an image folder (its TOML, or that"
            " of a dataset)",
            remedy="leave --protocol out, or give --dtu ROOT",
        )
    if args.holdout:
        raise UsageError("--holdout: the protocol says what is held out", remedy="leave one of them out")
    options = replace(source_options(args), cameras=None)
    numbers = range(sum(1 for _ in open_source(path, options).poses()))
    split = protocol.split(numbers, str(path))
    return open_source(path, replace(options, holdout=tuple(map(str, split.scored)))), protocol, split


def is_folder_of_views(path: Path) -> bool:
    """Whether a recording is images in a folder, by a TOML or in a dataset's layout; not a log, not a capture."""
    return path.suffix == ".toml" or (path.is_dir() and not is_capture(path) and not is_bag_folder(path))


def refuse_scan_options(args: argparse.Namespace) -> None:
    """Raise UsageError for what belongs to --dtu where there is none."""
    for name in ("scan", "depths", "downscale"):
        if getattr(args, name):
            raise UsageError(f"--{name} {getattr(args, name)}: only with --dtu", remedy="leave it out")


def open_reference(args: argparse.Namespace, console: Console) -> Reference:
    """The recording with all its cameras: --cameras chooses those to score, the others say what was seen."""
    if args.dtu is not None:
        return _dtu_reference(args, console)
    refuse_scan_options(args)
    if args.masks is not None:
        raise UsageError(f"--masks {args.masks}: only with --dtu", remedy="leave it out")
    if args.protocol is not None:
        source, protocol, split = open_held_out(args, args.reference)
        stamps = [stamp for stamp, _, _ in source.poses()]  # type: ignore[attr-defined]
        return Reference(
            source=source,
            layout="image folder",
            protocol=protocol,
            split=split,
            training_stamps_ns=frozenset(stamps[n] for n in split.training),
        )
    return Reference(source=open_source(args.reference, replace(source_options(args), cameras=None)), layout="")


def _dtu_reference(args: argparse.Namespace, console: Console) -> Reference:
    source = open_dtu(args, args.masks)
    split, protocol = source.split, None
    if args.protocol is not None:
        protocol = score_protocol(args.protocol)
    mask, rule = _mask_of(source, "given" if protocol is None else protocol.mask)
    if protocol is not None and protocol.mask == "object" and mask is None:
        console.log(
            f"warning: {args.protocol}: its published figures are over the object alone, and there is no mask: every"
            " pixel counts here; --masks DIR gives the masks"
        )
    return Reference(
        source=source,
        layout=f"{source.layout}'s",
        scan=source.scan,
        protocol=protocol,
        split=split,
        training_stamps_ns=frozenset(split.training) if protocol else frozenset(),
        mask=mask,
        mask_rule=rule,
        numbered_by_stamp=True,
        has_depth=source.has_depth,
        doubts=tuple(_missing_views(source, protocol)),
    )


def _missing_views(source: "DtuSource", protocol: "ScoreProtocol | None") -> list[str]:
    """In words, which views of the scan are not there, where that changes which are scored, or that lack depth."""
    numbers = sorted({*source.split.training, *source.split.scored, *source.split.left_out})
    missing = sorted(set(range(numbers[-1] + 1)) - set(numbers))
    lines = []
    if missing and protocol is not None and protocol.every:
        listed = ", ".join(map(str, missing[:8])) + (", ..." if len(missing) > 8 else "")
        lines.append(
            f"{source.name}: views {listed} are not there: '{protocol.name}' counts those that are, and scores others"
            " than of a whole scan; add the views, or name those to score as holdout:0,8"
        )
    if source.has_depth and source.loss.notes:
        more = len(source.loss.notes) - 1
        lines.append(source.loss.notes[0] + (f" (and {more} more)" if more else ""))
    return lines


def _mask_of(source: "DtuSource", wanted: str) -> "tuple[Callable[[RgbdFrame], Bool | None] | None, str]":
    if wanted == "depth":
        return (lambda frame: frame.depth > 0), "pixels with a reference depth"
    if any(source.mask(number) is not None for number in source.split.scored or source.split.training):
        return (lambda frame: source.mask(frame.stamp_ns)), "object mask"
    return None, "none"


def words(text: str) -> list[str]:
    """The words between commas."""
    return [word.strip() for word in text.split(",") if word.strip()]


def cameras_to_score(args: argparse.Namespace, reference: Reference, training: Sequence[str]) -> tuple[str, ...]:
    """The cameras that are scored: by default those that did not train. Raises UsageError where there is none."""
    where, recorded = args.reference or args.dtu, reference.source.cameras
    if reference.scores_training:
        return recorded
    if args.cameras is None:
        cameras = tuple(name for name in recorded if name not in training)
        if cameras:
            return cameras
        if args.allow_training and recorded:
            return recorded
        raise UsageError(
            f"{where}: each camera is called like one that trained the scene ({', '.join(recorded)})",
            remedy="give the views that reconstruct left out as --holdout or --protocol, or --allow-training",
        )
    cameras = tuple(dict.fromkeys(words(args.cameras)))
    unknown = [name for name in cameras if name not in recorded]
    if unknown:
        raise InputError(f"{where}: no camera {unknown[0]!r}", remedy=f"use one of: {', '.join(recorded)}")
    trained = [name for name in cameras if name in training]
    if trained and not args.allow_training:
        raise UsageError(
            f"--cameras {args.cameras}: {trained[0]} trained the scene, its score says nothing about other views",
            remedy="give a camera that was held out, or --allow-training",
        )
    return cameras


def check_training(args: argparse.Namespace, reference: Reference, scene: "SceneFolder") -> None:
    """Raise UsageError where the scene was not trained on the views that the protocol trains on."""
    if reference.protocol is None or reference.split is None:
        return
    trained, expected = scene.training_stamps_ns, reference.training_stamps_ns
    if trained == expected:
        return
    lacks, others = len(expected - trained), len(trained - expected)
    raise UsageError(
        f"{args.scene}: protocol {reference.protocol.name} trains on {len(expected)} views"
        f" ({reference.split.words()}), of which {lacks} did not train the scene, and {others} others did",
        remedy=f"reconstruct with --protocol {reference.protocol.name}",
    )


def recording_check(
    args: argparse.Namespace, reference: Reference, scene: "SceneFolder", digests: Mapping[str, str]
) -> dict[str, Any]:
    """What the recording has in common with the one that made the scene. Raises InputError where they differ.

    By the first frame of each camera that trained (not kept by an older version), and the digests of files of the
    same names.
    """
    recorded = scene.run.get("metrics", {}).get("first_frames")
    then = scene.run.get("inputs", {})
    compared = [name for name in then if name in digests]
    basis = [f"digests of {len(compared)} files of the same names"] if compared else []
    lines = changed_files(then, digests)
    if recorded:
        basis.append("intrinsics, stamp, pose and picture of each training camera's first frame")
        lines += differences(recorded, reference.source.records())
    if lines and not args.allow_other_recording:
        raise InputError(
            f"{args.reference or args.dtu}: not the recording that {args.scene} was made from: {'; '.join(lines)}",
            remedy="give that recording, or --allow-other-recording to score against this one",
        )
    return {"basis": basis, "differences": lines}

"""Reference of `score`: recording, scored views by protocol, and masks."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import InputError, UsageError, refuse_if
from splatctrl_cli.evaluate.protocols import ScoreProtocol, Split, score_protocol
from splatctrl_cli.formats.scene.scene_folder import SceneFolder
from splatctrl_cli.jobs.recordings.open_recording import (
    RecordingRequest,
    open_dtu,
    open_held_out,
    refuse_scan_options,
)
from splatctrl_cli.jobs.recordings.provenance import changed_files, differences
from splatctrl_cli.jobs.running.progress import Progress
from splatctrl_cli.recording.folder.idr import DtuSource
from splatctrl_cli.recording.source import open_session, open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.records import Bool, RecordSource, RgbdFrame

Mask = Callable[[RgbdFrame], Bool | None]
"""Function of a frame to the pixels (H, W) that the mask rule selects, or None."""


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Recording `where` with all its cameras, to score against.

    scan: its name in the data set. mask_rule: describes `mask`. Without depth, it is unknown what training cameras
    saw. stamps_ns: by camera, for a session of logs.
    """

    where: Path
    source: RecordSource
    layout: str = ""
    scan: str | None = None
    protocol: ScoreProtocol | None = None
    split: Split | None = None
    training_stamps_ns: frozenset[int] = frozenset()
    mask: Mask | None = None
    mask_rule: str = "none"
    numbered_by_stamp: bool = False
    has_depth: bool = True
    stamps_ns: Mapping[str, Sequence[int]] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()

    @property
    def scores_training(self) -> bool:
        return self.protocol is not None and self.protocol.scores_training


def open_reference(recording: RecordingRequest, progress: Progress) -> Reference:
    """Open the recording with all cameras; those not scored show what was seen."""
    if recording.is_dtu:
        return _dtu_reference(recording, progress)
    refuse_scan_options(recording)
    where = recording.path
    if recording.others:
        return _session_reference((where, *recording.others), replace(recording.options, cameras=None))
    if recording.protocol is None:
        source = open_source(where, replace(recording.options, cameras=None), needs_depth=False)
        return Reference(where=where, source=source, has_depth=source.depth_fault is None)
    source, protocol, split = open_held_out(recording)
    stamps = [stamp for stamp, _, _ in source.poses()]
    return Reference(
        where=where,
        source=source,
        layout="image folder",
        protocol=protocol,
        split=split,
        training_stamps_ns=frozenset(stamps[n] for n in split.training),
        has_depth=source.depth_fault is None,
    )


def _session_reference(paths: Sequence[Path], options: SourceOptions) -> Reference:
    source = open_session(paths, options)
    stamps_ns: dict[str, list[int]] = {}
    for stamp, camera, _ in source.poses():
        stamps_ns.setdefault(camera, []).append(stamp)
    return Reference(where=Path(" + ".join(map(str, paths))), source=source, stamps_ns=stamps_ns)


def _dtu_reference(recording: RecordingRequest, progress: Progress) -> Reference:
    source = open_dtu(recording)
    protocol = None if recording.protocol is None else score_protocol(recording.protocol)
    mask, rule = _mask_of(source, "given" if protocol is None else protocol.mask)
    if protocol is not None and protocol.mask == "object" and mask is None:
        progress.log(
            f"warning: {protocol.name}: its published figures are over the object alone, and there is no mask: every"
            " pixel counts here; --masks DIR gives the masks"
        )
    return Reference(
        where=recording.path,
        source=source,
        layout=f"{source.layout}'s",
        scan=source.scan,
        protocol=protocol,
        split=source.split,
        training_stamps_ns=frozenset(source.split.training) if protocol else frozenset(),
        mask=mask,
        mask_rule=rule,
        numbered_by_stamp=True,
        has_depth=source.has_depth,
        doubts=tuple(missing_views(source, protocol)),
    )


def missing_views(source: DtuSource, protocol: ScoreProtocol | None) -> Iterator[str]:
    """Sentences on missing views that change the score, and on missing depth."""
    numbers = sorted({*source.split.training, *source.split.scored, *source.split.left_out})
    missing = sorted(set(range(numbers[-1] + 1)) - set(numbers))
    if missing and protocol is not None and protocol.every:
        listed = ", ".join(map(str, missing[:8])) + (", ..." if len(missing) > 8 else "")
        yield (
            f"{source.name}: views {listed} are not there: '{protocol.name}' counts those that are, and scores others"
            " than of a whole scan; add the views, or name those to score as holdout:0,8"
        )
    if source.has_depth and source.loss.notes:
        more = len(source.loss.notes) - 1
        yield source.loss.notes[0] + (f" (and {more} more)" if more else "")


def _mask_of(source: DtuSource, wanted: str) -> tuple[Mask | None, str]:
    if wanted == "depth":
        return (lambda frame: frame.depth > 0), "pixels with a reference depth"
    if any(source.mask(number) is not None for number in source.split.scored or source.split.training):
        return (lambda frame: source.mask(frame.stamp_ns)), "object mask"
    return None, "none"


def cameras_to_score(
    wanted: Sequence[str] | None, reference: Reference, training: Sequence[str], *, allow_training: bool
) -> tuple[str, ...]:
    """Scored cameras, by default those that did not train. Raises UsageError without a camera."""
    recorded = reference.source.cameras
    if reference.scores_training:
        return recorded
    if wanted is None:
        cameras = tuple(name for name in recorded if name not in training)
        refuse_if(
            not cameras and not (allow_training and recorded),
            f"{reference.where}: each camera has the name of one that trained the scene ({', '.join(recorded)})",
            remedy="give the views that reconstruct left out as --holdout or --protocol, or --allow-training",
            error=UsageError,
        )
        return cameras or recorded
    cameras = tuple(dict.fromkeys(wanted))
    if unknown := [name for name in cameras if name not in recorded]:
        raise InputError(f"{reference.where}: no camera {unknown[0]!r}", remedy=f"use one of: {', '.join(recorded)}")
    trained = [name for name in cameras if name in training]
    refuse_if(
        trained and not allow_training,
        f"--cameras {','.join(wanted)}: {', '.join(trained[:1])} trained the scene, its score says nothing about"
        " other views",
        remedy="give a camera that was held out, or --allow-training",
        error=UsageError,
    )
    return cameras


def check_times(reference: Reference, scoring: Sequence[str], training: Sequence[str]) -> None:
    """Raise InputError if all frames of a scored camera precede or follow the training frames."""
    trained = [stamp for camera in training for stamp in reference.stamps_ns.get(camera, ())]
    for camera in scoring if trained else ():
        stamps = reference.stamps_ns[camera]
        refuse_if(
            stamps[0] > max(trained) or stamps[-1] < min(trained),
            f"{reference.where}: camera {camera}: expected frames between those that trained, {min(trained)} to"
            f" {max(trained)} ns, got {stamps[0]} to {stamps[-1]} ns",
            remedy="give logs of the same time and clock, or other --cameras",
        )


def check_training(path: Path, scene: SceneFolder, reference: Reference) -> None:
    """Raise UsageError if the scene did not train on the protocol's training views."""
    if reference.protocol is None or reference.split is None or not scene.names_its_views:
        return
    trained, expected = scene.training_stamps_ns, reference.training_stamps_ns
    refuse_if(
        trained != expected,
        f"{path}: protocol {reference.protocol.name} trains on {len(expected)} views ({reference.split.words()}), of"
        f" which {len(expected - trained)} did not train the scene, and {len(trained - expected)} others did",
        remedy=f"reconstruct with --protocol {reference.protocol.name}",
        error=UsageError,
    )


def recording_check(
    path: Path, scene: SceneFolder, reference: Reference, digests: Mapping[str, str], *, allow_other: bool
) -> dict[str, Any]:
    """Compare the recording with that of the scene.

    Compares training cameras' first frames, if kept, and digests of files with equal names. Raises InputError for
    differences, unless `allow_other`.
    """
    recorded = scene.run.get("metrics", {}).get("first_frames")
    then = scene.run.get("inputs", {})
    compared = [name for name in then if name in digests]
    basis = [f"digests of {len(compared)} files of the same names"] if compared else []
    lines = changed_files(then, digests)
    if recorded:
        basis.append("intrinsics, stamp, pose and picture of each training camera's first frame")
        lines += differences(recorded, reference.source.records())
    refuse_if(
        lines and not allow_other,
        f"{reference.where}: not the recording that {path} was made from: {'; '.join(lines)}",
        remedy="give that recording, or --allow-other-recording to score against this one; for a camera of"
        " another log of its session give both, each as --reference",
    )
    return {"basis": basis, "differences": lines}

"""A ROS log as records: paired images, poses from tf, joints in one order.

The first pass skips images, as transforms may follow them, and plans every frame. The second reads planned images in
plan order. For `ingest`, files that a capture can keep stay undecoded.
"""

import tempfile
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from splatctrl_cli.errors import InputError, refuse_if
from splatctrl_cli.files.output import sha256
from splatctrl_cli.files.spilled_rows import RowFile, scratch_folder
from splatctrl_cli.formats.image_file import PNG
from splatctrl_cli.recording.container.raw_log import Damage, RawLog, RawMessage
from splatctrl_cli.recording.log.decoder import MessageDecoder, UndecodableMessageError
from splatctrl_cli.recording.log.messages import ImageMessage, color_of, depth_of, num_invalid, read_image
from splatctrl_cli.recording.log.rig import Camera, build_cameras, nearest_gap_ns
from splatctrl_cli.recording.log.state_messages import STATE_TYPES
from splatctrl_cli.recording.log.state_topics import joint_records
from splatctrl_cli.recording.log.stored_frame import (
    FrameSource,
    JointTopics,
    StoredFrame,
    check_depth,
    decoded,
    human_mask,
    is_kept,
    merge_joints,
)
from splatctrl_cli.recording.log.survey import Survey, dropped, first_of_each, pair_images, survey
from splatctrl_cli.recording.source_options import SourceOptions, still_note
from splatctrl_cli.records import SECOND_NS, Float64, Index, LossReport, Record, UInt8, merge_by_stamp

NO_MASK = -1


@dataclass(frozen=True, kw_only=True)
class PlannedFrame:
    """A planned frame: message numbers by topic (human_index None: no mask), and the pose."""

    stamp_ns: int
    camera: Camera
    color_index: int
    depth_index: int
    human_index: int | None
    T_world_camera: Float64

    @property
    def keys(self) -> list[tuple[str, int]]:
        camera = self.camera
        keys = [(camera.color_topic, self.color_index), (camera.depth_topic, self.depth_index)]
        return keys if self.human_index is None else [*keys, (camera.human_topic, self.human_index)]


class FramePlan:
    """Frames by stamp, then camera, then colour number."""

    def __init__(self, cameras: Sequence[Camera]) -> None:
        self._cameras = tuple(sorted(cameras, key=lambda camera: camera.name))
        self._columns = np.zeros((6, 0), dtype=np.int64)  # stamp, camera, colour, depth and mask number, row of pose
        self._poses = RowFile((4, 4))

    def __len__(self) -> int:
        return self._columns.shape[1]

    def __getitem__(self, number: int) -> PlannedFrame:
        stamp, camera, color, depth, human, row = self._columns[:, number].tolist()
        return PlannedFrame(
            stamp_ns=stamp,
            camera=self._cameras[camera],
            color_index=color,
            depth_index=depth,
            human_index=None if human == NO_MASK else human,
            T_world_camera=self._poses.read(row, row + 1)[0],
        )

    def add(
        self,
        camera: Camera,
        stamp_ns: Index,
        color: Index,
        depth: Index,
        masks: Mapping[int, int],
        poses: Iterable[Float64 | None],
    ) -> int:
        """Add the frames with a pose (4, 4), masks by colour number; return their number."""
        first = len(self._poses)
        is_known = np.fromiter(map(self._keep, poses), np.bool_, len(stamp_ns))
        human = np.array([masks.get(index, NO_MASK) for index in color[is_known].tolist()], dtype=np.int64)
        num = int(is_known.sum())
        fresh = np.stack(
            [
                stamp_ns[is_known],
                np.full(num, self._cameras.index(camera)),
                color[is_known],
                depth[is_known],
                human,
                first + np.arange(num),
            ]
        )
        columns = np.concatenate([self._columns, fresh], axis=1)
        self._columns = columns[:, np.lexsort((columns[2], columns[1], columns[0]))]
        return num

    def _keep(self, T: Float64 | None) -> bool:
        if T is not None:
            self._poses.append(T[None])
        return T is not None

    def uses(self) -> dict[str, Index]:
        """Number of frames that need each image."""
        by_topic: dict[str, list[Index]] = {}
        for number, camera in enumerate(self._cameras):
            of_camera = self._columns[:, self._columns[1] == number]
            for topic, row in ((camera.color_topic, 2), (camera.depth_topic, 3), (camera.human_topic, 4)):
                by_topic.setdefault(topic, []).append(of_camera[row][of_camera[row] != NO_MASK])
        return {
            topic: np.bincount(np.concatenate(indices))
            for topic, indices in by_topic.items()
            if any(map(len, indices))
        }


HELD_BYTES = 96 << 20  # of waiting images in memory; more of them wait in a file without a name
Key = tuple[str, int]  # topic, number of the message within it


class HeldMessages:
    """Messages waiting for their frame: up to half of a log that stores topics apart."""

    def __init__(self) -> None:
        self._messages: dict[Key, RawMessage] = {}
        self._places: dict[Key, tuple[int, int]] = {}  # first byte and length in the file
        self._num_bytes = 0
        self._file = tempfile.TemporaryFile(dir=str(scratch_folder()))  # noqa: SIM115
        weakref.finalize(self, self._file.close)

    def __contains__(self, key: Key) -> bool:
        return key in self._messages

    def add(self, key: Key, message: RawMessage) -> None:
        if self._num_bytes + len(message.data) > HELD_BYTES:
            first = self._file.seek(0, 2)
            self._file.write(message.data)
            self._places[key] = (first, len(message.data))
            message = replace(message, data=b"")
        self._num_bytes += len(message.data)
        self._messages[key] = message

    def get(self, key: Key) -> RawMessage:
        message, place = self._messages[key], self._places.get(key)
        if place is None:
            return message
        self._file.seek(place[0])
        return replace(message, data=self._file.read(place[1]))

    def pop(self, key: Key) -> RawMessage:
        waiting = self.get(key)
        self._num_bytes -= len(self._messages.pop(key).data)
        self._places.pop(key, None)
        if not self._places:
            self._file.seek(0)
            self._file.truncate()
        return waiting


def planned_images(
    log: RawLog, plan: FramePlan, damage: Damage, waiting: HeldMessages
) -> Iterator[tuple[PlannedFrame, list[RawMessage]]]:
    """Yield frames in plan order with colour, depth and mask messages.

    `waiting` stores messages of later frames; frames that stay incomplete are `damage`.
    """
    uses, position, num = plan.uses(), 0, len(plan)
    numbers, planned = dict.fromkeys(uses, 0), plan[0]

    def take(topic: str, number: int) -> RawMessage:
        uses[topic][number] -= 1
        return waiting.get((topic, number)) if uses[topic][number] else waiting.pop((topic, number))

    for message in log.messages(Damage(), set(uses)):  # the survey has counted this damage
        topic, number = message.topic.name, numbers[message.topic.name]
        numbers[topic] = number + 1
        if number >= len(uses[topic]) or not uses[topic][number]:
            continue
        waiting.add((topic, number), message)
        while position < num and all(key in waiting for key in planned.keys):
            yield planned, [take(*key) for key in planned.keys]
            position += 1
            if position < num:
                planned = plan[position]
    if position < num:
        damage.add(f"{log.path.name}: {num - position} frames that were there are gone: it changed while it was read")


class RosLogSource(FrameSource):
    """Records of an MCAP or ROS bag."""

    def __init__(self, log: RawLog, options: SourceOptions, joints: Sequence[str] | None = None) -> None:
        options.refuse(("root", "holdout"), "a log", log.path)
        self.name = log.path.name
        self._log = log
        self._options = options
        log_survey = survey(log, by_log_time=options.stamps == "log")
        refuse_if(
            not log_survey.num_messages and log_survey.damage.count,
            f"{log.path}: nothing usable before the damage ({''.join(log_survey.damage.notes[:1])})",
            remedy="copy the file again",
        )
        refuse_if(
            not log_survey.num_messages,
            f"{log.path}: the log holds no messages",
            remedy="record it again, or give another file",
        )
        try:
            self._rig = build_cameras(log, log_survey, options)
        except InputError as error:
            if not log_survey.damage.count:
                raise
            raise InputError(
                f"{error.message}; but the log is damaged: {log_survey.damage.notes[0]}",
                remedy=f"copy the file again; if this is all there is: {error.remedy}",
            ) from None
        self._tf = log_survey.tf
        self.tf_frames = self._tf.still_frames(self._rig[0].world_frame)
        self._loss = LossReport(
            damaged=log_survey.damage.count, notes=[*log_survey.damage.all_notes, *log_survey.tf.notes]
        )
        self.cameras = tuple(camera.name for camera in self._rig)
        self._loss.notes.extend(still_note(camera.name) for camera in self._rig if camera.fixed_pose is not None)
        self.world_frame = self._rig[0].world_frame
        loss, first_note = LossReport(), len(self._loss.notes)
        self.joint_names, self.states = joint_records(log_survey, options, loss, joints)
        self.joint_topics = JointTopics(
            topics=log_survey.select_types(*STATE_TYPES), loss=loss, first_note=first_note, chosen=options.joint_topic
        )
        self._loss = merge_joints(self._loss, loss, first_note)
        self._plan = self._plan_frames(log_survey)
        self._passes = [Damage()]  # incomplete where a pass ends early

    @property
    def loss(self) -> LossReport:
        loss, most = self._loss, max(self._passes, key=lambda one: (one.count, one.num_invalid))
        return replace(
            loss,
            damaged=loss.damaged + most.count,
            invalid_depth=most.num_invalid,
            notes=[*loss.notes, *most.all_notes],
        )

    def records(self) -> Iterator[Record]:
        return decoded(merge_by_stamp(self.states, self._frames(lazily=False)))

    def poses(self) -> Iterator[tuple[int, str, Float64]]:
        plans = map(self._plan.__getitem__, range(len(self._plan)))
        return ((planned.stamp_ns, planned.camera.name, planned.T_world_camera) for planned in plans)

    def pose_at(self, camera: str, stamp_ns: int) -> Float64 | None:
        """T_world_camera (4, 4) at a time [ns]; None if tf does not know it."""
        own = next(c for c in self._rig if c.name == camera)
        return own.pose_at(self._tf, stamp_ns, round(self._options.pose_tolerance_s * SECOND_NS))

    @cached_property
    def _digests(self) -> dict[str, str]:
        names = [file.name for file in self._log.files]
        is_unique = len(set(names)) == len(names)
        return {
            file.name if is_unique else f"{file.parent.name}/{file.name}": sha256(file) for file in self._log.files
        }

    def _plan_frames(self, log_survey: Survey) -> FramePlan:
        plan = FramePlan(self._rig)
        for camera in self._rig:
            (color, color_ns), (depth, depth_ns) = (
                self._images(log_survey, topic) for topic in (camera.color_topic, camera.depth_topic)
            )
            tolerance_ns = round(self._options.pairing_tolerance_s * SECOND_NS)
            pairs = pair_images(color_ns, depth_ns, tolerance_ns)
            if not len(pairs):
                gap = nearest_gap_ns(color_ns.tolist(), depth_ns.tolist()) / SECOND_NS
                raise InputError(
                    f"{self._log.path}: camera {camera.name}: no colour and depth image within"
                    f" {tolerance_ns / 1e6:g} ms of each other, the closest are {gap * 1e3:.4g} ms apart",
                    remedy=f"give --pairing-tolerance {gap * 1.01 + 1e-4:.3g} (seconds), if that is right",
                )
            self._loss.unpaired_color += len(color) - len(pairs)
            self._loss.unpaired_depth += len(depth) - len(pairs)
            self._add(plan, log_survey, camera, color_ns[pairs[:, 0]], color[pairs[:, 0]], depth[pairs[:, 1]])
        return plan

    def _images(self, log_survey: Survey, topic: str) -> tuple[Index, Index]:
        stamps = np.array(log_survey.topics[topic].stamps_ns, dtype=np.int64)
        refuse_if(
            len(stamps) > 1 and not stamps.any(),
            f"{self._log.path}: topic {topic}: expected stamps, got 0 in all {len(stamps)} headers",
            remedy="give --stamps log to take the times of logging",
        )
        first = first_of_each(stamps)
        num_gaps, num_images, period_ns = dropped(stamps)
        self._loss.duplicate_images += len(stamps) - len(first)
        self._loss.dropped_images += num_images
        if num_images:
            self._loss.notes.append(
                f"{topic}: about {num_images} images were dropped in {num_gaps} gaps of a period of"
                f" {period_ns / 1e6:.4g} ms"
            )
        return first, stamps[first]

    def _add(
        self, plan: FramePlan, log_survey: Survey, camera: Camera, stamp_ns: Index, color: Index, depth: Index
    ) -> None:
        tolerance_ns = round(self._options.pose_tolerance_s * SECOND_NS)
        pairing_ns = round(self._options.pairing_tolerance_s * SECOND_NS)
        masks = _mask_by_color(
            log_survey, camera.color_topic, camera.human_topic, pairing_ns, camera.name, self._loss
        )
        poses = (camera.pose_at(log_survey.tf, stamp, tolerance_ns) for stamp in map(int, stamp_ns))
        num = plan.add(camera, stamp_ns, color, depth, masks, poses)
        refuse_if(
            not num,
            f"{self._log.path}: camera {camera.name}: tf has no pose of frame {camera.frame_id!r} in"
            f" {camera.world_frame!r} at the time of any image ({_times(log_survey, camera)})",
            remedy="check the clocks of the recording, or give --camera-pose",
        )
        self._loss.without_pose += len(color) - num

    def _frames(self, *, lazily: bool = True) -> Iterator[StoredFrame]:
        lost, decoder, checked = Damage(), MessageDecoder(), set[str]()
        self._passes.append(lost)
        for planned, messages in planned_images(self._log, self._plan, lost, HeldMessages()):
            camera = planned.camera
            is_whole = not lazily or camera.name not in checked  # the first depth is looked at
            try:
                color, depth, *masks = _images(decoder, camera, messages, is_whole=is_whole)
            except UndecodableMessageError as error:
                lost.add(f"camera {camera.name} at {planned.stamp_ns} ns: {error}")
                continue
            where = f"{self._log.path}: topic {camera.human_topic}"
            human = [camera.remap(human_mask(mask.pixels, camera.intrinsics, where)) for mask in masks]
            if depth.compressed is None:
                lost.num_invalid += num_invalid(depth.pixels)
            stored = _stored_frame(planned, color, depth, human[0] if human else None, messages)
            of_depth = f"{self._log.path}: topic {camera.depth_topic}"
            if camera.name not in checked and check_depth(stored.depth, of_depth, depth.unit(camera.depth_scale)):
                checked.add(camera.name)
            yield stored


def _images(
    decoder: MessageDecoder, camera: Camera, messages: Sequence[RawMessage], *, is_whole: bool
) -> list[ImageMessage]:
    """Colour, depth and mask; is_whole: decode even what a capture can keep.

    Raises UndecodableMessageError.
    """
    is_lazy = camera.maps is None and not is_whole
    images = [
        read_image(decoder.decode(message), message.topic.type_name, lazily=lazily)
        for message, lazily in zip(messages, (is_lazy, is_lazy and camera.depth_lens is None, False), strict=False)
    ]
    for image, k in zip(images, (camera.intrinsics, (camera.depth_lens or camera).intrinsics), strict=False):
        refuse_if(
            (image.width, image.height) != (k.width, k.height),
            f"expected an image of {k.width}x{k.height}, got {image.width}x{image.height}",
            error=UndecodableMessageError,
        )
    return images


def _stored_frame(
    planned: PlannedFrame,
    color: ImageMessage,
    depth: ImageMessage,
    human: UInt8 | None,
    messages: Sequence[RawMessage],
) -> StoredFrame:
    camera = planned.camera
    is_counts = depth.is_counts and camera.depth_lens is None
    return StoredFrame(
        stamp_ns=planned.stamp_ns,
        camera=camera.name,
        intrinsics=camera.intrinsics,
        T_world_camera=planned.T_world_camera,
        read_color=lambda: camera.remap(color_of(color), cv2.INTER_LINEAR),
        read_depth=lambda: camera.depth(depth_of(depth, camera.depth_scale)),
        human=human,
        valid=camera.valid,
        color_file=color.compressed if camera.maps is None and is_kept(color.compressed) else None,
        depth_file=depth.compressed if camera.maps is None and is_counts and is_kept(depth.compressed, PNG) else None,
        depth_unit=depth.unit(camera.depth_scale) if is_counts else None,
        origin=f"{camera.color_topic}#{planned.color_index} {camera.depth_topic}#{planned.depth_index}",
        places=tuple(replace(message, data=b"") for message in messages),
    )


def _times(log_survey: Survey, camera: Camera) -> str:
    stamps = log_survey.topics[camera.color_topic].stamps_ns
    images = f"images {min(stamps) / 1e9:.3f} to {max(stamps) / 1e9:.3f} s"
    span = log_survey.tf.span_ns(camera.frame_id)
    return images if span is None else f"{images}, tf {span[0] / 1e9:.3f} to {span[1] / 1e9:.3f} s"


def _mask_by_color(
    survey: Survey, color_topic: str, mask_topic: str, tolerance_ns: int, camera: str, loss: LossReport
) -> dict[int, int]:
    if not mask_topic:
        return {}
    color_ns, mask_ns = survey.topics[color_topic].stamps_ns, survey.topics[mask_topic].stamps_ns
    pairs = dict(pair_images(color_ns, mask_ns, tolerance_ns).tolist())
    if len(pairs) < len(color_ns):
        loss.notes.append(
            f"camera {camera}: {len(color_ns) - len(pairs)} of {len(color_ns)} images have no mask on {mask_topic}"
            f" within {tolerance_ns / 1e6:g} ms"
        )
    return pairs

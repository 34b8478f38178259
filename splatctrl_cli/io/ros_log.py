"""A ROS log as records: cameras found, colour and depth paired, poses from tf, joints in one order.

Two passes: the first takes all but the images (transforms may follow the images that need them) and plans every
frame; the second takes only planned images and holds no more of them than the log's disorder demands. For `ingest`,
files that a capture can hold as they are stay undecoded.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

from splatctrl_cli.errors import InputError
from splatctrl_cli.io.decoder import MessageDecoder, UndecodableMessageError
from splatctrl_cli.io.image_rate import dropped, first_of_each
from splatctrl_cli.io.joint_topics import topics_of, with_joints
from splatctrl_cli.io.joints import joint_records
from splatctrl_cli.io.masks import human_mask, mask_by_color
from splatctrl_cli.io.messages import MILLIMETRE, ImageMessage, color_of, depth_of, num_invalid, read_image
from splatctrl_cli.io.options import SourceOptions, still_note
from splatctrl_cli.io.output import sha256
from splatctrl_cli.io.pairing import pair_by_stamp
from splatctrl_cli.io.raw_log import Damage, RawLog, RawMessage
from splatctrl_cli.io.rig import Camera, build_cameras, nearest_gap_ns
from splatctrl_cli.io.shot import Place, Shot, check_depth, is_kept, is_png, merged
from splatctrl_cli.io.survey import Survey, survey
from splatctrl_cli.records import Float32, Float64, JointState, LossReport, Record, UInt8

_SECOND = 1_000_000_000


@dataclass(frozen=True, kw_only=True)
class _Planned:
    """A frame to be: message numbers within the colour, depth and mask topics (None: no mask), and the pose."""

    stamp_ns: int
    camera: Camera
    color_index: int
    depth_index: int
    human_index: int | None
    T_world_camera: Float64


class RosLogSource:
    """Records of an MCAP, ROS 1 bag or ROS 2 bag."""

    has_clock = True

    def __init__(self, log: RawLog, options: SourceOptions, joints: Sequence[str] | None = None) -> None:
        options.refuse(("root", "holdout"), "a log", log.path)
        self.name = log.path.name
        self._log = log
        self._options = options
        found = survey(log, by_log_time=options.stamps == "log")
        _check_not_empty(log, found)
        self._loss = LossReport(damaged=found.damage.count, notes=[*found.damage.notes, *found.tf.notes])
        self._rig = build_cameras(log, found, options)
        self.cameras = tuple(camera.name for camera in self._rig)
        self._loss.notes.extend(still_note(camera.name) for camera in self._rig if camera.fixed_pose is not None)
        self.world_frame = self._rig[0].world_frame
        loss, first_note = LossReport(), len(self._loss.notes)
        self.joint_names, self._joints = joint_records(found, options, loss, joints)
        self.joint_topics = topics_of(found, loss, first_note, options)
        self._loss = with_joints(self._loss, loss, first_note)
        self._plan = self._planned(found)
        self._damage = Damage()
        self._num_invalid = 0

    @property
    def loss(self) -> LossReport:
        """What did not become records; images that do not decode are added while `records` is read."""
        loss = self._loss
        return replace(
            loss,
            damaged=loss.damaged + self._damage.count,
            invalid_depth=self._num_invalid,
            notes=[*loss.notes, *self._damage.notes],
        )

    def records(self) -> Iterator[Record]:
        """Joint states and frames by stamp."""
        for item in self._merged(lazily=False):
            yield item.frame if isinstance(item, Shot) else item

    def shots(self) -> Iterator[Shot | JointState]:
        """Joint states and shots by stamp; image files that need no change are only decoded on demand."""
        return self._merged(lazily=True)

    def _merged(self, *, lazily: bool) -> Iterator[Shot | JointState]:
        self._damage, self._num_invalid = Damage(), 0
        return merged(self._joints, self._shots(lazily=lazily))

    def poses(self) -> Iterator[tuple[int, str, Float64]]:
        """Of every planned frame."""
        return ((planned.stamp_ns, planned.camera.name, planned.T_world_camera) for planned in self._plan)

    def digests(self) -> dict[str, str]:
        """sha256 of the log's files."""
        return dict(self._digests)

    @cached_property
    def _digests(self) -> dict[str, str]:
        names = [file.name for file in self._log.files]
        is_unique = len(set(names)) == len(names)
        return {
            file.name if is_unique else f"{file.parent.name}/{file.name}": sha256(file) for file in self._log.files
        }

    def _planned(self, found: Survey) -> list[_Planned]:
        plan: list[_Planned] = []
        for camera in self._rig:
            colors, depths = self._images(found, camera.color_topic), self._images(found, camera.depth_topic)
            color_ns, depth_ns = [stamp for _, stamp in colors], [stamp for _, stamp in depths]
            tolerance_ns = round(self._options.pairing_tolerance_s * _SECOND)
            pairs = [(colors[i][0], depths[j][0]) for i, j in pair_by_stamp(color_ns, depth_ns, tolerance_ns)]
            if not pairs:
                gap = nearest_gap_ns(color_ns, depth_ns) / _SECOND
                raise InputError(
                    f"{self._log.path}: camera {camera.name}: no colour and depth image within"
                    f" {tolerance_ns / 1e6:g} ms of each other, the closest are {gap * 1e3:.4g} ms apart",
                    remedy=f"give --pairing-tolerance {gap * 1.01 + 1e-4:.3g} (seconds), if that is right",
                )
            self._loss.unpaired_color += len(color_ns) - len(pairs)
            self._loss.unpaired_depth += len(depth_ns) - len(pairs)
            plan.extend(self._with_pose(found, camera, pairs))
        return sorted(plan, key=lambda planned: (planned.stamp_ns, planned.camera.name, planned.color_index))

    def _images(self, found: Survey, topic: str) -> list[tuple[int, int]]:
        """Number and stamp of each image but those that came again; these and missing ones are counted."""
        stamps = found.topics[topic].stamps_ns
        if len(stamps) > 1 and not any(stamps):
            raise InputError(
                f"{self._log.path}: topic {topic}: expected stamps, got 0 in all {len(stamps)} headers",
                remedy="give --stamps log to take the times of logging",
            )
        kept = first_of_each(stamps)
        drops = dropped(stamps)
        self._loss.duplicate_images += len(stamps) - len(kept)
        self._loss.dropped_images += drops.num_images
        if drops.num_images:
            self._loss.notes.append(
                f"{topic}: about {drops.num_images} images were dropped in {drops.num_gaps} gaps of a period of"
                f" {drops.period_ns / 1e6:.4g} ms"
            )
        return [(index, stamps[index]) for index in kept]

    def _with_pose(self, found: Survey, camera: Camera, pairs: list[tuple[int, int]]) -> list[_Planned]:
        tolerance_ns = round(self._options.pose_tolerance_s * _SECOND)
        color_ns = found.topics[camera.color_topic].stamps_ns
        pairing_ns = round(self._options.pairing_tolerance_s * _SECOND)
        masks = mask_by_color(found, camera.color_topic, camera.human_topic, pairing_ns, camera.name, self._loss)
        planned = []
        for color_index, depth_index in pairs:
            stamp_ns = color_ns[color_index]
            T = camera.pose_at(found.tf, stamp_ns, tolerance_ns)
            if T is not None:
                planned.append(
                    _Planned(
                        stamp_ns=stamp_ns,
                        camera=camera,
                        color_index=color_index,
                        depth_index=depth_index,
                        human_index=masks.get(color_index),
                        T_world_camera=T,
                    )
                )
        if not planned:
            raise InputError(
                f"{self._log.path}: camera {camera.name}: tf has no pose of frame {camera.frame_id!r} in"
                f" {camera.world_frame!r} at the time of any image ({_times(found, camera)})",
                remedy="check the clocks of the recording, or give --camera-pose",
            )
        self._loss.without_pose += len(pairs) - len(planned)
        return planned

    def _shots(self, *, lazily: bool) -> Iterator[Shot]:
        images = _PlannedImages(self._log, self._plan)
        checked: set[str] = set()

        def decodes(camera: Camera) -> bool:
            return not lazily or camera.name not in checked  # the first depth is looked at

        for planned, (color, depth, *masks), places in images.of_frames(self._damage, decodes):
            human = self._human(planned.camera, masks[0]) if masks else None
            if not depth.is_counts:
                self._num_invalid += num_invalid(depth.pixels)
            shot = _shot(planned, color, depth, human, places)
            camera = planned.camera
            if camera.name not in checked:
                scale = _scale(depth, camera.depth_scale)
                if check_depth(shot.depth, f"{self._log.path}: topic {camera.depth_topic}", scale):
                    checked.add(camera.name)
            yield shot

    def _human(self, camera: Camera, mask: ImageMessage) -> UInt8:
        human = human_mask(mask.pixels, camera.intrinsics, f"{self._log.path}: topic {camera.human_topic}")
        return human if camera.undistortion is None else camera.undistortion.labels(human)


class _PlannedImages:
    """The second pass: brings the images of each planned frame together, in the plan's order."""

    def __init__(self, log: RawLog, plan: list[_Planned]) -> None:
        self._log = log
        self._plan = plan
        self._held: dict[tuple[str, int], RawMessage] = {}
        self._uses: dict[tuple[str, int], int] = {}
        for planned in plan:
            for key in _keys(planned):
                self._uses[key] = self._uses.get(key, 0) + 1

    def of_frames(
        self, damage: Damage, decodes: Callable[[Camera], bool]
    ) -> Iterator[tuple[_Planned, list[ImageMessage], tuple[Place, ...]]]:
        """Yield each planned frame with its colour, depth and mask, and their places; what fails goes to `damage`.

        decodes: whether all of a camera's images are decoded, and not only those that a capture cannot keep.
        """
        topics = {key[0] for key in self._uses}
        numbers = dict.fromkeys(topics, 0)
        decoder = MessageDecoder()
        position = 0
        for message in self._log.messages(Damage(), topics):  # the survey has counted this damage
            key = (message.topic.name, numbers[message.topic.name])
            numbers[message.topic.name] += 1
            if key not in self._uses:
                continue
            self._held[key] = message
            while position < len(self._plan) and all(key in self._held for key in _keys(self._plan[position])):
                planned = self._plan[position]
                position += 1
                taken = [self._take(key) for key in _keys(planned)]
                kept = (False,) * 3 if decodes(planned.camera) else _kept(planned.camera)
                try:
                    images = [
                        read_image(decoder.decode(message), message.topic.type_name, lazily=lazily)
                        for message, lazily in zip(taken, kept, strict=False)
                    ]
                    _check_sizes(planned.camera, *images[:2])
                except UndecodableMessageError as error:
                    damage.add(f"camera {planned.camera.name} at {planned.stamp_ns} ns: {error}")
                    continue
                yield planned, images, tuple(_place(message) for message in taken)

    def _take(self, key: tuple[str, int]) -> RawMessage:
        self._uses[key] -= 1
        return self._held[key] if self._uses[key] else self._held.pop(key)


def _place(message: RawMessage) -> Place:
    return Place(file=message.file, offset=message.offset, log_time_ns=message.log_time_ns)


def _keys(planned: _Planned) -> list[tuple[str, int]]:
    camera = planned.camera
    keys = [(camera.color_topic, planned.color_index), (camera.depth_topic, planned.depth_index)]
    return keys if planned.human_index is None else [*keys, (camera.human_topic, planned.human_index)]


def _kept(camera: Camera) -> tuple[bool, bool, bool]:
    """Whether image files of colour, depth and masks go into a capture as they are."""
    is_plain = camera.undistortion is None
    return is_plain, is_plain and camera.depth_to_color is None, False


def _check_sizes(camera: Camera, color: ImageMessage, depth: ImageMessage) -> None:
    """Raise UndecodableMessageError for images of another size than the camera's."""
    registration = camera.depth_to_color
    for image, lens in (
        (color, camera.intrinsics),
        (depth, camera.intrinsics if registration is None else registration.depth_intrinsics),
    ):
        if (image.width, image.height) != (lens.width, lens.height):
            raise UndecodableMessageError(
                f"expected an image of {lens.width}x{lens.height}, got {image.width}x{image.height}"
            )


def _shot(
    planned: _Planned, color: ImageMessage, depth: ImageMessage, human: UInt8 | None, places: tuple[Place, ...]
) -> Shot:
    camera = planned.camera
    is_counts = depth.is_counts and camera.depth_to_color is None
    keeps_color, keeps_depth, _ = _kept(camera)
    return Shot(
        stamp_ns=planned.stamp_ns,
        camera=camera.name,
        intrinsics=camera.intrinsics,
        T_world_camera=planned.T_world_camera,
        read_color=partial(_color, camera, color),
        read_depth=partial(_depth, camera, depth),
        human=human,
        valid=None if camera.undistortion is None else camera.undistortion.valid,
        color_file=color.compressed if keeps_color and is_kept(color.compressed) else None,
        depth_file=depth.compressed if keeps_depth and depth.is_counts and is_png(depth.compressed) else None,
        depth_unit=_scale(depth, camera.depth_scale) if is_counts else None,
        origin=f"{camera.color_topic}#{planned.color_index} {camera.depth_topic}#{planned.depth_index}",
        places=places,
    )


def _color(camera: Camera, image: ImageMessage) -> UInt8:
    pixels = color_of(image)
    return pixels if camera.undistortion is None else camera.undistortion.color(pixels)


def _depth(camera: Camera, image: ImageMessage) -> Float32:
    metres = depth_of(image, camera.depth_scale)
    if camera.depth_to_color is not None:
        return camera.depth_to_color.warp(metres)
    return metres if camera.undistortion is None else camera.undistortion.depth(metres)


def _scale(depth: ImageMessage, scale: float | None) -> float:
    if scale is not None:
        return scale
    return MILLIMETRE if depth.is_counts else 1.0


def _check_not_empty(log: RawLog, found: Survey) -> None:
    if found.num_messages:
        return
    if found.damage.count:
        raise InputError(
            f"{log.path}: nothing usable before the damage ({found.damage.notes[0]})", remedy="copy the file again"
        )
    raise InputError(f"{log.path}: the log holds no messages", remedy="record it again, or give another file")


def _times(found: Survey, camera: Camera) -> str:
    stamps = found.topics[camera.color_topic].stamps_ns
    images = f"images {min(stamps) / 1e9:.3f} to {max(stamps) / 1e9:.3f} s"
    span = found.tf.span_ns(camera.frame_id)
    return images if span is None else f"{images}, tf {span[0] / 1e9:.3f} to {span[1] / 1e9:.3f} s"

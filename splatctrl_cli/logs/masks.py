"""Masks that say which pixels show a person: an image topic or files beside the colour images."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.decoder import COMPRESSED_IMAGE, IMAGE
from splatctrl_cli.logs.pairing import pair_by_stamp
from splatctrl_cli.logs.survey import Survey
from splatctrl_cli.records import Intrinsics, LossReport, UInt8


def human_mask(pixels: NDArray[Any], camera: Intrinsics, where: str) -> UInt8:
    """(H, W) uint8, 1 where an image file or message is not 0. Raises InputError unless 8-bit grey, (H, W)."""
    if pixels.dtype != np.uint8 or pixels.shape != (camera.height, camera.width):
        size = "x".join(map(str, reversed(pixels.shape[:2])))
        channels = pixels.shape[2] if pixels.ndim == 3 else 1
        raise InputError(
            f"{where}: expected an 8-bit grey mask of {camera.width}x{camera.height}, as the colour images,"
            f" got {size} of {channels} channel(s), {pixels.dtype}",
            remedy="write 0 where there is no person, anything else where there is one",
        )
    return np.asarray(pixels != 0, np.uint8)


def check_mask_topics(path: Path, survey: Survey, topics: Mapping[str, str], cameras: tuple[str, ...]) -> None:
    """Raise InputError where a mask topic, by camera name, is for no camera or holds no grey images."""
    grey = [
        topic.topic.name
        for topic in survey.of_type(IMAGE, COMPRESSED_IMAGE)
        if topic.first_image is not None and topic.first_image.is_gray
    ]
    for camera, topic in topics.items():
        if camera not in cameras:
            raise InputError(
                f"{path}: --human-topic {camera}={topic}: no camera {camera!r}",
                remedy=f"use one of: {', '.join(cameras)}",
            )
        if topic not in grey:
            raise InputError(
                f"{path}: --human-topic {camera}={topic}: no mono8 or 8UC1 images on that topic",
                remedy=f"grey topics there: {', '.join(grey) or 'none'}",
            )


def mask_by_color(
    survey: Survey, color_topic: str, mask_topic: str, tolerance_ns: int, camera: str, loss: LossReport
) -> dict[int, int]:
    """Mask number by colour number, the closest stamps paired; images without a mask are noted in `loss`."""
    if not mask_topic:
        return {}
    color_ns, mask_ns = survey.topics[color_topic].stamps_ns, survey.topics[mask_topic].stamps_ns
    pairs = dict(pair_by_stamp(color_ns, mask_ns, tolerance_ns))
    if len(pairs) < len(color_ns):
        loss.notes.append(
            f"camera {camera}: {len(color_ns) - len(pairs)} of {len(color_ns)} images have no mask on {mask_topic}"
            f" within {tolerance_ns / 1e6:g} ms"
        )
    return pairs

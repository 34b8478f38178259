"""The image kind in a topic's name: 16-bit infrared has the encoding of depth.

Drivers: /ir (Azure Kinect, Orbbec), /infra1 (RealSense), image_ir (Kinect 2), confidence (ZED, L515), amplitude and
noise (time of flight), aux (MultiSense), signal, reflec and nearir (Ouster).
"""

import re

DEPTH = "depth"
_COLORS = frozenset({"color", "colour", "rgb", "bgr"})
_OTHERS = frozenset(
    {
        *("ir", "infra", "infrared", "nir", "nearir", "swir", "lwir", "thermal", "aux", "mono", "gray", "grey"),
        *(
            "amplitude",
            "amplitudes",
            "amp",
            "intensity",
            "intensities",
            "reflectivity",
            "reflec",
            "signal",
            "ambient",
        ),
        *("confidence", "conf", "uncertainty", "variance", "noise", "disparity", "disparities"),
        *("mask", "label", "labels", "segmentation", "semantic", "instance"),
    }
)
_WORDS = _OTHERS | _COLORS | {DEPTH}
_CAMERAS = frozenset({"camera", "cam"})  # words of parts that name a device, which may give more than depth


def word_of(parts: tuple[str, ...], *, is_device: bool = True) -> str:
    """The kind word in a topic's last part that has one; "" if none.

    In ``a_to_b`` the first counts: ``aligned_depth_to_infra1`` is depth. is_device: parts such as ``depth_camera``
    count too.
    """
    for part in reversed(parts):
        words = re.findall("[a-z]+", part.lower())
        words = words[: words.index("to")] if "to" in words[1:] else words
        found = [word for word in words if word in _WORDS or word.removesuffix("map") == DEPTH]
        if found and (is_device or _CAMERAS.isdisjoint(words)):
            return DEPTH if found[-1].startswith(DEPTH) else found[-1]
    return ""


def is_other(word: str) -> bool:
    """True if 16-bit images so named are not depth."""
    return word in _OTHERS

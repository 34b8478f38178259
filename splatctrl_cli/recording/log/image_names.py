"""What the name of an image topic says of its images: infrared of sixteen bits is as depth by its encoding alone.

Names are those of drivers: /ir (Azure Kinect, Orbbec), /infra1 (RealSense), image_ir (Kinect 2), confidence (ZED,
L515), amplitude and noise (time of flight), aux (MultiSense), signal, reflec and nearir (Ouster).
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
    """The word that says what images hold, of the last part of a topic that has one; "" where none has.

    ``aligned_depth_to_infra1`` is depth: of ``a_to_b`` the first counts. is_device: parts such as ``depth_camera``
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
    """Whether images of sixteen bits under this word are no depth."""
    return word in _OTHERS

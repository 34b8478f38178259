"""Images, depth and lenses of other drivers.

A box stands before a wall. Each image is rendered ray by ray through the lens that its driver had, and what comes out
must be a pinhole's image of the same box.
"""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from splatctrl_cli.records import Float64, RgbdFrame
from tests.cases.case import Case, Run, expect_result
from tests.recording.log.make_log import START_NS, camera_info, encoded, frames_of, image, write_raw

WIDTH, HEIGHT = 64, 48

BARREL = (-0.25, 0.06, 0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class Lens:
    """What a CameraInfo says (model, D, K and P by their focal lengths [px]) of images that `bends` really bends."""

    focal: float = 45.0
    model: str = "plumb_bob"
    D: Sequence[float] = ()
    bends: tuple[str, Sequence[float]] = ("plumb_bob", ())

    @property
    def K(self) -> Float64:
        return np.array([[self.focal, 0, 31.5], [0, self.focal, 23.5], [0, 0, 1]])

    def info(self, stamp: int) -> Any:
        said = {"distortion_model": self.model, "d": self.D, "p": self.K @ np.eye(3, 4)}
        return camera_info(stamp, "optical", (WIDTH, HEIGHT), (self.focal, self.focal, 31.5, 23.5), **said)

    def slopes(self) -> Float64:
        """x / z of each pixel of the image's middle row."""
        pixels = np.stack([np.arange(WIDTH, dtype=np.float64), np.full(WIDTH, 23.5)], axis=1)[:, None]
        model, D = self.bends
        if model == "equidistant":
            return np.tan((pixels[:, 0, 0] - 31.5) / self.focal)
        return np.asarray(cv2.undistortPoints(pixels, self.K, np.array([*D, 0, 0, 0, 0][:5]))[:, 0, 0])


@dataclass(frozen=True, kw_only=True)
class Box:
    """Where it stands in the camera [m]."""

    left: float
    right: float
    near: float
    wall: float

    def seen(self, lens: Lens) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        """Colour (H, W, 3) and depth (H, W) [mm]: the same in each row."""
        x = lens.slopes() * self.near
        is_box = (x >= self.left) & (x <= self.right)
        depth = np.where(is_box, 1000 * self.near, 1000 * self.wall).astype(np.uint16)
        shade = np.where(is_box, 230, 110 + np.arange(WIDTH) % 7).astype(np.uint8)
        return np.tile(shade[None, :, None], (HEIGHT, 1, 3)), np.tile(depth, (HEIGHT, 1))


BESIDE = Box(left=-0.49, right=-0.40, near=0.9, wall=1.2)

AT_EDGE = Box(left=0.5, right=0.65, near=0.45, wall=0.6)


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """A log of one camera. further: topics of more colour images, as the color topic's."""

    box: Box = BESIDE
    color: Lens = field(default_factory=Lens)
    depth: Lens | None = None
    color_topic: str = "/cam/color/image_raw"
    depth_topic: str = "/cam/depth/image_raw"
    further: Mapping[str, Lens] = field(default_factory=dict)

    def __call__(self, folder: Path) -> None:
        messages = []
        images = [(self.color_topic, self.color, 0), (self.depth_topic, self.depth or self.color, 1)]
        images += [(topic, lens, 0) for topic, lens in self.further.items()]
        infos = {topic.rpartition("/")[0]: lens for topic, lens, _ in reversed(images)}
        for index in range(4):
            stamp = START_NS + index * 100_000_000
            for topic, lens, kind in images:
                pixels = self.box.seen(lens)[kind]
                pixels[0, index % WIDTH] = 0
                messages.append(encoded(stamp, topic, image(stamp, "optical", ("rgb8", "16UC1")[kind], pixels)))
            messages += [encoded(stamp, f"{at}/camera_info", lens.info(stamp)) for at, lens in infos.items()]
        write_raw(folder / "log.mcap", messages)


def box_x(frame: RgbdFrame, near: float) -> tuple[float, float]:
    """Least and largest x [m] of what the middle row shows nearest to the wall's left or right box."""
    row, k = frame.depth[HEIGHT // 2], frame.intrinsics
    columns = np.flatnonzero(np.abs(row - near) < 0.02)
    low, high = (np.concatenate([columns[:1] - 0.5, columns[-1:] + 0.5]) - k.cx) / k.fx * near
    return float(low), float(high)


def ingested(folder: Path, out: Path, run: Run, *options: str) -> RgbdFrame:
    """The first frame of the log in a folder, as `ingest` keeps it."""
    log = next(folder.glob("*.mcap"))
    poses = ["--camera-pose", "cam=identity"] if log.name == "log.mcap" else []
    expect_result(run, ["ingest", log, "-o", out / "capture", "--force", *poses, *options])
    return frames_of(out / "capture")[0]


def at(left: float, right: float, near: float, within: float) -> Callable[[Path, Path, Run], None]:
    """The box's borders [m] are where they should be: a pixel's width may be missing."""

    def examine(folder: Path, out: Path, run: Run) -> None:
        np.testing.assert_allclose(box_x(ingested(folder, out, run), near), (left, right), rtol=0, atol=within)

    return examine


def both_at_the_box(folder: Path, out: Path, run: Run) -> None:
    """Colour and depth show it in the same columns."""
    frame = ingested(folder, out, run)
    is_near = np.abs(frame.depth[HEIGHT // 2] - 0.9) < 0.02
    is_bright = frame.color[HEIGHT // 2, :, 0] > 170
    assert is_near[:20].any() and np.count_nonzero(is_near[:20] != is_bright[:20]) <= 2
    assert -0.52 < (np.flatnonzero(is_near[:20])[0] - 31.5) / 45 * 0.9 < -0.46


def one_or_the_other(folder: Path, out: Path, run: Run) -> None:
    """Name and distortion contradict: refused with both remedies, each of which gives what it says."""
    named("says rectified", "/cam/color/camera_info")(folder, out, run)
    words = ["ingest", next(folder.glob("*.mcap")), "-o", out / "no", "--camera-pose", "cam=identity"]
    flat, bent = re.findall(r"--intrinsics (cam=[-\d.,e]+)", run(words).text)
    plain = box_x(ingested(folder, out, run, "--intrinsics", flat.rstrip(",")), 0.9)
    undone = box_x(ingested(folder, out, run, "--intrinsics", bent), 0.9)
    assert plain[0] > undone[0] + 0.03 and abs(undone[0] + 0.49) < 0.02


def named(*words: str) -> Callable[[Path, Path, Run], None]:
    """Refused, with these words, by `ingest` and `check` alike."""

    def examine(folder: Path, out: Path, run: Run) -> None:
        log = next(folder.glob("*.mcap"))
        for command in (["ingest", log, "-o", out / "no"], ["check", log]):
            result = run([*command, "--camera-pose", "cam=identity"])
            assert result.code not in (0, 70), result.text
            assert all(word in result.text for word in words), result.text

    return examine


def write_transforms(**lens: Any) -> Callable[[Path], None]:
    """A nerfstudio folder whose images come from a lens of 30 px by the angle."""

    def make(folder: Path) -> None:
        color, depth = AT_EDGE.seen(Lens(focal=30.0, bends=("equidistant", ())))
        frames = []
        for index in range(3):
            cv2.imwrite(str(folder / f"c{index}.png"), color)
            cv2.imwrite(str(folder / f"d{index}.png"), depth)
            pose = np.diag([1.0, -1.0, -1.0, 1.0])
            pose[0, 3] = 0.01 * index
            frames.append(
                {"file_path": f"c{index}.png", "depth_file_path": f"d{index}.png", "transform_matrix": pose.tolist()}
            )
        head = {"w": WIDTH, "h": HEIGHT, "fl_x": 30, "fl_y": 30, "cx": 32, "cy": 24, **lens}
        (folder / "transforms.json").write_text(json.dumps({**head, "frames": frames}))

    return make


def folder_at_edge(folder: Path, out: Path, run: Run) -> None:
    """The box of a folder is where it stands."""
    expect_result(run, ["ingest", folder, "-o", out / "capture"])
    np.testing.assert_allclose(box_x(frames_of(out / "capture")[0], 0.45), (0.5, 0.65), rtol=0, atol=0.03)


def folder_refused(*words: str) -> Callable[[Path, Path, Run], None]:
    """Refused by name."""
    return lambda folder, out, run: expect_result(run, ["ingest", folder, "-o", out / "capture"], *words, code=4)


ANGLES = Lens(focal=30.0, model="equidistant", D=(0.0, 0.0, 0.0, 0.0), bends=("equidistant", ()))

BENT = Lens(D=BARREL, bends=("plumb_bob", BARREL))

FLAT = Lens()

CASES: tuple[Case, ...] = (
    Case(
        name="01-equidistant-zero", make=Drawn(box=AT_EDGE, color=ANGLES), examine=at(0.5, 0.65, 0.45, 0.03),
        has_shared=True,
    ),
    Case(
        name="equidistant-zero-in-transforms", make=write_transforms(camera_model="OPENCV_FISHEYE"),
        examine=folder_at_edge,
    ),
    Case(name="is-fisheye-without-coefficients", make=write_transforms(is_fisheye=True), examine=folder_at_edge),
    Case(
        name="is-fisheye-against-the-model", make=write_transforms(is_fisheye=True, camera_model="OPENCV"),
        examine=folder_refused("camera_model is OPENCV", "is_fisheye is True"),
    ),
    Case(
        name="two-units-of-depth-in-transforms",
        make=write_transforms(depth_unit_scale_factor=0.001, integer_depth_scale=0.0002),
        examine=folder_refused("depth_unit_scale_factor = 0.001 and integer_depth_scale = 0.0002 differ"),
    ),
    Case(
        name="a-pinhole-with-coefficients", make=write_transforms(camera_model="PINHOLE", k1=-0.2),
        examine=folder_refused("camera_model PINHOLE", "k1"),
    ),
    Case(
        name="fisheye-under-another-name",
        make=Drawn(box=AT_EDGE, color=replace(ANGLES, model="Kannala_Brandt")),
        examine=at(0.5, 0.65, 0.45, 0.03),
    ),
    Case(
        name="equidistant-with-five-coefficients",
        make=Drawn(box=AT_EDGE, color=Lens(focal=30.0, model="equidistant", D=(*BARREL[:4], 0.01))),
        examine=named("equidistant", "expected 4"),
    ),
    Case(
        name="unknown-model-with-zeros", make=Drawn(color=Lens(model="ftheta", D=(0.0,) * 5)),
        examine=named("'ftheta' is unknown"),
    ),
    Case(name="no-model-and-no-coefficients", make=Drawn(color=Lens(model="")), examine=both_at_the_box),
    Case(
        name="12-depth-rectified-colour-not", make=Drawn(color=BENT, depth=FLAT), examine=both_at_the_box,
        has_shared=True,
    ),
    Case(name="depth-distorted-colour-not", make=Drawn(color=FLAT, depth=BENT), examine=both_at_the_box),
    Case(
        name="13-rect-topic-with-distortion", make=Drawn(color=BENT, color_topic="/cam/color/image_rect_raw"),
        examine=both_at_the_box, has_shared=True,
    ),
    Case(
        name="rectified-by-name-alone", make=Drawn(color=BENT, color_topic="/cam/color/image_rect_color"),
        examine=one_or_the_other,
    ),
    Case(
        name="rectified-beside-raw",
        make=Drawn(
            color=Lens(D=BARREL, bends=("rectified", ())), depth=FLAT, color_topic="/cam/color/image_rect_color",
            further={"/cam/color/image_raw": BENT},
        ),
        examine=both_at_the_box,
    ),
)  # fmt: skip

"""Image folders described by a TOML file, of one camera or several: built here, and those of docs/examples."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from splatctrl_cli.errors import UsageError
from splatctrl_cli.geometry import back_project, invert_transform, look_at, project, transform_points
from splatctrl_cli.recording.capture.capture_writer import write_capture
from splatctrl_cli.recording.folder.image_folder import open_image_folder
from splatctrl_cli.recording.source import SourceOptions, open_source
from tests.cli.test_reconstruct import write_folder
from tests.recording.log.make_log import frames_of
from tests.refused import expect_refusal
from tests.scene.wall import frame

EXAMPLES = Path(__file__).parents[3] / "docs" / "examples"

CAMERA = "[camera]\nwidth = 8\nheight = 6\nfx = 10\nfy = 10\ncx = 4.0\ncy = 3.0\n"

FRAMES = '[frames]\ncolor = "rgb/*.png"\ndepth = "depth/*.png"\n'

POSE = look_at([0.5, 0.2, 1.0], [0.0, 0.0, 0.0])


def make_folder(root: Path, names: tuple[str, ...] = ("7", "8", "12"), counts: int = 10000) -> None:
    for kind in ("rgb", "depth"):
        (root / kind).mkdir(parents=True)
    for name in names:
        cv2.imwrite(str(root / f"rgb/{name}.png"), np.full((6, 8, 3), int(float(name)) % 200, np.uint8))
        cv2.imwrite(str(root / f"depth/{name}.png"), np.full((6, 8), counts, np.uint16))


def write_log(path: Path, matrix: np.ndarray[tuple[int, int], np.dtype[np.float64]]) -> None:
    """The pose of views 7, 8 and 12."""
    rows = "\n".join(" ".join(repr(float(v)) for v in row) for row in matrix)
    path.write_text("".join(f"{number} {number} {number + 1}\n{rows}\n" for number in (7, 8, 12)))


def described(
    tmp_path: Path, extra: str = "", poses: str = '[poses]\nformat = "trajectory-log"\nfile = "t.log"\n'
) -> Path:
    make_folder(tmp_path / "images")
    write_log(tmp_path / "images/t.log", POSE)
    path = tmp_path / "folder.toml"
    path.write_text(f'root = "images"\n{CAMERA}{FRAMES}[depth]\nscale = 1e-4\n{poses}{extra}')
    return path


def replaced(path: Path, old: str, new: str) -> Path:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    return path


def test_frames_come_in_order_with_their_own_pose_depth_and_no_clock(tmp_path: Path) -> None:
    path = replaced(described(tmp_path), "cy = 3.0\n", "cy = 3.0\npixel_center = 0.5\n")
    source = open_source(path)
    frames = frames_of(source)
    assert [int(frame.color[0, 0, 0]) for frame in frames] == [12, 7, 8]  # by the text that * stood for
    assert all(frame.depth == pytest.approx(1.0) for frame in frames)
    assert frames[0].T_world_camera == pytest.approx(POSE, abs=1e-12)
    assert (frames[0].intrinsics.cx, frames[0].intrinsics.cy) == (3.5, 2.5), "pixel centres at a half"
    path.write_text(f"{path.read_text()}[stamps]\nrate = 10\n")
    rated = open_source(path)
    assert [frame.stamp_ns for frame in rated.records()] == [700_000_000, 800_000_000, 1_200_000_000]
    assert (source.has_clock, rated.has_clock, source.joint_names) == (False, True, ())


@pytest.mark.parametrize("entry", ["8", "2"])
def test_held_out_frames_belong_to_another_camera(tmp_path: Path, entry: str) -> None:
    path, both = described(tmp_path), ["camera", "camera", "holdout"]  # name 8 is at position 2
    for cameras, expected in ((None, both), (("camera",), both[:2])):
        found = frames_of(path, SourceOptions(holdout=(entry,), cameras=cameras))
        assert [frame.camera for frame in found] == expected
    said = "--holdout: all 3 views are held out; leave some"
    expect_refusal(said, open_source, path, SourceOptions(holdout=("0", "1", "2")), error=UsageError)


def test_world_to_camera_and_opengl_poses_are_the_same_camera(tmp_path: Path) -> None:
    opengl = POSE @ np.diag([1.0, -1.0, -1.0, 1.0])
    poses = '[poses]\nformat = "trajectory-log"\nfile = "t.log"\naxes = "opengl"\nconvention = "world_to_camera"\n'
    path = described(tmp_path, poses=poses)
    write_log(tmp_path / "images/t.log", invert_transform(opengl))
    assert frames_of(path)[0].T_world_camera == pytest.approx(POSE, abs=1e-12)
    write_log(tmp_path / "images/t.log", np.diag([2.0, 2.0, 2.0, 1.0]))
    expect_refusal("expected a rigid transform", open_source, path)
    (tmp_path / "images/t.log").unlink()
    expect_refusal("t.log: No such file", open_source, path)
    expect_refusal("no such folder", open_source, path, SourceOptions(root=tmp_path / "elsewhere"))


def test_tum_poses_are_matched_by_the_stamps_in_file_names(tmp_path: Path) -> None:
    make_folder(tmp_path / "images", ("100.25", "100.75", "109.5"))
    (tmp_path / "images/gt.txt").write_text("# stamp\n100.251 1 2 3 0 0 0 1\n100.749 4 5 6 0 0 0 1\n")
    path = tmp_path / "folder.toml"
    poses = '[poses]\nformat = "tum"\nfile = "gt.txt"\n[stamps]\nnames = true\n'
    path.write_text(f'root = "images"\n{CAMERA}{FRAMES}[depth]\nscale = 1e-4\n{poses}')
    source = open_source(path)
    frames = frames_of(source)
    stamps = [frame.stamp_ns for frame in frames]
    assert (stamps, source.loss.without_pose) == ([100_250_000_000, 100_750_000_000], 1)
    assert frames[1].T_world_camera[:3, 3] == pytest.approx([4, 5, 6])


@pytest.mark.parametrize("suffix", ["npy", "tiff", "png"])
def test_float_depth_files_are_read_in_their_unit_and_rotated_counts_turned_back(tmp_path: Path, suffix: str) -> None:
    encoding = "uint16-rotated3" if suffix == "png" else "float32"
    path = replaced(described(tmp_path), "[depth]\n", f'[depth]\nencoding = "{encoding}"\n')
    replaced(path, "depth/*.png", f"depth/*.{suffix}")
    values = np.full((6, 8), 12345.6, np.float32)
    values[0, 0], values[0, 1] = np.nan, -1.0
    rotated = np.full((6, 8), ((8000 << 3) | (8000 >> 13)) & 0xFFFF, np.uint16)
    for name in ("7", "8", "12"):
        file = tmp_path / f"images/depth/{name}.{suffix}"
        if suffix == "npy":
            np.save(file, values)
        else:
            cv2.imwrite(str(file), rotated if suffix == "png" else values)
    source = open_source(path)
    depth = frames_of(source)[0].depth
    if suffix == "png":
        assert depth == pytest.approx(0.8)
    else:
        lost = depth[0, :2].tolist(), source.loss.invalid_depth
        assert (lost, depth[1, 1]) == (([0, 0], 6), np.float32(12345.6) * np.float32(1e-4))


def test_matrix_files_are_matched_by_name(tmp_path: Path) -> None:
    path = described(tmp_path, poses='[poses]\nformat = "matrix-files"\nfile = "pose/*.txt"\n')
    (tmp_path / "images/pose").mkdir()
    np.savetxt(tmp_path / "images/pose/8.txt", POSE)
    source = open_source(path)
    assert ([int(frame.color[0, 0, 0]) for frame in frames_of(source)], source.loss.without_pose) == ([8], 2)


@pytest.mark.parametrize(
    ("name", "content", "lost", "notes"),
    [
        ("depth/8.png", None, (1, 0), []),
        ("rgb/8.png", b"\x89PNG nonsense", (0, 1), ["8.png: not an image that can be read"]),
    ],
)
def test_an_image_without_partner_or_whose_file_is_broken_is_counted(
    tmp_path: Path, name: str, content: bytes | None, lost: tuple[int, int], notes: list[str]
) -> None:
    path, file = described(tmp_path), tmp_path / "images" / name
    file.unlink()
    if content is not None:
        file.write_bytes(content)
    source = open_source(path)
    assert (len(list(source.records())), source.loss.unpaired_color, source.loss.damaged) == (2, *lost)
    assert [note.rpartition("/")[2] for note in source.loss.notes] == notes


MATRIX = CAMERA.replace("[camera]", "[depth_camera]") + "depth_to_color = "


@pytest.mark.parametrize(
    ("good", "bad", "said"),
    [
        (FRAMES, f"{FRAMES}[stamps]\nrat = 3\n", "unknown key stamps.rat; did you mean stamps.rate?"),
        (
            FRAMES,
            f"{FRAMES}[split]\nholdout = [7, 8, 12]\n",
            "[split] holds all 3 views out; leave some to train with",
        ),
        ("fx = 10\n", "", "camera.fx is missing"),
        ('"images"', '"~nobody-of-that-name/x"', "root: no home folder of ~nobody-of-that-name/x"),
        (FRAMES, "", "[frames] is missing"),
        ("trajectory-log", "trajectory", "poses.format: expected one of matrix-blocks"),
        ("width = 8", 'width = "8"', "camera.width: expected int, got '8'"),
        ("width = 8", "width = 16", "expected 16x6 as described, got 8x6"),
        ("fx = 10", "fx = -10", "camera.fx: expected a positive number of pixels"),
        ("width = 8", "width = 0", "camera.width: expected a positive number of pixels"),
        ("cy = 3.0", 'cy = 3.0\ndistortion_model = "fish"', "camera.distortion_model: expected one of plumb_bob"),
        ("scale = 1e-4", "scale = -1.0", "depth.scale: expected metres per count"),
        (FRAMES, f"{FRAMES}{MATRIX}[[1, 0], [0, 1]]\n", "depth_camera.depth_to_color: expected a"),
        (FRAMES, f"{FRAMES}{MATRIX}[[1, 0, 0], [0]]\n", "depth_camera.depth_to_color: expected a"),
        (FRAMES, f"{FRAMES}{MATRIX}{(2 * np.eye(4)).tolist()}\n", "depth_camera.depth_to_color: expected a"),
        ("scale = 1e-4", "scale = 1.0", "median depth 1e+04 m is implausible"),
        ('name = "b"', 'name = "a"', "a name for each of its own"),
        ('name = "b"\n', "", "a name for each of its own"),
        ('color = "b-*.png"\n', "", "color is missing"),
        ("[stamps]", '[frames]\ncolor = "*"\ndepth = "*"\n[stamps]', "leave the single tables out"),
        ("[[cameras]]", "[cameras]", "expected tables|TOML|Cannot"),
        ("height = 60\n", "heigth = 60\n", "did you mean camera.height"),
    ],
)
def test_a_description_that_cannot_be_meant_is_refused(
    tmp_path: Path, rig: Path, good: str, bad: str, said: str
) -> None:
    path = described(tmp_path / "one")
    message = expect_refusal(said, frames_of, replaced(path if good in path.read_text() else rig, good, bad))
    assert ("--depth-scale" in message) == ("implausible" in said)


REAL = [  # example, its folder, frames, held out, bound on the median |dz| between the first two views [m]
    ("apc_shelf", "apc_shelf/scene-0000", 12, 2, 0.005),
    ("apc_shelf_raw", "apc_shelf/scene-0000", 12, 2, 0.006),
    ("open3d_rgbd", "open3d_rgbd/RGBD", 5, 1, 0.006),
    ("livingroom1", "open3d_rgbd/livingroom1", 31, 2, 0.0015),
    ("tabletop_views", "tabletop_views", 12, 1, 0.0012),
]


@pytest.mark.parametrize(("example", "folder", "num_frames", "num_held", "agreement"), REAL)
def test_real_folders_open_and_their_views_agree(
    real_data: Path, example: str, folder: str, num_frames: int, num_held: int, agreement: float
) -> None:
    source = open_source(EXAMPLES / f"{example}.toml", SourceOptions(root=real_data / folder))
    frames = frames_of(source)
    assert (len(frames), sum(frame.camera == "holdout" for frame in frames)) == (num_frames, num_held)
    assert vars(source.loss) == vars(type(source.loss)())
    views = sorted(frames, key=lambda frame: frame.stamp_ns)
    first, second = [view for view in views if view.camera == "camera"][:2]
    points = back_project(first.intrinsics, first.depth)[first.depth > 0]
    seen = transform_points(invert_transform(second.T_world_camera) @ first.T_world_camera, points)
    pixels = np.round(project(second.intrinsics, seen)).astype(int)
    inside = (pixels >= 0).all(axis=1) & (pixels < [second.intrinsics.width, second.intrinsics.height]).all(axis=1)
    measured = second.depth[pixels[inside, 1], pixels[inside, 0]]
    difference = np.abs(measured - seen[inside, 2])[measured > 0]
    assert len(difference) > 10_000 and np.median(difference) < agreement


def with_masks(tmp_path: Path, names: tuple[str, ...], mask: np.ndarray[tuple[int, ...], np.dtype[np.uint8]]) -> Path:
    depth = 'depth = "depth/*.png"'
    path = replaced(described(tmp_path), depth, f'{depth}\nhuman_mask = "who/*.png"')
    (tmp_path / "images/who").mkdir()
    for name in names:
        cv2.imwrite(str(tmp_path / f"images/who/{name}.png"), mask)
    return path


def test_masks_go_with_the_colour_image_of_the_same_name(tmp_path: Path) -> None:
    mask = np.zeros((6, 8), np.uint8)
    mask[2:4, 5] = 9
    source = open_source(with_masks(tmp_path, ("7", "12"), mask))
    found = {int(frame.color[0, 0, 0]): frame.human for frame in frames_of(source)}
    assert found[8] is None and np.array_equal([found[7], found[12]], [mask > 0] * 2)
    assert source.loss.notes == ["1 of 3 colour images have no mask"] and "who/7.png" in source.digests()
    said = "expected an 8-bit grey mask of 8x6, as the colour images, got 9x6"
    expect_refusal(said, frames_of, with_masks(tmp_path / "a", ("7",), np.zeros((6, 9), np.uint8)))
    expect_refusal("is named like a colour image", frames_of, with_masks(tmp_path / "b", ("99",), mask))


@pytest.mark.parametrize("change", ["", 'encoding = "uint16-rotated3"', "invalid = 10000"])
def test_png_depth_goes_into_a_capture_as_it_is_unless_its_counts_change(tmp_path: Path, change: str) -> None:
    path = described(tmp_path)
    path.write_text(path.read_text().replace("scale = 1e-4\n", f"scale = 1e-4\n{change}\n"))
    recorded = []
    for number, file in enumerate(sorted((tmp_path / "images/depth").iterdir())):
        pixels = np.full((6, 8), 10000 + number, np.uint16)
        pixels[0] = 8000
        cv2.imwrite(str(file), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9])  # not as a capture writes them
        recorded.append(file.read_bytes())
    write_capture(tmp_path / "x.capture", open_source(path))
    kept = [file.read_bytes() for file in sorted((tmp_path / "x.capture/depth").rglob("*.png"))]
    assert len(kept) == 3 and (sorted(kept) == sorted(recorded)) == (not change)
    of_folder, of_capture = (frames_of(open_source(p)) for p in (path, tmp_path / "x.capture"))
    assert all(np.array_equal(a.depth, b.depth) for a, b in zip(of_folder, of_capture, strict=True))


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """Two cameras, two views each, at 5 Hz."""
    views = [frame(x=x, camera=camera) for camera, xs in (("a", (0.0, 0.1)), ("b", (0.2, 0.3))) for x in xs]
    return write_folder(tmp_path / "in", views)


def test_each_camera_has_its_own_files_and_poses_by_stamp(rig: Path) -> None:
    source = open_image_folder(rig, SourceOptions())
    found = frames_of(source)
    assert [(f.camera, f.stamp_ns) for f in found] == [("a", 0), ("b", 0), ("a", 200_000_000), ("b", 200_000_000)]
    assert [f.T_world_camera[0, 3] for f in found] == [0.0, 0.2, 0.1, 0.3]
    assert [pose[:2] for pose in source.poses()] == [(f.stamp_ns, f.camera) for f in found]
    assert source.has_clock and len(source.digests()) == 1 + 3 * len(found)
    assert {f.camera for f in frames_of(rig, SourceOptions(cameras=("b",)))} == {"b"}
    expect_refusal("no camera 'c'; use one of: a, b", frames_of, rig, SourceOptions(cameras=("c",)))
    still = frames_of(replaced(rig, 'poses = "a-*.txt"', 'poses = "a-1.txt"'))
    assert [f.T_world_camera[0, 3] for f in still if f.camera == "a"] == [0.1, 0.1], "without a star"

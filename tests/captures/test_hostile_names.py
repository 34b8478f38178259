"""Names out of a recording become folders in its capture, and only there."""

from hashlib import sha256
from pathlib import Path

import pytest

from splatctrl_cli.captures.capture import CaptureSource
from splatctrl_cli.captures.capture_writer import write_capture
from splatctrl_cli.errors import InputError
from splatctrl_cli.logs.source_options import SourceOptions
from splatctrl_cli.sources.source import open_source
from tests.logs.make_log import LogRecipe, make_log


@pytest.mark.parametrize(
    ("cameras", "folders"),
    [
        (("../../evil",), {"evil"}),
        (("..",), {"camera"}),
        (("a\0b",), {"a_b"}),
        (("x" * 300,), {"x" * 80}),
        (("line\nbreak",), {"line_break"}),
        (("a b", "a.b"), {"a_b", "a.b"}),
        (("a b", "a\tb"), {"a_b_0", "a_b_1"}),
        (("left/cam", "right/cam"), {"left_cam", "right_cam"}),
    ],
)
def test_a_camera_is_written_below_its_capture(tmp_path: Path, cameras: tuple[str, ...], folders: set[str]) -> None:
    log = make_log(tmp_path / "log.mcap", LogRecipe(cameras=cameras, num_frames=2))
    capture = tmp_path / "deep" / "x.capture"
    capture.mkdir(parents=True)
    write_capture(capture, open_source(log))
    assert {path.name for path in (capture / "color").iterdir()} == folders
    assert {path.name for path in tmp_path.iterdir()} == {"log.mcap", "deep"}
    assert {path.name for path in (tmp_path / "deep").iterdir()} == {"x.capture"}


def test_a_capture_whose_images_lie_outside_is_refused(tmp_path: Path) -> None:
    capture = tmp_path / "x.capture"
    capture.mkdir()
    write_capture(capture, open_source(make_log(tmp_path / "log.mcap")))
    frames = capture / "frames.csv"
    frames.write_text(frames.read_text().replace("color/cam0/000000.jpg", "../secret.jpg"))
    with pytest.raises(InputError):
        CaptureSource(capture, SourceOptions())
    sums = capture / "SHA256SUMS"
    lines = [line for line in sums.read_text().splitlines() if not line.endswith("  frames.csv")]
    sums.write_text("\n".join([*lines, f"{sha256(frames.read_bytes()).hexdigest()}  frames.csv"]) + "\n")
    with pytest.raises(InputError, match=r"../secret.jpg lies outside the capture"):
        CaptureSource(capture, SourceOptions())

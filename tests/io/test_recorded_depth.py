"""Depth that was recorded as 16-bit PNG comes into a capture byte for byte, where nothing has to change it."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.writer import Writer as McapWriter

from splatctrl_cli.io.capture_writer import write_capture
from splatctrl_cli.io.decoder import IMAGE, MessageDecoder
from splatctrl_cli.io.mcap_log import McapLog
from splatctrl_cli.io.messages import read_image
from splatctrl_cli.io.raw_log import Damage
from splatctrl_cli.io.source import open_source
from splatctrl_cli.records import RgbdFrame
from tests.io.make_log import STORE, LogRecipe, T, make_log

COMPRESSED = "sensor_msgs/msg/CompressedImage"


def with_png_depth(log: Path, path: Path) -> list[bytes]:
    """Write the log with its raw depth images as PNG files of an unusual level; returns the files."""
    decoder, files = MessageDecoder(), []
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for message in McapLog(log).messages(Damage()):
            name, kind, data = message.topic.name, message.topic.type_name, message.data
            if kind == IMAGE:
                decoded: Any = decoder.decode(message)
                pixels = read_image(decoded, IMAGE).pixels
                files.append(bytes(cv2.imencode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1]))
                kind, image = COMPRESSED, np.frombuffer(files[-1], np.uint8)
                content = T[COMPRESSED](header=decoded.header, format="16UC1; png compressed", data=image)
                data = bytes(STORE.serialize_cdr(content, COMPRESSED))
            if name not in channels:
                text = STORE.generate_msgdef(kind, ros_version=2)[0]
                schema = writer.register_schema(kind, "ros2msg", text.encode())
                channels[name] = writer.register_channel(name, "cdr", schema)
            writer.add_message(channels[name], message.log_time_ns, data, message.log_time_ns)
        writer.finish()
    return files


@pytest.mark.parametrize("distortion", [(0.0,) * 5, (0.1, 0.0, 0.0, 0.0, 0.0)])
def test_recorded_png_depth_is_kept_unless_the_lens_is_undone(tmp_path: Path, distortion: tuple[float, ...]) -> None:
    log = make_log(tmp_path / "raw.mcap", LogRecipe(distortion=distortion))
    files = with_png_depth(log, tmp_path / "png.mcap")
    capture = tmp_path / "x.capture"
    capture.mkdir()
    write_capture(capture, open_source(tmp_path / "png.mcap"))
    kept = [path.read_bytes() for path in sorted((capture / "depth" / "cam0").iterdir())]
    assert len(files) == len(kept) == 5
    assert (kept == files) == (distortion[0] == 0.0)
    of_log, of_capture = (
        [r.depth for r in open_source(path).records() if isinstance(r, RgbdFrame)] for path in (log, capture)
    )
    assert all(np.array_equal(a, b) for a, b in zip(of_log, of_capture, strict=True))

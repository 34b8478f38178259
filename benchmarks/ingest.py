"""Colour and depth pairs out of a log and out of a capture folder."""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from benchmarks.measure import SAMPLE, Options, Result, medians
from splatctrl_cli.io.capture import write_capture
from splatctrl_cli.io.source import open_source
from splatctrl_cli.records import RgbdFrame


def run(options: Options) -> Result:
    """All pairs of the sample log (320x240, JPEG and 16UC1) by source, beside decoding the same images alone."""
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "tabletop.capture"
        capture.mkdir()
        num_frames = write_capture(capture, open_source(SAMPLE / "log.mcap")).num_frames
        images = [path.read_bytes() for path in sorted(capture.glob("*/*/*.[jp][pn]g"))]
        tasks: dict[str, Callable[[], object]] = {
            "mcap": partial(_read, SAMPLE / "log.mcap"),
            "capture": partial(_read, capture),
            "decode": partial(_decode, images),
        }
        times = medians(tasks, options.rounds(5))
    num_pairs = sum(num_frames.values())
    ms = {name: 1e3 * value / num_pairs for name, value in times.items()}
    return Result(
        title=f"ingest: a colour and depth pair of 320x240, opening the source included ({num_pairs} pairs)",
        columns=("from", "ms per pair", "decoding of JPEG and PNG alone, of capture"),
        rows=[
            ["sample_data MCAP (JPEG, raw depth)", f"{ms['mcap']:.2f}", "-"],
            ["capture folder (JPEG, PNG depth, sha256 checked)", f"{ms['capture']:.2f}", f"{ms['decode']:.2f}"],
        ],
        figures={f"{name}_ms_per_pair": value for name, value in ms.items()},
        ratios={
            "capture_against_decoding": ms["decode"] / ms["capture"],
            "mcap_over_capture": ms["capture"] / ms["mcap"],
        },
    )


def _read(path: Path) -> int:
    return sum(isinstance(record, RgbdFrame) for record in open_source(path).records())


def _decode(images: list[bytes]) -> None:
    for data in images:
        cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)

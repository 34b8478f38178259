"""The joint topics that a capture keeps are read from its own files only, and only where they are whole."""

import json
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.errors import InputError
from splatctrl_cli.recording.capture.capture_writer import write_capture
from splatctrl_cli.recording.log.ros_log import RosLogSource
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from splatctrl_cli.recording.state.state_source import open_states
from tests.recording.log.make_log import LogRecipe, make_log


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    source = open_source(make_log(tmp_path / "log.mcap", LogRecipe(num_frames=3)))
    assert isinstance(source, RosLogSource)
    folder = tmp_path / "x.capture"
    folder.mkdir()
    write_capture(folder, source, topics=source.joint_topics)
    return folder


def replace(capture: Path, name: str, data: bytes) -> None:
    """Another file of that name, with the right checksum."""
    (capture / name).write_bytes(data)
    lines = (capture / "SHA256SUMS").read_text().splitlines()
    lines = [line for line in lines if line[66:] != name] + [f"{sha256(data).hexdigest()}  {name}"]
    (capture / "SHA256SUMS").write_text("\n".join(lines) + "\n")


def read(capture: Path) -> int:
    names = open_source(capture).joint_names
    return sum(1 for _ in open_states(capture, SourceOptions(), names).records())


@pytest.mark.parametrize(
    "array",
    [
        np.zeros((2, 2)),
        np.zeros((3, 2), np.float32),
        np.asfortranarray(np.zeros((9, 2))),
        np.array(1.0),
        np.array([{}], dtype=object),
    ],
)
def test_other_rows_than_those_of_the_stamps_are_refused(capture: Path, tmp_path: Path, array: np.ndarray) -> None:
    assert read(capture) > 0
    np.save(tmp_path / "x.npy", array)
    replace(capture, "joint_topics/0/position.npy", (tmp_path / "x.npy").read_bytes())
    with pytest.raises(InputError, match="joint_topics: cannot be read"):
        read(capture)


@pytest.mark.parametrize("at", [0, 70, -8])
def test_a_file_that_does_not_hold_what_it_announces_is_refused(capture: Path, at: int) -> None:
    name = "joint_topics/0/position.npy"
    replace(capture, name, (capture / name).read_bytes()[:at])
    with pytest.raises(InputError, match="joint_topics: cannot be read"):
        read(capture)


@pytest.mark.parametrize("place", ["..", "/tmp", "joint_topics/../.."])
def test_a_folder_outside_the_capture_is_refused(capture: Path, place: str) -> None:
    header = json.loads((capture / "capture.json").read_text())
    header["joint_topics"]["topics"][0]["streams"][0]["folder"] = place
    replace(capture, "capture.json", json.dumps(header).encode())
    with pytest.raises(InputError, match="lies outside the capture"):
        read(capture)

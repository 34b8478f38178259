"""One odd definition costs its topic, never the log; nonsense sizes cost a message; and RVL, the code of compressed
depth.
"""

import struct
import tracemalloc
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from splatctrl_cli.recording.container.raw_log import RawMessage, Topic
from splatctrl_cli.recording.log import decoder
from splatctrl_cli.recording.log.decoder import (
    COMPRESSED_IMAGE,
    IMAGE,
    JOINT_STATE,
    MessageDecoder,
    UndecodableMessageError,
    UnreadFormError,
)
from splatctrl_cli.recording.log.messages import decode_rvl, depth_of, read_image
from splatctrl_cli.recording.log.survey import Survey, add_message
from splatctrl_cli.recording.source import describe, open_source
from tests.recording.log.make_log import START_NS, STORE, built, header, image, make_log, messages_of, write_raw
from tests.recording.log.make_rvl import encoded_rvl

DEEP = "\n".join(f"{'=' * 80}\nMSG: a/T{i}\nT{i + 1} x" for i in range(1200))

HOSTILE = {
    "no grammar": "this is ! no definition",
    "a huge array": "string[1000000000] names",
    "a huge text": "int32 a\n" * 300_000,
    "itself": "a/B again",
    "a missing type": "other/Missing x",
    "a deep nest": "a/T0 x\n" + DEEP,
}

T_TEXT = STORE.generate_msgdef("sensor_msgs/msg/JointState", ros_version=2)[0]


def message(definition: str, data: bytes = bytes(64), type_name: str = "a/msg/B") -> RawMessage:
    topic = Topic(name="/x", type_name=type_name, encoding="cdr", definition=definition)
    return RawMessage(topic=topic, log_time_ns=0, data=data)


@pytest.mark.parametrize("name", HOSTILE)
def test_a_definition_that_cannot_be_used_is_refused(name: str) -> None:
    with pytest.raises(UndecodableMessageError, match="/x: "):
        MessageDecoder().decode(message(HOSTILE[name]))


def test_a_known_name_with_other_fields_is_refused() -> None:
    with pytest.raises(UndecodableMessageError, match="std_msgs/msg/Header lacks the field stamp of the standard"):
        MessageDecoder().decode(message(T_TEXT.replace("Time stamp", "Time sent"), type_name=JOINT_STATE))
    content = bytes(STORE.serialize_cdr(built(JOINT_STATE, name=["a"], position=[0.0]), JOINT_STATE))
    assert MessageDecoder().decode(message(T_TEXT, content, JOINT_STATE)).name == ["a"]


def test_a_refused_definition_is_not_compiled_again(monkeypatch: pytest.MonkeyPatch) -> None:
    compiled, own = Mock(side_effect=ValueError("no")), MessageDecoder()
    monkeypatch.setattr(decoder, "_type_store", compiled)
    for _ in range(3):
        with pytest.raises(UndecodableMessageError, match="not usable: no"):
            own.decode(message("int32 a"))
    assert compiled.call_count == 1


@pytest.mark.parametrize("kind", ["uint8", "float64", "string", "builtin_interfaces/Time"])
def test_a_sequence_that_announces_more_than_there_is_costs_the_message(kind: str) -> None:
    data = b"\x00\x01\x00\x00" + struct.pack("<I", 0xFFFFFFFF) + bytes(60)
    with pytest.raises(UndecodableMessageError):
        MessageDecoder().decode(message(f"{kind}[] x", data))


def image_message(**fields: Any) -> RawMessage:
    content = replace(image(START_NS, "c", "rgb8", np.zeros((4, 4, 3), np.uint8)), **fields)
    return message("", bytes(STORE.serialize_cdr(content, IMAGE)), IMAGE)


@pytest.mark.parametrize(
    "fields",
    [
        {"height": 1, "step": 0xFFFFFFFF},
        {"height": 0xFFFFFFFF, "width": 0xFFFFFFFF, "step": 0xFFFFFFFF},
        {"height": 0xFFFFFFFF, "width": 0},
        {"height": 0xFFFFFFFF, "step": 0},
        {"height": 0xFFFFFFFF, "width": 0xFFFFFFFF, "encoding": "alien"},
    ],
)
def test_an_image_takes_no_more_memory_than_its_bytes(fields: dict[str, Any]) -> None:
    decoded = MessageDecoder().decode(image_message(**fields))
    tracemalloc.start()
    try:
        assert read_image(decoded, "sensor_msgs/msg/Image").height == 1
    except UndecodableMessageError:
        assert fields["height"] > 1
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 1 << 20


def test_an_alien_schema_costs_one_topic(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap")
    alien = Topic(name="/alien", type_name="sensor_msgs/msg/CameraInfo", encoding="cdr", definition="!?")
    other = Topic(name="/other", type_name="foxglove.Thing", encoding="protobuf", definition="")
    extra = [RawMessage(topic=t, log_time_ns=1, data=bytes(40)) for t in (alien, other) for _ in range(3)]
    with_alien = write_raw(tmp_path / "alien.mcap", [*extra, *messages_of(log)])
    source = open_source(with_alien)
    assert len(list(source.records())) == len(list(open_source(log).records())) == 10
    assert source.loss.damaged == describe(with_alien).damaged == 0  # a definition that cannot be used is no damage
    parts = ("/alien:", "is not usable", "(3 times)")
    assert [all(part in note for part in parts) for note in source.loss.notes] == [True]


COUNTS = np.array([[0, 1, 500], [1000, 40000, 65534]], dtype=np.uint16)


def test_the_rvl_transport_is_depth_and_a_cut_or_bloated_one_is_refused() -> None:
    # by hand: 1 zero, 2 values: +4 is 8 = nibbles 8+0, 1; -1 is 1
    assert decode_rvl(struct.pack("<I", 0x12811000), 3).tolist() == [0, 4, 3]
    stream = struct.pack("<iffii", 0, 0.0, 0.0, COUNTS.shape[1], COUNTS.shape[0]) + encoded_rvl(COUNTS)
    form = "16UC1; compressedDepth rvl"

    def read(data: bytes) -> Any:
        return read_image(SimpleNamespace(header=header(5, "o"), format=form, data=data), COMPRESSED_IMAGE)

    assert depth_of(read(stream), None) == pytest.approx(COUNTS * 1e-3, rel=1e-6)
    for data, said in (
        (stream[:-4], "RVL"),
        (stream[:12] + b"\xff\xff\xff\x7f" * 2 + stream[20:], "an image of 2147483647x2147483647"),
        (stream[:20] + b"\xff" * 36 + bytes(4), "33 bits"),
    ):
        with pytest.raises(UndecodableMessageError, match=said):
            read(data)


PART = "=" * 80 + "\n"

IDL_TIME = f"""{PART}IDL: builtin_interfaces/msg/Time
module builtin_interfaces {{ module msg {{ struct Time {{ int32 sec; uint32 nanosec; }}; }}; }};
"""

IDL_HEADER = f"""{PART}IDL: std_msgs/msg/Header
#include "builtin_interfaces/msg/Time.idl"
module std_msgs {{ module msg {{ struct Header {{ builtin_interfaces::msg::Time stamp; string frame_id; }}; }}; }};
"""

IDL_THING = """// generated
#ifndef X
#include <std_msgs/msg/Header.idl>
module x_msgs { module msg { struct Thing { std_msgs::msg::Header header; double value; }; }; };
#endif
"""

THING = Topic(name="/x", type_name="x_msgs/msg/Thing", encoding="cdr", definition_format="idl")


def test_an_idl_schema_is_read_with_what_it_includes() -> None:
    topic = replace(THING, definition=f"{IDL_THING}{IDL_HEADER}{IDL_TIME}")
    data = struct.pack("<4siIi4sd", b"\0\1\0\0", 7, 8, 2, b"a\0\0\0", 1.5)
    read = MessageDecoder().decode(RawMessage(topic=topic, log_time_ns=0, data=data))
    assert (read.header.stamp.sec, read.header.frame_id, read.value) == (7, "a", 1.5)


def test_what_an_idl_schema_includes_and_does_not_hold_is_named_and_no_damage() -> None:
    topic = replace(THING, definition=IDL_THING)
    with pytest.raises(UnreadFormError, match="it names std_msgs/msg/Header, which its text does not define"):
        MessageDecoder().decode(RawMessage(topic=topic, log_time_ns=0, data=bytes(32)))
    found, image = Survey(), replace(topic, type_name=COMPRESSED_IMAGE)
    for _ in range(3):
        add_message(found, MessageDecoder(), RawMessage(topic=image, log_time_ns=0, data=bytes(32)))
    assert (found.damage.count, [note[-9:] for note in found.damage.all_notes]) == (0, ["(3 times)"])

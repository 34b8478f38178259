"""One odd definition costs its topic, never the log; nonsense sizes cost a message."""

import struct
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatctrl_cli.containers.raw_log import RawMessage, Topic
from splatctrl_cli.logs import decoder
from splatctrl_cli.logs.decoder import MessageDecoder, UndecodableMessageError
from splatctrl_cli.logs.messages import read_image
from splatctrl_cli.records import RgbdFrame
from splatctrl_cli.sources.describe import describe
from splatctrl_cli.sources.source import open_source
from tests.logs.make_log import START_NS, STORE, T, header, make_log
from tests.logs.write_log import messages_of, write_raw

DEEP = "\n".join(f"{'=' * 80}\nMSG: a/T{i}\nT{i + 1} x" for i in range(2000))
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
    text = T_TEXT.replace("Time stamp", "Time sent")
    assert text != T_TEXT
    with pytest.raises(UndecodableMessageError, match="std_msgs/msg/Header lacks the field stamp of the standard"):
        MessageDecoder().decode(message(text, type_name="sensor_msgs/msg/JointState"))
    content = bytes(STORE.serialize_cdr(joint_state(), "sensor_msgs/msg/JointState"))
    good = MessageDecoder().decode(message(T_TEXT, content, "sensor_msgs/msg/JointState"))
    assert good.name == ["a"]


def joint_state() -> Any:
    empty = np.zeros(0)
    return T["sensor_msgs/msg/JointState"](
        header=header(START_NS, ""), name=["a"], position=np.zeros(1), velocity=empty, effort=empty
    )


def test_a_refused_definition_is_not_compiled_again(monkeypatch: pytest.MonkeyPatch) -> None:

    calls: list[Any] = []

    def refuse(topic: Topic) -> Any:
        calls.append(topic)
        raise ValueError("no")

    monkeypatch.setattr(decoder, "_type_store", refuse)
    own = MessageDecoder()
    for _ in range(3):
        with pytest.raises(UndecodableMessageError, match="not usable: no"):
            own.decode(message("int32 a"))
    assert len(calls) == 1


def test_a_sequence_that_announces_more_than_there_is_costs_the_message() -> None:
    for kind in ("uint8", "float64", "string", "builtin_interfaces/Time"):
        data = b"\x00\x01\x00\x00" + struct.pack("<I", 0xFFFFFFFF) + bytes(60)
        with pytest.raises(UndecodableMessageError):
            MessageDecoder().decode(message(f"{kind}[] x", data))


def image_message(**fields: Any) -> RawMessage:
    kind = "sensor_msgs/msg/Image"
    given = {
        "height": 4,
        "width": 4,
        "encoding": "rgb8",
        "is_bigendian": 0,
        "step": 12,
        "data": np.zeros(48, np.uint8),
    }
    content = STORE.serialize_cdr(T[kind](header=header(START_NS, "c"), **(given | fields)), kind)
    return message("", bytes(content), kind)


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
        image = read_image(decoded, "sensor_msgs/msg/Image")
        assert image.height == 1
    except UndecodableMessageError:
        assert fields["height"] > 1
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert peak < 1 << 20


def test_an_alien_schema_costs_one_topic(tmp_path: Path) -> None:
    log = make_log(tmp_path / "log.mcap")
    whole = len(list(open_source(log).records()))
    with_alien = _with_alien(log, tmp_path / "alien.mcap")
    source = open_source(with_alien)
    assert len([r for r in source.records() if isinstance(r, RgbdFrame)]) == 5
    assert len(list(source.records())) == whole
    assert source.loss.damaged == 3
    assert all("/alien" in note for note in source.loss.notes)
    assert describe(with_alien).damaged == 3


def _with_alien(log: Path, path: Path) -> Path:
    """The log with three messages of a topic whose definition is none, and three of an unknown encoding."""
    alien = Topic(name="/alien", type_name="sensor_msgs/msg/CameraInfo", encoding="cdr", definition="!?")
    other = Topic(name="/other", type_name="foxglove.Thing", encoding="protobuf", definition="")
    extra = [RawMessage(topic=t, log_time_ns=1, data=bytes(40)) for t in (alien, other) for _ in range(3)]
    return write_raw(path, [*extra, *messages_of(log)])

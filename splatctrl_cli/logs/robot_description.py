"""The robot's model that a log itself brings: a latched topic ``robot_description``, or that parameter of a node."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from splatctrl_cli.containers.raw_log import Damage, RawLog
from splatctrl_cli.logs.decoder import MessageDecoder, UndecodableMessageError

NAME, EVENTS = "robot_description", "/parameter_events"
STRING, EVENT = "std_msgs/msg/String", "rcl_interfaces/msg/ParameterEvent"
_TEXT = 4  # a parameter's type that is text (rcl_interfaces/ParameterType)


@dataclass(frozen=True, kw_only=True)
class RobotDescription:
    """The text of a URDF, and the topic or node whose parameter it is."""

    where: str
    text: str


def robot_descriptions(log: RawLog) -> list[RobotDescription]:
    """Those of a log, each text once; of a topic the first message. The topics that have them are read, no others."""
    topics = log.topics()
    own = {t.name for t in topics if t.type_name == STRING and _last(t.name) == NAME}
    wanted = own or {t.name for t in topics if t.type_name == EVENT}
    if not topics:  # no index
        wanted = {f"/{NAME}", EVENTS}
    found: dict[str, str] = {}
    decoder = MessageDecoder()
    for message in log.messages(Damage(), wanted) if wanted else ():
        try:
            said = decoder.decode(message)
        except UndecodableMessageError:
            continue  # the survey counts it
        if message.topic.type_name == STRING:
            found.setdefault(message.topic.name, str(said.data))
        elif message.topic.type_name == EVENT:
            found.update(_parameters(said))
        if own and own <= found.keys():
            break
    where = {text: name for name, text in reversed(found.items()) if text.strip()}
    return [RobotDescription(where=name, text=text) for text, name in reversed(where.items())]


def _parameters(event: Any) -> Iterator[tuple[str, str]]:
    """Node and text of the parameters of that name that an event sets."""
    for parameter in (*event.new_parameters, *event.changed_parameters):
        if parameter.name == NAME and parameter.value.type == _TEXT:
            yield str(event.node), str(parameter.value.string_value)


def _last(topic: str) -> str:
    return topic.rpartition("/")[2]

"""Joint states of a log in one joint order."""

from collections.abc import Sequence

import numpy as np

from splatctrl_cli.logs.options import SourceOptions
from splatctrl_cli.logs.state_columns import StateColumns
from splatctrl_cli.logs.state_topics import main_topic, state_topics, track_of_joints, track_of_topic
from splatctrl_cli.logs.state_track import cleaned
from splatctrl_cli.logs.survey import Survey
from splatctrl_cli.records import LossReport

_NOTHING = StateColumns(stamp_ns=np.zeros(0, np.int64), position=np.zeros((0, 0)), velocity=np.zeros((0, 0)))


def joint_records(
    survey: Survey, options: SourceOptions, loss: LossReport, wanted: Sequence[str] | None = None
) -> tuple[tuple[str, ...], StateColumns]:
    """Joint names and states by stamp; no names and no states where the log holds none.

    With `wanted` (a robot's joints), they are brought together from the topics that have them. Else the states are of
    one topic, and those that lack a joint of the fullest (a gripper that publishes alone) are left out with a note.
    """
    topics = state_topics(survey, options, loss)
    if not topics:
        return (), _NOTHING
    raw = track_of_topic(main_topic(topics, loss), loss) if wanted is None else track_of_joints(topics, wanted, loss)
    states = cleaned(raw, loss)
    return (raw.names, states) if len(states) else ((), _NOTHING)

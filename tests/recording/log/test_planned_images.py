"""Images that wait for others: in memory, and beyond a bound in a file; the plan that says which are needed; and
pairs by stamp.
"""

from pathlib import Path

import numpy as np
import pytest

from splatctrl_cli.recording.container.raw_log import Damage, RawMessage, Topic
from splatctrl_cli.recording.log import ros_log
from splatctrl_cli.recording.log.ros_log import HeldMessages, RosLogSource, planned_images
from splatctrl_cli.recording.log.survey import pair_images
from splatctrl_cli.recording.source import open_source
from splatctrl_cli.recording.source_options import SourceOptions
from tests.recording.container.test_log_formats import assert_same
from tests.recording.log.make_log import LogRecipe, make_log, messages_of, write_raw

TOPIC = Topic(name="/a", type_name="t", encoding="cdr")

TWO = LogRecipe(cameras=("cam0", "cam1"), mask_every=2)


@pytest.mark.parametrize("held_bytes", [0, 1000, 1 << 20])
def test_a_log_that_keeps_its_topics_apart_gives_the_same_frames(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, held_bytes: int
) -> None:
    monkeypatch.setattr(ros_log, "HELD_BYTES", held_bytes)
    log = make_log(tmp_path / "log.mcap", TWO)
    apart = write_raw(tmp_path / "apart.mcap", sorted(messages_of(log), key=lambda m: m.topic.name))
    assert_same(list(open_source(log).records()), list(open_source(apart).records()))


def test_the_plan_takes_few_bytes_a_frame_and_lets_images_go_that_none_needs_any_more(tmp_path: Path) -> None:
    log, held = make_log(tmp_path / "log.mcap", TWO), HeldMessages()
    source = open_source(log)
    assert isinstance(source, RosLogSource)
    plan = source._plan
    assert plan._columns.nbytes == 48 * len(plan) == 48 * 10
    assert [planned.stamp_ns for planned in plan] == sorted(planned.stamp_ns for planned in plan)
    assert [planned.camera.name for planned in plan][:4] == ["cam0", "cam1"] * 2
    assert {topic: int(counts.sum()) for topic, counts in plan.uses().items()} == {
        f"/cam{i}/{name}": 5 for i in range(2) for name in ("color/image_raw/compressed", "depth/image_raw")
    }
    most = [len(held._messages) for _ in planned_images(source._log, plan, Damage(), held)]
    assert len(most) == 10 and max(most) <= 4 and most[-1] == 0
    named = [SourceOptions(cameras=names) for names in (("cam0", "cam1"), ("cam1", "cam0"))]
    orders = [[(s, c) for s, c, _ in open_source(log, options).poses()] for options in named]
    assert orders[0] == orders[1] == sorted(orders[0]), "by stamp, then camera, in whatever order these are named"


def test_held_messages_come_back_and_memory_holds_few_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros_log, "HELD_BYTES", 100)
    held = HeldMessages()
    data = [bytes([i]) * 40 for i in range(10)]
    for i, content in enumerate(data):
        held.add(("/a", i), RawMessage(topic=TOPIC, log_time_ns=i, data=content))
    assert sum(len(message.data) for message in held._messages.values()) == 80
    for i in (9, 0, 5, 5, 1, 2, 3):
        assert held.get(("/a", i)) == RawMessage(topic=TOPIC, log_time_ns=i, data=data[i])
    for i in range(10):
        assert held.pop(("/a", i)).data == data[i] and ("/a", i) not in held
    held.add(("/a", 10), RawMessage(topic=TOPIC, log_time_ns=0, data=bytes(100)))
    assert not held._places  # what went has made room


@pytest.mark.parametrize("seed", range(12))
def test_pairs_are_those_of_every_pair_tried_in_turn(seed: int) -> None:
    random = np.random.default_rng(seed)
    color, depth = (random.integers(0, 200, random.integers(0, 40)).tolist() for _ in range(2))
    tolerance, expected = int(random.integers(0, 30)), dict[int, int]()
    for gap, _, _, i, j in sorted((abs(a - b), a, b, i, j) for i, a in enumerate(color) for j, b in enumerate(depth)):
        if gap <= tolerance and i not in expected and j not in expected.values():
            expected[i] = j
    pairs = sorted(expected.items(), key=lambda pair: (color[pair[0]], pair[0]))
    assert [(i, j) for i, j in pair_images(color, depth, tolerance).tolist()] == pairs

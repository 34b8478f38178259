"""A source that is watched while it is read, for the offset of its clocks."""

from collections.abc import Iterator

from splatctrl_cli.io.shot import Shot, ShotSource
from splatctrl_cli.io.state_columns import StateCollector
from splatctrl_cli.io.state_motion import ImageMotion
from splatctrl_cli.io.state_offset import ClockOffset, estimate_clock_offset
from splatctrl_cli.records import Float64, JointState, LossReport, Record


class WatchedSource:
    """The same shots and states, remembered as far as `clock_offset` needs them."""

    def __init__(self, source: ShotSource) -> None:
        self._source = source
        self._states = StateCollector(len(source.joint_names))
        self._motion = ImageMotion()
        self.name, self.cameras, self.joint_names = source.name, source.cameras, source.joint_names
        self.has_clock, self.world_frame = source.has_clock, source.world_frame

    @property
    def loss(self) -> LossReport:
        """Of the source."""
        return self._source.loss

    def records(self) -> Iterator[Record]:
        """Joint states and frames by stamp."""
        for item in self.shots():
            yield item.frame if isinstance(item, Shot) else item

    def shots(self) -> Iterator[Shot | JointState]:
        """Those of the source."""
        self._states, self._motion = StateCollector(len(self.joint_names)), ImageMotion()
        for item in self._source.shots():
            if isinstance(item, Shot):
                self._motion.add(item.frame)
            else:
                self._states.add(item)
            yield item

    def poses(self) -> Iterator[tuple[int, str, Float64]]:
        """Those of the source."""
        return self._source.poses()

    def digests(self) -> dict[str, str]:
        """Those of the source."""
        return self._source.digests()

    def clock_offset(self) -> ClockOffset | None:
        """Of frames against joint states, once the shots were read; None where there are no states or no clock."""
        states = self._states.columns()
        if not len(states) or not self.has_clock:
            return None
        return estimate_clock_offset(states, self._motion)

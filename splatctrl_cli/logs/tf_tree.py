"""The tree of coordinate frames that /tf and /tf_static recorded, asked at any time; 16 bytes of memory a sample."""

from array import array
from bisect import bisect_left

import numpy as np

from splatctrl_cli.config.fixed import TF_GAP_NS, TF_STILL_POSITION, TF_STILL_ROTATION
from splatctrl_cli.files.spilled_rows import BLOCK, RowFile
from splatctrl_cli.geometry import interpolate_transform, invert_transform, transform_from
from splatctrl_cli.records import Float64


class _Transforms:
    """Transforms by number, most of them in a file without a name."""

    def __init__(self) -> None:
        self._file = RowFile((3, 4))
        self._waiting: list[Float64] = []

    def add(self, T: Float64) -> int:
        """Keep one; its number."""
        self._waiting.append(T[:3])
        if len(self._waiting) == BLOCK:
            self._file.append(np.array(self._waiting))
            self._waiting = []
        return len(self._file) + len(self._waiting) - 1

    def __getitem__(self, number: int) -> Float64:
        waiting = number - len(self._file)
        T = np.eye(4)
        T[:3] = self._waiting[waiting] if waiting >= 0 else self._file.read(number, number + 1)[0]
        return T


class _Edge:
    """T_parent_child over time, in `transforms` by number."""

    def __init__(self, parent: str, transforms: _Transforms) -> None:
        self.parent = parent
        self.stamps, self.numbers = array("q"), array("q")
        self.static: Float64 | None = None
        self.holds = False
        self._transforms = transforms
        self._is_sorted = True

    def add(self, stamp_ns: int, T: Float64) -> None:
        self._is_sorted = self._is_sorted and (not self.stamps or stamp_ns >= self.stamps[-1])
        self.stamps.append(stamp_ns)
        self.numbers.append(self._transforms.add(T))

    def at(self, stamp_ns: int, tolerance_ns: int) -> Float64 | None:
        if self.static is not None:
            return self.static
        if self.holds and len(self.stamps) == 1:
            return self._at(0)
        self._sort()
        after = bisect_left(self.stamps, stamp_ns)
        if after == len(self.stamps):
            return self._at(-1) if stamp_ns - self.stamps[-1] <= tolerance_ns else None
        if self.stamps[after] == stamp_ns:
            return self._at(after)
        if after == 0:
            return self._at(0) if self.stamps[0] - stamp_ns <= tolerance_ns else None
        gap = self.stamps[after] - self.stamps[after - 1]
        T_before, T_after = self._at(after - 1), self._at(after)
        if gap > TF_GAP_NS and not _is_still(T_before, T_after):
            return None
        return interpolate_transform(T_before, T_after, (stamp_ns - self.stamps[after - 1]) / gap)

    def _at(self, sample: int) -> Float64:
        return self._transforms[self.numbers[sample]]

    def _sort(self) -> None:
        if not self._is_sorted:
            order = np.argsort(np.frombuffer(self.stamps, dtype=np.int64), kind="stable")
            self.stamps = array("q", np.frombuffer(self.stamps, dtype=np.int64)[order].tobytes())
            self.numbers = array("q", np.frombuffer(self.numbers, dtype=np.int64)[order].tobytes())
            self._is_sorted = True


def _is_still(T_a: Float64, T_b: Float64) -> bool:
    change = np.abs(T_a - T_b)
    return bool(change[:3, 3].max() <= TF_STILL_POSITION and change[:3, :3].max() <= TF_STILL_ROTATION)


class TfTree:
    """Frames by their parent; moving edges interpolated in time, static ones valid always."""

    def __init__(self) -> None:
        self._edges: dict[str, _Edge] = {}
        self._transforms = _Transforms()
        self.notes: list[str] = []

    def add(
        self,
        parent: str,
        child: str,
        stamp_ns: int,
        position: Float64,
        quat_xyzw: Float64,
        *,
        static: bool,
        holds: bool = False,
    ) -> None:
        """Add T_parent_child at a time; a static one holds always, one that `holds` as long as it is the only one.

        The first parent of a frame stays its parent, what would close a loop is left out, the last of different
        static transforms holds; all of this is noted.
        Raises ValueError for a rotation or position that is not one (a zero quaternion, NaN).
        """
        parent, child = parent.strip("/"), child.strip("/")
        norm = float(np.linalg.norm(quat_xyzw))
        if not (np.isfinite(position).all() and 0.5 < norm < 2.0):
            raise ValueError(f"transform {parent} -> {child} is not a rigid transform")
        if child not in self._edges and child in self._ancestors(parent):
            self.note(f"tf: {parent} -> {child} would close a loop, as {child} is above {parent}; it is left out")
            return
        edge = self._edges.setdefault(child, _Edge(parent, self._transforms))
        if edge.parent != parent:
            self.note(f"tf: frame {child} has parents {edge.parent} and {parent}; {edge.parent} is kept")
            return
        T = transform_from(position, quat_xyzw)
        edge.holds = edge.holds or holds
        if not static:
            edge.add(stamp_ns, T)
        else:
            if edge.static is not None and not _is_still(edge.static, T):
                self.note(f"tf: {parent} -> {child} is static and changes; the last one holds")
            edge.static = T
        if edge.static is not None and edge.stamps:
            self.note(f"tf: {parent} -> {child} is both static and moving; the static one holds")

    def note(self, note: str) -> None:
        """Keep a remark on the tree, once."""
        if note not in self.notes:
            self.notes.append(note)

    @property
    def frames(self) -> tuple[str, ...]:
        """All frames, sorted by name."""
        return tuple(sorted(set(self._edges) | {edge.parent for edge in self._edges.values()}))

    @property
    def roots(self) -> tuple[str, ...]:
        """Frames without a parent, sorted by name."""
        return tuple(frame for frame in self.frames if frame not in self._edges)

    def root_of(self, frame: str) -> str:
        """The topmost ancestor of `frame` (itself, where it has no parent)."""
        return self._ancestors(frame)[-1]

    def span_ns(self, frame: str) -> tuple[int, int] | None:
        """First and last stamp for which the moving edges above `frame` are all known; None if none moves."""
        edges = [self._edges[f] for f in self._ancestors(frame)[:-1]]
        moving = [edge.stamps for edge in edges if edge.static is None]
        return (max(min(s) for s in moving), min(max(s) for s in moving)) if moving else None

    def connects(self, target: str, source: str) -> bool:
        """Whether a chain of edges joins the two frames."""
        return self.root_of(target.strip("/")) == self.root_of(source.strip("/"))

    def lookup(self, target: str, source: str, stamp_ns: int, tolerance_ns: int = 0) -> Float64 | None:
        """T_target_source (4, 4) at a time; None where unconnected or unknown at that time."""
        target, source = target.strip("/"), source.strip("/")
        up_target, up_source = self._ancestors(target), self._ancestors(source)
        common = next((frame for frame in up_source if frame in up_target), None)
        if common is None:
            return None
        T_common_source = self._chain(up_source, common, stamp_ns, tolerance_ns)
        T_common_target = self._chain(up_target, common, stamp_ns, tolerance_ns)
        if T_common_source is None or T_common_target is None:
            return None
        return invert_transform(T_common_target) @ T_common_source

    def _chain(self, ancestors: list[str], top: str, stamp_ns: int, tolerance_ns: int) -> Float64 | None:
        T = np.eye(4)
        for frame in ancestors[: ancestors.index(top)]:
            T_parent_frame = self._edges[frame].at(stamp_ns, tolerance_ns)
            if T_parent_frame is None:
                return None
            T = T_parent_frame @ T
        return T

    def _ancestors(self, frame: str) -> list[str]:
        chain = [frame]
        while chain[-1] in self._edges and self._edges[chain[-1]].parent not in chain:
            chain.append(self._edges[chain[-1]].parent)
        return chain

"""Which colour image belongs to which depth image."""

from collections.abc import Sequence


def pair_by_stamp(color_ns: Sequence[int], depth_ns: Sequence[int], tolerance_ns: int) -> list[tuple[int, int]]:
    """Index pairs (colour, depth) at most `tolerance_ns` apart, each index once, the closest pairs first.

    Returned by colour stamp. Of equally close pairs the earlier one wins.
    """
    color_order = sorted(range(len(color_ns)), key=lambda i: color_ns[i])
    depth_order = sorted(range(len(depth_ns)), key=lambda i: depth_ns[i])
    candidates: list[tuple[int, int, int, int, int]] = []
    start = 0
    for i in color_order:
        while start < len(depth_order) and depth_ns[depth_order[start]] < color_ns[i] - tolerance_ns:
            start += 1
        for k in range(start, len(depth_order)):
            j = depth_order[k]
            if depth_ns[j] > color_ns[i] + tolerance_ns:
                break
            candidates.append((abs(color_ns[i] - depth_ns[j]), color_ns[i], depth_ns[j], i, j))
    used_color: set[int] = set()
    used_depth: set[int] = set()
    pairs: list[tuple[int, int]] = []
    for *_, i, j in sorted(candidates):
        if i not in used_color and j not in used_depth:
            used_color.add(i)
            used_depth.add(j)
            pairs.append((i, j))
    return sorted(pairs, key=lambda pair: (color_ns[pair[0]], pair[0]))

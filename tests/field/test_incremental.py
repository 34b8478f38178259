from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from splatctrl_cli.config import FieldConfig
from splatctrl_cli.field.baker import Baker, Changes, changed_blocks, counts_after
from splatctrl_cli.field.grid_cells import GridLayout
from splatctrl_cli.field.slabs import bake_planes
from splatctrl_cli.records import Box, Label, SplatSet
from tests.field.scenes import cloud, splat_set

BOX = Box(lower=np.array([-0.61, -0.57, -0.4]), upper=np.array([0.55, 0.6, 0.43]))
CONFIG = FieldConfig(voxel=0.025, distance="safe")
LAYOUT = GridLayout.over(BOX, CONFIG.voxel)
CHANNELS = ("sdf", "gradient", "bound", "observed", "probability", "label", "hard", "se")
EDITS = ("add", "remove", "move", "radius", "label", "duplicate", "order")


def lattice() -> SplatSet:
    """Splats on a lattice whose points lie between cells: ties of the nearest everywhere."""
    x, y = np.meshgrid(np.arange(-0.3, 0.31, 0.05), np.arange(-0.3, 0.31, 0.05))
    centers = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    splats = splat_set(centers, np.full(len(centers), 0.01))
    return replace(
        splats, labels=np.where(np.arange(len(centers)) % 3 == 0, Label.HUMAN, Label.OBJECT).astype(np.uint8)
    )


def edited(splats: SplatSet, kind: str, rng: np.random.Generator, num: int = 4) -> SplatSet:
    """The splats with a few of them changed, near each other."""
    chosen = np.argsort(np.linalg.norm(splats.centers - splats.centers[rng.integers(len(splats))], axis=1))[:num]
    kept = np.ones(len(splats), bool)
    centers, radii, labels = splats.centers.copy(), splats.radii.copy(), splats.labels.copy()
    if kind == "remove":
        kept[chosen] = False
        return splats.select(kept)
    if kind in ("add", "duplicate"):
        only = np.zeros(len(splats), bool)
        only[chosen] = True
        shift = 0.0 if kind == "duplicate" else rng.normal(0.0, 0.02, (num, 3)).astype(np.float32)
        more = splats.select(only)
        more = replace(more, centers=(more.centers + shift).astype(np.float32))
        return SplatSet(**{name: np.concatenate([vars(more)[name], own]) for name, own in vars(splats).items()})
    if kind == "order":
        order = rng.permutation(len(splats))
        return SplatSet(**{name: values[order] for name, values in vars(splats).items()})
    if kind == "move":
        centers[chosen] += rng.normal(0.0, 0.01, (num, 3)).astype(np.float32)
    elif kind == "radius":
        radii[chosen] *= np.float32(1.3)
    else:
        labels[chosen] = Label.HUMAN - labels[chosen]
    return replace(splats, centers=centers, radii=radii, labels=labels)


def update_and_compare(
    before: SplatSet, after: SplatSet, config: FieldConfig, channels: Sequence[str], layout: GridLayout = LAYOUT
) -> Changes:
    """Update a bake, compare channels and counts with a full bake bit by bit, and return the changes."""
    old, new, full = (
        Baker(splats, layout, config, channels=channels, threads=num)
        for splats, num in ((before, 2), (after, 2), (after, 1))
    )
    num = layout.shape[0]
    arrays, expected = (bake_planes(baker, 0, num) for baker in (old, full))
    counts = dict(old.counts)
    changes = changed_blocks(before, old, after, new)
    assert changes.mask is not None
    new.bake(0, num, arrays, changes.mask)
    assert counts_after(counts, old, new, changes.mask, [(0, 16), (16, num)]) == full.counts
    for name, values in expected.items():
        assert arrays[name].tobytes() == values.tobytes(), name
    return changes


@pytest.mark.parametrize("kind", EDITS)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("distance", ["safe", "se", "hard"])
def test_an_update_equals_the_full_bake_to_the_bit(kind: str, seed: int, distance: str) -> None:
    before = lattice() if seed % 2 else splat_set(*cloud(400, seed))
    after = edited(before, kind, np.random.default_rng(seed))
    changes = update_and_compare(
        before,
        after,
        replace(CONFIG, distance=distance),
        [name for name in CHANNELS if name != "se" or distance != "hard"],
    )
    assert changes.num_baked < 0.8 * changes.num_blocks
    if kind != "order" or not seed % 2:
        assert (changes.num_baked > 0) == (kind != "order")


def test_an_edit_is_baked_as_far_as_its_kernel_reaches() -> None:
    """One of two splats goes, ten length scales apart: beyond the reach of their weights, not of their field."""
    length, voxel, extent = 0.2, 0.005, np.array([2.2, 0.035, 0.035])
    layout = GridLayout.over(Box(lower=np.zeros(3), upper=extent), voxel)
    before = splat_set(np.array([[0.1, 0.015, 0.015], [0.1 + 10 * length, 0.015, 0.015]]), np.full(2, 0.01))
    config = replace(CONFIG, voxel=voxel, distance="se", length_scale=length, truncation=1e-8)
    changes = update_and_compare(before, before.select(np.array([False, True])), config, ("sdf", "se"), layout)
    assert 0.5 < changes.num_baked / changes.num_blocks < 1.0


def test_a_far_edit_of_all_bakes_everything_it_must_and_none_bakes_nothing() -> None:
    before = splat_set(*cloud(300))
    update_and_compare(before, replace(before, centers=before.centers + np.float32(0.07)), CONFIG, ("sdf", "hard"))
    same = update_and_compare(before, before, CONFIG, ("sdf", "hard"))
    assert (same.num_baked, same.reason) == (0, "")


def test_what_reaches_every_cell_bakes_everything_and_says_why() -> None:
    before = splat_set(*cloud(100))
    after = edited(before, "remove", np.random.default_rng(0))
    config = replace(CONFIG, distance="safe_gpdf")
    old, new = (Baker(splats, LAYOUT, config) for splats in (before, after))
    changes = changed_blocks(before, old, after, new)
    assert changes.num_baked == changes.num_blocks and "gpdf" in changes.reason
    for config, channels, words in (
        (replace(CONFIG, probability="paper"), ("sdf", "probability"), "the paper's probability"),
        (replace(CONFIG, unknown="obstacle"), ("sdf",), "field.unknown = obstacle"),
    ):
        old, new = (Baker(splats, LAYOUT, config, channels=channels) for splats in (before, after))
        assert words in changed_blocks(before, old, after, new).reason
    for scale in (1.5, 0.5):
        moved = replace(before, centers=before.centers * np.float32(scale))
        old, new = (Baker(splats, LAYOUT, CONFIG) for splats in (before, moved))
        assert "bound's margin" in changed_blocks(before, old, moved, new).reason

"""A distance field sampled on a regular grid, with its bound and what was observed beside it."""

from collections.abc import Collection

from splatctrl_cli.config import FieldConfig, OccupancyConfig
from splatctrl_cli.field.baker import DEFAULT_CHANNELS, Baker
from splatctrl_cli.field.header import field_header
from splatctrl_cli.field.layout import GridLayout, check_memory
from splatctrl_cli.field.selection import DEFAULT_LABELS, field_splats
from splatctrl_cli.field.slabs import bytes_per_cell
from splatctrl_cli.field.unknown import apply_unknown
from splatctrl_cli.records import Box, DistanceGrid, Label, OccupancyGrid, SplatSet


def bake(
    splats: SplatSet,
    box: Box,
    config: FieldConfig,
    *,
    channels: Collection[str] = DEFAULT_CHANNELS,
    occupancy: OccupancyGrid | None = None,
    thresholds: OccupancyConfig | None = None,
    labels: Collection[Label] = DEFAULT_LABELS,
    threads: int = 0,
) -> DistanceGrid:
    """Distances to the splats with one of `labels` at cells of size ``config.voxel`` that cover `box`.

    `channels` are some of `CHANNELS`, sdf among them. Culling is exact for hard; a kernel field with row sums is too
    large by at most ``config.truncation``. The same input gives the same bytes at any thread count. Raises UsageError
    for a bad box or one that does not fit the memory, NotEvaluableError where no splat is left, InputError for splats
    that are not finite.
    """
    chosen = field_splats(splats, labels)
    layout = GridLayout.over(box, config.voxel)
    check_memory(layout, bytes_per_cell(channels))
    baker = Baker(
        chosen, layout, config, channels=channels, occupancy=occupancy, thresholds=thresholds, threads=threads
    )
    arrays = baker.allocate(layout.shape[0])
    baker.bake(0, layout.shape[0], arrays)
    header = field_header(splats, chosen, labels, baker, has_occupancy=occupancy is not None)
    grid = DistanceGrid(origin=layout.origin, voxel=layout.voxel, channels=arrays, header=header)
    return apply_unknown(grid, config.unknown)

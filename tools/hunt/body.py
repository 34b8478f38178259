"""The visible arm and the depth model of a run; from seed 200 on they differ from the robot's model."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from splatctrl_cli.simulate.arm import SHAPES, SLIM, UNMODELLED, Block, Capsule
from splatctrl_cli.simulate.render import StereoDepth

FIRST_OF_STEREO = 200  # the first seed whose runs have visual shapes and stereo depth
PLAIN_SHARE = 0.10  # of its runs, in which the arm looks as it collides and depth is nearly exact, as in seeds before
PART_SHARE = 0.20  # of the others, in which the arm has an unmodelled part
SPREADS, FATTENINGS = (0.005, 0.08), (0.0, 3.0)  # [px] of the depth imagers
IMAGER = 640  # [px] their width, whatever that of the images
WIDTH, STEREO_WIDTH = 96, 128  # [px] of the images
FAULTLESS = ("benign", "still")  # families


@dataclass(frozen=True, kw_only=True)
class Body:
    """is_slim: visual shapes lie inside of the collision shapes; parts: names of its `UNMODELLED` parts; depth: how
    cameras measure it, None for nearly exact depth.
    """

    is_slim: bool = False
    parts: tuple[str, ...] = ()
    depth: StereoDepth | None = None

    @property
    def shapes(self) -> Mapping[str, tuple[Capsule | Block, ...]]:
        """Seen shapes by link, without the parts."""
        return SLIM if self.is_slim else SHAPES

    @property
    def solids(self) -> list[tuple[str, Capsule | Block]]:
        """All that is seen of it, each with its link."""
        own: list[tuple[str, Capsule | Block]] = [(link, s) for link, shapes in self.shapes.items() for s in shapes]
        return own + [(UNMODELLED[name][0], capsule) for name in self.parts for capsule in UNMODELLED[name][1]]

    @property
    def palm(self) -> float:
        """Position [m] of the palm along the hand's z axis."""
        block = self.shapes["hand"][0]
        assert isinstance(block, Block)
        return block.middle[2] + block.size[2] / 2

    @property
    def width(self) -> int:
        """Width of the images [px]."""
        return WIDTH if self.depth is None else STEREO_WIDTH

    @property
    def words(self) -> str:
        """`slim` or `plain`, and its parts."""
        return " ".join(("slim" if self.is_slim else "plain", *self.parts))


def draw_body(seed: int, index: int, family: str) -> Body:
    """The body of a run. Faultless runs have no unmodelled part; with a camera on the hand, there is no bracket."""
    rng = np.random.default_rng([seed, index, 3])
    if seed < FIRST_OF_STEREO or rng.random() < PLAIN_SHARE:
        return Body()
    names = [name for name in UNMODELLED if (family, name) != ("wrist", "bracket")]
    name, has_part = str(rng.choice(names)), rng.random() < PART_SHARE
    spread, fattening = float(rng.uniform(*SPREADS)), float(rng.uniform(*FATTENINGS))
    depth = StereoDepth(spread=spread, fattening=(fattening / 3, fattening), width=IMAGER)
    return Body(is_slim=True, parts=(name,) if has_part and family not in FAULTLESS else (), depth=depth)

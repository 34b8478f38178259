"""A bare file of splats, of this program or another, in the place of a scene: nothing is known but the splats."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from splatctrl_cli.errors import InputError
from splatctrl_cli.files.digests import Parts
from splatctrl_cli.records import GaussianSet, SplatSet
from splatctrl_cli.scene_files.scene_folder import SceneFolder, Snapshot, open_scene
from splatctrl_cli.splat_files.splat_formats import read_splats
from splatctrl_cli.splat_files.splats import check_world
from splatctrl_cli.voxels import Balls


@dataclass(frozen=True)
class SplatFile(SceneFolder):
    """Splats that are rendered as they are: of any shape, with what harmonics they have, before black."""

    @cached_property
    def run(self) -> dict[str, Any]:
        """What is known of how they were made: nothing."""
        return {"metrics": {"cameras": [], "has_clock": False, "stamp_ns": 0}, "inputs": {}, "config": {}}

    @cached_property
    def parts(self) -> Parts:
        """Of the file alone."""
        return Parts(folder=self.path.parent)

    @property
    def names_its_views(self) -> bool:
        """False: who trained them is not recorded."""
        return False

    @property
    def is_anisotropic(self) -> bool:
        """Whether any is stretched, or changes its colour by side."""
        return isinstance(self._found, GaussianSet)

    @cached_property
    def _found(self) -> SplatSet | GaussianSet:
        """Raises InputError for a file that is damaged, of an unknown kind, in another frame or unit, or empty."""
        found, comments = read_splats(self.path)
        check_world(self.path, comments)
        if not len(found):
            raise InputError(f"{self.path}: has no splats: there is nothing to render", remedy="give another file")
        return found

    def gaussians(self) -> GaussianSet:
        """Where they are anisotropic."""
        assert isinstance(self._found, GaussianSet)
        return self._found

    def splats(self) -> SplatSet:
        """Where they are not."""
        assert isinstance(self._found, SplatSet)
        return self._found

    @cached_property
    def snapshots(self) -> tuple[Snapshot, ...]:
        return ()

    def unrepresented_at(self, stamp_ns: int | None) -> Balls | None:
        return None


def open_splats(path: Path) -> SceneFolder:
    """The scene in a folder, or a file of splats. Raises InputError where it is neither."""
    return SplatFile(path) if path.is_file() else open_scene(path)

"""Whether what the cameras saw fits together, before a map is made of it."""

from itertools import combinations

from splatctrl_cli.checks.check_views import are_far, check_views
from splatctrl_cli.config import OccupancyConfig
from splatctrl_cli.errors import InputError
from splatctrl_cli.jobs.progress import Progress
from splatctrl_cli.scene.recording_consistency import CAUSES, agreements
from splatctrl_cli.scene.time_steps import TimeStep


class CameraAgreement:
    """disagreement [m]: of each pair of cameras that see enough of the same, how far apart they see it.

    name: of the recording. is_allowed: what does not fit is said, not refused. is_still: the scene does not move, so
    that all views of a time step show the same. guess: in words, that the unit of lengths was guessed.
    """

    def __init__(self, name: str, *, is_allowed: bool, is_still: bool, guess: str = "") -> None:
        self.disagreement: dict[str, float] = {}
        self._name, self._is_allowed, self._is_still, self._guess = name, is_allowed, is_still, guess

    def check(self, step: TimeStep, limits: OccupancyConfig, console: Progress) -> None:
        """Compare once each pair of cameras, and of a still scene whether another depth scale would fit the views.

        Raises InputError where cameras place surfaces too far apart, or views fit at another scale of depth only.
        """
        if not self._has_new_pairs(step):
            return
        if self._is_still and not self.disagreement:
            self._check_scale(step, console)
        for pair in agreements(step.frames, limits.min_range, limits.max_range):
            name = " and ".join(dict.fromkeys(pair.cameras))
            if name in self.disagreement:
                continue
            self.disagreement[name] = round(pair.median, 5)
            if pair.holds:
                continue
            line = (
                f"{self._name}: camera {name}: depths disagree by {1e3 * pair.median:.0f} mm (median of"
                f" {pair.num_pixels} pixels that two views see; expected at most {1e3 * pair.limit:.0f} mm)"
            )
            if not self._is_allowed:
                others = f" keep one with --cameras {pair.cameras[0]}," if len(set(pair.cameras)) > 1 else ""
                refine = " (--refine-poses)" if self._is_still else " (splatctrl calibrate)"
                raise InputError(
                    line, remedy=f"{CAUSES}: correct poses or depth{refine},{others} or give --allow-disagreement"
                )
            console.log(f"warning: {line}; {CAUSES}: correct poses or depth, or expect surfaces twice")

    def _check_scale(self, step: TimeStep, console: Progress) -> None:
        cameras = sorted({frame.camera for frame in step.frames})
        if self._guess:
            console.log(f"warning: {self._name}: {self._guess}; the map is in metres")
        found = check_views(step.frames, dict.fromkeys(cameras), is_sure=not self._guess and not are_far(step.frames))
        for finding in found.findings:
            if finding.code == "views-scale" and not self._is_allowed:
                raise InputError(
                    f"{self._name}: {finding.what}",
                    remedy=f"multiply --depth-scale by {finding.value:.4g}, or correct the poses' unit; if both are"
                    " right, give --allow-disagreement",
                )
            if finding.code == "views-scale":
                console.log(f"warning: {self._name}: {finding.what}")

    def _has_new_pairs(self, step: TimeStep) -> bool:
        """Whether two views of this time step are from cameras that have not been compared yet."""
        names = sorted(frame.camera for frame in step.frames)
        pairs = {" and ".join(dict.fromkeys(pair)) for pair in combinations(names, 2)}
        return not pairs <= self.disagreement.keys()

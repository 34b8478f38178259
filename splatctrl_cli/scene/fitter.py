"""`SceneFitter.step`: one time step of the paper's Fig. 2."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

import numpy as np

from splatctrl_cli.config import HumanConfig, OccupancyConfig, SceneConfig, check_voxel, fixed
from splatctrl_cli.kernels import num_threads
from splatctrl_cli.kernels.cuda.fit import DeviceFit
from splatctrl_cli.kernels.raster import LossTerms
from splatctrl_cli.records import Bool, Box, Float32, Label, PointCloud, RgbdFrame, SplatSet, spread
from splatctrl_cli.scene.backdrop import Shell, backdrop_seeds
from splatctrl_cli.scene.buffer import BACKDROP, Filled, Seeds, SplatBuffer
from splatctrl_cli.scene.contradicted import mask_frames, take_in_evidence
from splatctrl_cli.scene.descent import Descent
from splatctrl_cli.scene.keyframes import View, Window, make_view, move_to_surface, seen_through, shrink_radii
from splatctrl_cli.scene.labels import Seen, contact_seeds, hidden_objects, lasts_at_fixed_links, relabel
from splatctrl_cli.scene.mounted import background_color, mounted_pixels, spread_views
from splatctrl_cli.scene.occupancy import OccupancyMap, PeopleMemory
from splatctrl_cli.scene.posture import RobotPosture, carry_splats
from splatctrl_cli.scene.removal import REASONS, removals, room_for, use_idle
from splatctrl_cli.scene.render import BLACK, Color, mean_loss, psnr_of
from splatctrl_cli.scene.seeding import (
    SeedDensity,
    add_mask,
    candidates,
    density_for,
    gap_seeds,
    inside_workspace,
    seeds_at,
    thin_mask,
    thinning,
)
from splatctrl_cli.scene.self_mask import (
    PixelKind,
    SelfMask,
    audit_masks,
    label_pixels,
    object_mask,
)
from splatctrl_cli.scene.surface_depth import object_twice, steady_depth
from splatctrl_cli.scene.time_steps import AuditRow, Refined
from splatctrl_cli.scene.unrepresented import bare_voxels, confirm_bare, unrepresented_voxels
from splatctrl_cli.voxels import Balls, KnownVoxels


class SceneFitter:
    """Fits a fixed budget of isotropic splats to RGB-D frames.

    The same frames and seed give the same bytes at any thread count.
    """

    def __init__(
        self,
        config: SceneConfig,
        occupancy: OccupancyConfig,
        workspace: Box,
        *,
        human: HumanConfig | None = None,
        seed: int = 0,
        threads: int = 0,
        device: DeviceFit | None = None,
        has_shell: bool = False,
        has_backdrop: bool = False,
    ) -> None:
        check_voxel(config, occupancy)
        self.config = config
        self.workspace = workspace
        self.seed = seed
        self.num_threads = num_threads(threads)
        self._each = ThreadPoolExecutor(self.num_threads).map  # runs a function on all views at once
        self.buffer = SplatBuffer(config.max_splats)
        self.descent = Descent(config, self.buffer, seed, self.num_threads, device)
        self.occupancy = OccupancyMap(workspace, occupancy, self.num_threads)
        self.people = PeopleMemory((human or HumanConfig()).memory)
        self.window = Window(config)
        self.shell = Shell(config, occupancy, workspace, seed, self.num_threads) if has_shell else None
        self.has_backdrop = has_backdrop
        self.num_steps = 0
        self.density: SeedDensity | None = None  # chosen by the first time step with seeds
        self.posture: RobotPosture | None = None
        self.mounted: dict[str, Bool] = {}  # by camera, pixels (H, W) of what it carries
        self.refined = Refined(num_blocks=0, filled=Filled(), removed=dict.fromkeys(REASONS, 0))
        self._unrepresented: Balls | None = None
        self.bare: Balls | None = None  # of the last time step, before `confirm_bare`
        self.seen: Seen = ()  # frames of the last time step, as in its newest views, with masks
        self.objects: dict[str, Bool] = {}  # by camera, object pixels (H, W) of its newest frame

    def step(self, frames: Sequence[RgbdFrame], robot: RobotPosture | None = None) -> AuditRow:
        """Take in the frames of one time step: integrate, remove, seed, optimise, label."""
        rng = np.random.default_rng([self.seed, self.num_steps])
        robot = robot and replace(robot, num_threads=self.num_threads)
        self._find_mounted(frames)
        config = self.occupancy.config
        frames, masks, rays = mask_frames(frames, robot, self.seen, self.occupancy, self._each)
        known = {view.frame.camera: view.frame for view in self.window.newest if view.frame.camera in self.objects}
        before = {camera: (frame, self.objects[camera]) for camera, frame in known.items()}
        objects = [mask.kinds == PixelKind.OBJECT for mask in masks]
        self.objects |= {frame.camera: pixels for frame, pixels in zip(frames, objects, strict=True)}
        frames, steady = zip(
            *self._each(lambda f, pixels: steady_depth(f, before.get(f.camera), pixels, config), frames, objects),
            strict=True,
        )
        views = list(self._each(self.view, frames, masks))
        last = {frame.camera: (frame, mask) for frame, mask in self.seen}
        seen = self.seen = list(zip(frames, masks, strict=True))
        if self.descent.background is None:
            self.descent.background = self._behind(views)
        take_in_evidence(self.occupancy, self.people, seen, rays, robot, self._each, last)
        self._carry(robot)
        removed = self._remove(self._relabel(robot, seen), self._floating(views))
        filled = self._seed(views, masks)
        if self.has_backdrop and not self.num_steps:
            filled += self._seed_backdrop(views)
        is_first = self.descent.num_iterations == 0 and bool(self.buffer.is_alive.any())
        self.window.advance(views)
        self.descent.keep([*self.window.newest, *self.window.keyframes])
        num_iterations = self.config.first_iterations if is_first else self.config.iterations_per_step
        hidden = hidden_objects(self.buffer, robot, seen, self.occupancy.config)
        as_they_were = self.buffer.parameters.copy()
        terms = self.descent.run(self.window.schedule(num_iterations, rng), self.descent.settings())
        hidden = np.union1d(hidden, hidden_objects(self.buffer, robot, seen, self.occupancy.config))  # moved there
        self.buffer.parameters[hidden] = as_they_were[hidden]
        self._prune(robot, views, seen, removed)
        filled += self._show_contact(robot, views, seen, steady)
        is_lasting = None  # in the first step, nothing has lasted yet
        if self.num_steps and robot is not None:
            lasting = [object_twice(f, before.get(f.camera), each) for f, each in zip(frames, steady, strict=True)]
            is_lasting = partial(lasts_at_fixed_links, robot, frames, lasting, config)
        half = self.num_steps % 2 if self.num_steps else None
        filled += self._fill_gaps(views, masks, removed, half, is_lasting)
        self._keep_to_surface(robot, views, seen)
        if self.shell is not None:
            self.shell.step(self.window, self.mounted, self.descent.background)
        self.num_steps += 1
        return replace(self._audit(views, filled, removed, terms), **audit_masks(masks))

    def plant(self, cloud: PointCloud) -> Filled:
        """Start from coloured points, seeded with at most a share `fill` of the budget."""
        source = Seeds(centers=cloud.points, radii=np.zeros(len(cloud), np.float32), colors=cloud.colors)
        count = max(int(self.config.fill * self.config.max_splats), 1)
        self.density = density_for([source], count, self.config)
        seeds = seeds_at([source], self.buffer.centers[self.buffer.is_alive], self.density, self.config)
        return self.buffer.fill(seeds, self.config.initial_opacity)

    def refine(self, num_iterations: int, progress: Callable[[int], None] = lambda _: None) -> AuditRow:
        """Optimise a static scene over the window, with rates that fall to a share `final_rate`.

        `progress` gets the iterations after each of ten blocks; a restored fitter continues with the next.
        """
        views = [self.view(view.frame) for view in (*self.window.newest, *self.window.keyframes)]
        for block in range(self.refined.num_blocks, fixed.REFINE_BLOCKS):
            self._refine_block(block, num_iterations, views)
            progress(num_iterations * (block + 1) // fixed.REFINE_BLOCKS)
        removed = dict(self.refined.removed)
        masks = [object_mask(view.frame) for view in views]
        return self._audit(views, self.refined.filled + self._fill_gaps(views, masks, removed), removed, {})

    def _refine_block(self, block: int, num_iterations: int, views: Sequence[View]) -> None:
        rng = np.random.default_rng([self.seed, self.num_steps, 1 + block])
        nowhere = np.zeros(self.config.max_splats, bool)
        rate = self.config.final_rate ** (block / (fixed.REFINE_BLOCKS - 1))
        count = num_iterations * (block + 1) // fixed.REFINE_BLOCKS - num_iterations * block // fixed.REFINE_BLOCKS
        settings = self.descent.settings(rate, rate * self.config.refine_geometry)
        self.descent.run(
            self.window.schedule(count, rng),
            settings,
            self.config.refine_depth ** (block / (fixed.REFINE_BLOCKS - 1)),
        )
        # Splats that a view sees through stay: removing them costs 0.6 dB if poses are off by millimetres.
        removed = self._remove(nowhere, nowhere, counts_time=False)
        filled = self.refined.filled
        if block < fixed.REFINE_BLOCKS - 2:
            filled += self._seed(views, [object_mask(view.frame) for view in views])
            filled += self._use_idle(views, rng, removed)
        self.refined = Refined(
            num_blocks=block + 1,
            filled=filled,
            removed={reason: before + removed[reason] for reason, before in self.refined.removed.items()},
        )

    def splats(self) -> SplatSet:
        return self.buffer.splats(self.num_threads)

    def shell_splats(self) -> SplatSet | None:
        """Splats for pictures only: the shell beyond the workspace, or the backdrop; None without any."""
        if self.shell is not None:
            return self.shell.splats()
        backdrop = self.buffer.splats(self.num_threads, self._standing_for(BACKDROP))
        return replace(backdrop, labels=np.zeros_like(backdrop.labels)) if len(backdrop) else None

    @property
    def unrepresented(self) -> Balls:
        """Occupied voxels, except the robot's, without a splat after the last step or refining."""
        if self._unrepresented is None:
            seen = [view.frame.depth[::8, ::8] for view in self.window.newest]
            depth = np.concatenate([image[image > 0] for image in seen]) if seen else np.zeros(0, np.float32)
            error = (
                fixed.MASK_SIGMAS * self.occupancy.config.depth_error * float(np.median(depth)) ** 2
                if len(depth)
                else 0.0
            )
            balls = unrepresented_voxels(self.occupancy, self.splats(), self.config, error)
            if self.posture is not None:
                balls = balls.select(~self.posture.holds(balls.centers, fixed.WELL_INSIDE))
            self._unrepresented, self.bare = confirm_bare(balls, self.bare), balls
        return self._unrepresented

    @unrepresented.setter
    def unrepresented(self, balls: Balls) -> None:
        self._unrepresented = balls

    def known_voxels(self) -> KnownVoxels:
        return self.occupancy.known(self.unrepresented)

    def view(self, frame: RgbdFrame, mask: SelfMask | None = None) -> View:
        """Frame as the optimiser takes it; mask: of a robot in it."""
        mappable = inside_workspace(frame, self.workspace, self.occupancy.config.min_range)
        return make_view(
            frame,
            mappable,
            self.mounted.get(frame.camera),
            is_robot=None if mask is None else mask.kinds == PixelKind.ROBOT,
            reach=fixed.NEAREST_REACH * (self.config.scale or 1.0),
        )

    def _find_mounted(self, frames: Sequence[RgbdFrame]) -> None:
        for camera in sorted({frame.camera for frame in frames} - set(self.mounted)):
            known = [view.frame for view in self.window.keyframes]
            seen = spread_views([frame for frame in [*known, *frames] if frame.camera == camera])
            is_mounted = mounted_pixels(seen, self.occupancy.config.min_range)
            if is_mounted is not None:
                self.mounted[camera] = is_mounted
                self.window.keyframes = [self.view(view.frame) for view in self.window.keyframes]
                self.window.newest = [self.view(view.frame) for view in self.window.newest]

    def _behind(self, views: Sequence[View]) -> Color:
        """Background: colour of pixels without depth; of pixels without splats if no view has depth."""
        if self.config.background == "black":
            return BLACK
        counted = [view.target.counted > 0 for view in views]
        if not any(view.mappable.any() for view in views):
            shown = [self.descent.rendering(view).opacity for view in views]
            counted = [mask & (opacity < fixed.NOT_COVERED) for mask, opacity in zip(counted, shown, strict=True)]
        return background_color([view.frame for view in views], counted)

    def _carry(self, robot: RobotPosture | None) -> None:
        before, self.posture = self.posture, robot
        if before is None or robot is None:
            return
        slots = np.flatnonzero(self.buffer.is_alive & (self.buffer.labels == Label.ROBOT))
        self.buffer.centers[slots] = carry_splats(self.buffer.centers[slots], before, robot)

    def _floating(self, views: Sequence[View]) -> Bool:
        is_floating = np.zeros(len(self.buffer.centers), bool)
        for label in (Label.OBJECT, Label.ROBOT, BACKDROP):
            slots = np.flatnonzero(self._standing_for(label))
            is_floating[slots] = ~self._is_grounded(self.buffer.centers[slots], views, label)
        return is_floating

    def _relabel(self, robot: RobotPosture | None, seen: Seen) -> Bool:
        return relabel(self.buffer, self.occupancy, robot, seen, 0.5 * self.config.contact_radius)

    def _prune(self, robot: RobotPosture | None, views: Sequence[View], seen: Seen, removed: dict[str, int]) -> None:
        """Remove and count splats that left the robot or the workspace, float, strayed or faded."""
        buffer = self.buffer
        removed["robot"] += buffer.kill(self._relabel(robot, seen))
        removed["seen_through"] += buffer.kill(self._floating(views))
        removed["uncertain"] += buffer.kill(self._strayed(robot, seen))
        removed["workspace"] += buffer.kill(buffer.is_mapped & ~self.workspace.contains(buffer.centers))
        removed["opacity"] += buffer.kill(buffer.is_alive & (buffer.opacities < self.config.min_opacity))

    def _strayed(self, robot: RobotPosture | None, seen: Seen) -> Bool:
        """Object splats (M,) away from the robot that no pixel shows, in never-seen space."""
        is_strayed = np.zeros(len(self.buffer.centers), bool)
        hidden = hidden_objects(self.buffer, robot, seen, self.occupancy.config, np.inf)
        hidden = hidden[~self.occupancy.occupancy_around(self.buffer.centers[hidden])[1]]
        if robot is not None:
            is_strayed[hidden] = ~robot.is_within(self.buffer.centers[hidden], fixed.ROBOT_REACH)
        return is_strayed

    def _remove(self, is_trail: Bool, is_floating: Bool, *, counts_time: bool = True) -> dict[str, int]:
        reasons = removals(
            self.buffer,
            self.occupancy,
            self.workspace,
            self.config.min_opacity,
            is_trail=is_trail,
            is_floating=is_floating,
            counts_time=counts_time,
        )
        return {reason: self.buffer.kill(mask) for reason, mask in reasons.items()}

    def _seed(self, views: Sequence[View], masks: Sequence[SelfMask]) -> Filled:
        """Fill dead slots at M_add's pixels; the first candidates set the density."""
        by_label: dict[Label, list[Seeds]] = {Label.OBJECT: [], Label.ROBOT: []}
        shown = [self.descent.rendering(view) for view in views]
        added = list(self._each(lambda v, its: add_mask(v.frame, its, v.mappable, self.config), views, shown))
        every = thinning(added)

        def offered(index: int) -> list[Seeds]:
            view, others = views[index], spread(range(len(views)), fixed.SEED_ASKED_VIEWS)
            observers = [views[(index + k) % len(views)] for k in others]
            masks_by_label = (
                thin_mask(added[index] & label_pixels(masks[index], label), every) for label in by_label
            )
            sources = (candidates(view.frame, pixels, self.num_threads) for pixels in masks_by_label)
            return [
                source.select(self._is_grounded(source.centers, observers, label))
                for label, source in zip(by_label, sources, strict=True)
            ]

        for offers in self._each(offered, range(len(views))):
            for sources, source in zip(by_label.values(), offers, strict=True):
                sources.append(source)
        everything = [source for sources in by_label.values() for source in sources]
        num_candidates = sum(len(source) for source in everything)
        if not num_candidates:
            return Filled()
        if self.density is None or num_candidates > fixed.SEED_MUCH_MORE * self.density.num_candidates:
            count = max(int(self.config.fill * self.config.max_splats), 1)
            self.density = density_for(everything, count, self.config, self.num_threads)
        reserve = int(self.config.gap_reserve * self.config.max_splats)
        filled = Filled()
        for label, sources in by_label.items():
            if not any(len(source) for source in sources):
                continue
            live = self.buffer.centers[self._standing_for(label)]
            seeds = seeds_at(sources, live, self.density, self.config, self.num_threads)
            if len(views) > fixed.SEED_ASKED_VIEWS:
                seeds = seeds.select(self._is_grounded(seeds.centers, views, label))
            filled += self.buffer.fill(seeds, self.config.initial_opacity, keep_free=reserve, label=label)
        return filled

    def _seed_backdrop(self, views: Sequence[View]) -> Filled:
        opacities = [self.descent.rendering(view).opacity for view in views]
        most = min(int(self.config.shell * self.config.max_splats), int((~self.buffer.is_alive).sum()))
        seeds = backdrop_seeds([view.frame for view in views], opacities, self.descent.background or BLACK, most)
        return self.buffer.fill(seeds, self.config.initial_opacity, label=BACKDROP)

    def _fill_gaps(
        self,
        views: Sequence[View],
        masks: Sequence[SelfMask],
        removed: dict[str, int],
        half: int | None = None,
        is_lasting: Callable[[Float32], Bool] | None = None,
    ) -> Filled:
        """Add splats where measured surfaces are far from all spheres, in alternate halves per step.

        Surfaces in space that was free come first. For missing slots, splats are evicted and counted in `removed`: at
        once for these surfaces, for others every EVICT_EVERY steps.
        """
        filled = Filled()
        for label in (Label.OBJECT, Label.ROBOT):
            splats = self.buffer.splats(self.num_threads, self._standing_for(label))
            bare = np.zeros((0, 3), np.float32)
            if label == Label.OBJECT:
                bare = bare_voxels(self.occupancy, splats, self.workspace, self.config, half)
            seeds = gap_seeds(
                [(v.frame, v.mappable & label_pixels(m, label)) for v, m in zip(views, masks, strict=True)],
                bare,
                self.occupancy.config.voxel,
                splats,
                self.config,
                half=half,
                num_threads=self.num_threads,
                each=self._each,
            )
            seeds = seeds.select(self._is_grounded(seeds.centers, views, label))
            if label == Label.OBJECT and is_lasting is not None:
                seeds = seeds.select(is_lasting(seeds.centers))
            is_due = self.num_steps % fixed.EVICT_EVERY == 0
            num_urgent = len(seeds) if is_due else int(self.occupancy.was_free(seeds.centers).sum())
            num_missing = num_urgent - int((~self.buffer.is_alive).sum())
            if label == Label.OBJECT and num_missing > 0:
                shown, gap = self.descent.misfits(views)[1], self.config.max_gap
                is_evicted, seeds = room_for(seeds, num_missing, self.buffer, self.occupancy, shown, gap)
                removed["evicted"] += self.buffer.kill(is_evicted)
            seeds = seeds.select(np.argsort(~self.occupancy.was_free(seeds.centers), kind="stable"))
            filled += self.buffer.fill(seeds, self.config.initial_opacity, label=label)
        return filled

    def _standing_for(self, label: int) -> Bool:
        labels = np.where(self.buffer.labels == Label.HUMAN, np.uint8(Label.OBJECT), self.buffer.labels)
        return np.asarray(self.buffer.is_alive & (labels == label))

    def _show_contact(
        self, robot: RobotPosture | None, views: Sequence[View], seen: Seen, steady: Sequence[Bool]
    ) -> Filled:
        """Give objects near moving links splats of half `contact_radius`, at most `contact_radius` apart."""
        if robot is None:
            return Filled()
        radius, is_object = 0.5 * self.config.contact_radius, self._standing_for(Label.OBJECT)
        slots = np.flatnonzero(is_object)
        is_near = robot.is_within(self.buffer.centers[slots], fixed.CONTACT_REACH, to_moving=True)
        self.buffer.set_radius(slots[is_near], radius)
        splats = self.buffer.splats(self.num_threads, is_object)
        mappable = [view.mappable & pixels for view, pixels in zip(views, steady, strict=True)]
        seeds = contact_seeds(
            seen, mappable, robot, splats, self.config, num_threads=self.num_threads, each=self._each
        )
        least = max((mask.reach for _, mask in seen), default=0.0)  # noise of depth: less is not seen through
        seeds = seeds.select(self._is_grounded(seeds.centers, views, least=least))
        return self.buffer.fill(seeds, self.config.initial_opacity)

    def _keep_to_surface(self, robot: RobotPosture | None, views: Sequence[View], seen: Seen) -> None:
        """Put object splats on measured depth, and shrink those that protrude before it.

        Near the robot the limit is the depth's error. Elsewhere it is `FAR_PROTRUSION`, while slots are left for the
        gaps.
        """
        if robot is None:
            return
        config, least = self.occupancy.config, 0.5 * self.config.contact_radius
        slots = np.flatnonzero(self._standing_for(Label.OBJECT))
        centers = self.buffer.centers[slots] = move_to_surface(self.buffer.centers[slots], views, config.see_through)
        is_near = robot.is_within(centers, fixed.ROBOT_REACH)
        error = max((mask.reach - config.self_mask_tolerance for _, mask in seen if mask.reach), default=0.0)
        limits = [(is_near, error)]
        if np.mean(~self.buffer.is_alive) > fixed.FAR_IDLE:
            limits.append((~is_near, max(error, fixed.FAR_PROTRUSION)))
        radii = self.buffer.radii[slots]
        for each, limit in limits:
            radii[each] = shrink_radii(centers[each], radii[each], views, limit, least, self.num_threads)
        is_hidden = np.isin(slots, hidden_objects(self.buffer, robot, seen, config))
        self.buffer.set_radius(slots, np.where(is_hidden, np.minimum(radii, np.float32(least)), radii))

    def _use_idle(self, views: Sequence[View], rng: np.random.Generator, removed: dict[str, int]) -> Filled:
        filled, num_weak = use_idle(self.buffer, lambda: self.descent.misfits(views), self.config, rng)
        removed["weak"] += num_weak
        return filled

    def _is_grounded(
        self, points: Float32, views: Sequence[View], label: int = Label.OBJECT, *, least: float = np.inf
    ) -> Bool:
        """True (K,) for points that no view sees through by the smaller of `see_through` and `least` [m].

        least 0 counts as unlimited.
        """
        return ~seen_through(
            points, views, min(self.occupancy.config.see_through, least or np.inf), self.num_threads, label
        )

    def _audit(
        self, views: Sequence[View], filled: Filled, removed: dict[str, int], known: dict[int, LossTerms]
    ) -> AuditRow:
        c, buffer = self.config, self.buffer
        self._unrepresented = None
        counted = [view for view in views if view.target.counted.any()]
        terms = [known.get(id(view)) or self.descent.evaluate(view) for view in counted]
        opacity = float(buffer.opacities[buffer.is_alive].mean()) if buffer.is_alive.any() else 0.0
        loss, psnr = mean_loss(terms, c), psnr_of(terms)
        empty = [view for view in views if not (view.frame.depth > 0).any()]
        return AuditRow(
            stamp_ns=max(view.frame.stamp_ns for view in views),
            cameras=tuple(view.frame.camera for view in views),
            alive=int(buffer.is_mapped.sum()),
            dead=int((buffer.was_used & ~buffer.is_alive).sum()),
            added=filled.added,
            relocated=filled.relocated,
            unmet=filled.unmet,
            evicted=removed["evicted"],
            removed=removed,
            robot=int((buffer.labels[buffer.is_alive] == Label.ROBOT).sum()),
            human=int((buffer.labels[buffer.is_alive] == Label.HUMAN).sum()),
            unrepresented=len(self.unrepresented),
            without_depth=len(empty),
            blind=tuple(dict.fromkeys(view.frame.camera for view in empty)),
            loss=None if loss is None else round(loss + c.lambda_reg * opacity, 6),
            psnr=None if psnr is None else round(psnr, 4),
        )

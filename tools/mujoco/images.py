"""Images of a cell's cameras: colour, depth as the sensor measures it, and the robot's pixels."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from tools.mujoco.cell import SEEN, Cell, Lens, View
from tools.mujoco.depth import COLOR_FROM_DEPTH, DEPTH_LENS, Laser, Stereo, aligned, counted
from tools.mujoco.poses import Float64, pose

COLOR_NOISE = 2.0  # standard deviation of a channel, of 255


@dataclass(frozen=True, kw_only=True)
class Camera:
    """An RGB-D camera: its colour lens and optical frame (4, 4) in the world or in a link's frame. phase [s]: delay
    of its images after each frame's time.
    """

    name: str
    lens: Lens
    T_parent_camera: Float64
    link: str | None = None
    phase: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Image:
    """color (H, W, 3) uint8 and depth (H, W) uint16 [mm] as logged; T_world_camera (4, 4)."""

    color: NDArray[np.uint8]
    depth: NDArray[np.uint16]
    T_world_camera: Float64


def views_of(cameras: Sequence[Camera]) -> list[View]:
    """The imagers of cameras: colour, and depth beside it."""
    out = []
    for camera in cameras:
        out.append(View(name=camera.name, lens=camera.lens, T_parent_view=camera.T_parent_camera, link=camera.link))
        T = camera.T_parent_camera @ pose(COLOR_FROM_DEPTH)
        out.append(View(name=f"{camera.name}.depth", lens=DEPTH_LENS, T_parent_view=T, link=camera.link))
    return out


class Studio:
    """Renders a cell's cameras."""

    def __init__(self, cell: Cell, cameras: Sequence[Camera], sensor: Stereo | Laser | None) -> None:
        self._cell, self._cameras, self._sensor = cell, cameras, sensor
        self._renderer = mujoco.Renderer(cell.model, DEPTH_LENS.height, DEPTH_LENS.width)
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[[0, SEEN]] = 1
        robot = set(cell.geoms_of(cell.links).tolist())
        self._robot = np.array(sorted(robot))
        self._lost = {
            cell.model.geom(f"solid.{solid.name}").id: solid.lost for solid in cell.solids if solid.lost > 0
        }
        self._views = {view.name: view for view in cell.views}

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()

    def image(self, camera: Camera, seed: Sequence[int]) -> Image:
        """Render the image that a camera records of the present state."""
        rng = np.random.default_rng(seed)
        color = self._rendered(camera.name, "color").astype(np.float32)
        color += COLOR_NOISE * rng.standard_normal(color.shape, dtype=np.float32)
        name = camera.name if self._sensor is None else f"{camera.name}.depth"
        exact = self.exact_depth(name)
        lost = np.zeros(exact.shape, dtype=bool)
        if self._lost:
            lost = self._lost_pixels(self._rendered(name, "segments"), rng)
        if self._sensor is None:
            depth = counted(np.where(lost, 0.0, exact))
        else:
            depth = aligned(self._sensor.measured(exact, lost, rng), camera.lens)
        return Image(
            color=np.clip(np.rint(color), 0, 255).astype(np.uint8),
            depth=depth,
            T_world_camera=self._cell.view_pose(self._views[camera.name]),
        )

    def is_robot(self, camera: Camera) -> NDArray[np.bool_]:
        """Pixels (H, W) of the colour camera that show the robot, or a solid fixed to it."""
        return np.isin(self._rendered(camera.name, "segments"), self._robot)

    def exact_depth(self, name: str) -> Float64:
        """Exact depth (H, W) [m] of an imager, 0 beyond the far plane."""
        z = self._rendered(name, "depth").astype(np.float64)
        return np.where(z < 8.5, z, 0.0)

    def _lost_pixels(self, geoms: NDArray[np.generic], rng: np.random.Generator) -> NDArray[np.bool_]:
        """Pixels (H, W) of dark or shiny solids that return no depth, in blobs of six pixels."""
        out = np.zeros(geoms.shape, dtype=bool)
        for geom, share in self._lost.items():
            coarse = rng.random((geoms.shape[0] // 6 + 1, geoms.shape[1] // 6 + 1)) < share
            blobs = np.repeat(np.repeat(coarse, 6, axis=0), 6, axis=1)[: geoms.shape[0], : geoms.shape[1]]
            out |= (geoms == geom) & blobs
        return out

    def _rendered(self, name: str, what: str) -> NDArray[np.generic]:
        renderer = self._renderer
        renderer.disable_depth_rendering()
        renderer.disable_segmentation_rendering()
        if what == "depth":
            renderer.enable_depth_rendering()
        elif what == "segments":
            renderer.enable_segmentation_rendering()
        renderer.update_scene(self._cell.data, name, scene_option=self._option)
        image = renderer.render()
        if what != "segments":
            return np.asarray(image)
        is_geom = image[..., 1] == int(mujoco.mjtObj.mjOBJ_GEOM)
        return np.where(is_geom, image[..., 0], -1)

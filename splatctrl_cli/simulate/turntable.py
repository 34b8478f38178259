"""A scene that stands still, seen from a fan of views, in the manner of a DTU scan."""

from collections.abc import Iterator

import numpy as np

from splatctrl_cli.geometry import look_at
from splatctrl_cli.records import Bool, Intrinsics, RgbdFrame
from splatctrl_cli.simulate.render import Camera, Renderer
from splatctrl_cli.simulate.tabletop import furniture, things

NUM_VIEWS = 8
SIZE = (256, 208)  # width, height [px]
LEAST_DEPTH = 1e-4  # [m] by which a thing stands before the furniture
TARGET = (0.60, 0.02, 0.06)  # [m] the middle of the things


def views() -> Iterator[RgbdFrame]:
    """Exact views of the tabletop's things from an arc of 70 degrees at two heights; the stamp is the number."""
    width, height = SIZE
    intrinsics = Intrinsics(
        fx=1.15 * width,
        fy=1.15 * width,
        cx=(width - 1) / 2 + 2.4,
        cy=(height - 1) / 2 + 1.7,
        width=width,
        height=height,
    )
    scene = furniture() + things()
    for number in range(NUM_VIEWS):
        angle = np.deg2rad(-90.0 + 70.0 * number / (NUM_VIEWS - 1))
        height_above = 0.52 if number % 2 == 0 else 0.68
        eye = np.array(TARGET) + np.array([0.80 * np.cos(angle), 0.80 * np.sin(angle), height_above])
        camera = Camera(
            name=f"view{number}", intrinsics=intrinsics, T_world_camera=look_at(eye, TARGET), is_training=True
        )
        color, depth = Renderer(camera, scene).image([])
        yield RgbdFrame(
            stamp_ns=number,
            camera=camera.name,
            color=color,
            depth=depth,
            intrinsics=intrinsics,
            T_world_camera=camera.T_world_camera,
        )


def object_mask(frame: RgbdFrame) -> Bool:
    """(H, W) True where a view shows one of the things, not the furniture."""
    camera = Camera(
        name=frame.camera, intrinsics=frame.intrinsics, T_world_camera=frame.T_world_camera, is_training=True
    )
    behind = Renderer(camera, furniture(), color_rays=0).depth([])
    return np.asarray((frame.depth > 0) & ((behind == 0) | (frame.depth < behind - LEAST_DEPTH)))

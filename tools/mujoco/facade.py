"""`python -m tools.mujoco facade OUT`: photographs of a facade at 6 to 9 m, exact poses, depth by stereo matching.

MuJoCo renders; OpenCV matches each view with a second view to its right. Every eighth view is held out, with exact
depth.
"""

import argparse
import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT, FOCAL = 640, 480, 525.0
NUM_VIEWS, HELD_OUT = 40, 8
COLOR_NOISE = 2.0  # standard deviation of a channel, of 255
SKY, NEAREST, FARTHEST = 40.0, 3.9, 14.0  # [m] of exact depth, and of matches
UNLIKE = 1.0  # [px] between matches from left and right
PLAIN = 1.6  # times the noise's variance: less texture has no match
MATERIALS = {  # rows and columns of bricks, joint [px], colour, repetitions per metre
    "brick": (32, 16, 3, (150, 105, 85), 0.4),
    "stucco": (2, 2, 0, (205, 195, 170), 0.3),
    "glass": (4, 2, 10, (60, 75, 90), 1.2),
    "ground": (16, 16, 3, (110, 110, 105), 0.3),
    "wood": (8, 4, 3, (90, 60, 40), 1.0),
}

UInt8 = NDArray[np.uint8]
Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]


def main(words: Sequence[str]) -> int:
    """Write the views that the command line describes."""
    parser = argparse.ArgumentParser(prog="python -m tools.mujoco facade", description=__doc__, allow_abbrev=False)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--baseline", type=float, default=1.2, help="[m] of the matched views")
    parser.add_argument("--finer", type=int, default=2, help="pixels along one, at which they are matched")
    args = parser.parse_args(words)
    if args.baseline <= 0 or args.finer < 1:
        parser.error("expected --baseline above 0 m and --finer of at least 1 pixel")
    write_views(args.out, args.seed, args.baseline, args.finer)
    return 0


def write_views(out: Path, seed: int, baseline: float = 1.2, finer: int = 2) -> None:
    """Write images, poses and `facade.toml`, which describes them.

    baseline [m]: between matched views. finer: matching's pixels per image pixel, in each direction.
    """
    out.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    camera, names = Camera(build_facade(rng)), [f"{k:03d}" for k in range(NUM_VIEWS)]
    for k, T in enumerate(choose_poses(rng)):
        T_right = T.copy()
        T_right[:3, 3] += baseline * T[:3, 0]
        (color, exact), (right, _) = camera.take(T), camera.take(T_right)
        color, right = (add_noise(image, rng) for image in (color, right))
        depth = exact if k % HELD_OUT == HELD_OUT // 2 else match(color, right, baseline, finer)
        cv2.imwrite(str(out / f"{names[k]}.color.png"), color[..., ::-1])
        cv2.imwrite(str(out / f"{names[k]}.depth.png"), np.round(1000 * depth).astype(np.uint16))
        np.savetxt(out / f"{names[k]}.pose.txt", T, fmt="%.17g")
    held_out = ", ".join(f'"{name}"' for name in names[HELD_OUT // 2 :: HELD_OUT])
    (out / "facade.toml").write_text(
        f'root = "."\n[camera]\nwidth = {WIDTH}\nheight = {HEIGHT}\nfx = {FOCAL}\nfy = {FOCAL}\n'
        f"cx = {(WIDTH - 1) / 2}\ncy = {(HEIGHT - 1) / 2}\n"
        '[frames]\ncolor = "*.color.png"\ndepth = "*.depth.png"\n[depth]\nscale = 1e-3\n'
        f'[poses]\nformat = "matrix-files"\nfile = "*.pose.txt"\n[split]\nholdout = [{held_out}]\n'
    )


def draw_texture(rng: np.random.Generator, rows: int, columns: int, joint: int, color: tuple[int, ...]) -> UInt8:
    """Bricks (1024, 1024, 3) of `color`, with noise of all scales."""
    size, noise = 1024, np.zeros((1024, 1024))
    for octave in range(2, 9):
        coarse = rng.normal(size=(2**octave, 2**octave))
        noise += cv2.resize(coarse, (size, size), interpolation=cv2.INTER_CUBIC) / octave
    v, u = np.mgrid[:size, :size]
    row = v * rows // size
    along = u + row % 2 * (size // columns // 2)
    tones = rng.normal(size=(rows, columns + 1))
    image = np.array(color) + (12 * noise + 14 * tones[row, along * columns // size])[..., None]
    is_joint = (v % (size // rows) < joint) | (along % (size // columns) < joint)
    image[is_joint] = np.array([190, 185, 175]) + 8 * noise[is_joint, None]
    drawn: UInt8 = np.clip(image, 0, 255).astype(np.uint8)
    return drawn


def boxes() -> Iterator[tuple[str, float, float, float, float, float, float]]:
    """Material, centre and half sizes [m] of the facade's parts; the street lies at negative y."""
    yield "brick", 0, 0.6, 3.2, 5.5, 0.3, 3.2
    for x in np.linspace(-5.5, 5.5, 6):
        yield "stucco", x, 0.15, 3.2, 0.55, 0.15, 3.2
        yield "stucco", x, -0.05, 3.2, 0.25, 0.1, 3.2
    for z in (0.5, 3.2, 5.9):
        yield "brick", 0, 0.15, z, 5.5, 0.15, 0.5
    for x in np.linspace(-4.4, 4.4, 5):
        for z in (1.85, 4.55):
            yield "glass", x, 0.28, z, 0.55, 0.02, 0.85
            yield "stucco", x, -0.08, z - 0.92, 0.62, 0.12, 0.07
    yield "stucco", 0, -0.2, 6.45, 5.8, 0.4, 0.12  # cornice
    yield "stucco", 0, -0.35, 3.2, 1.6, 0.35, 0.1  # balcony and its rail
    yield "stucco", 0, -0.65, 4.22, 1.6, 0.05, 0.04
    for x in np.linspace(-1.5, 1.5, 9):
        yield "wood", x, -0.65, 3.75, 0.03, 0.03, 0.45
    yield "wood", 0, -0.02, 1.1, 0.6, 0.05, 1.1


def build_facade(rng: np.random.Generator) -> mujoco.MjModel:
    assets, materials, geoms = {}, io.StringIO(), io.StringIO()
    for name, (rows, columns, joint, color, repetitions) in MATERIALS.items():
        texture = draw_texture(rng, rows, columns, joint, color)
        assets[f"{name}.png"] = cv2.imencode(".png", texture[..., ::-1])[1].tobytes()
        materials.write(
            f'<texture name="{name}" type="2d" file="{name}.png"/><material name="{name}" texture="{name}"'
            f' texuniform="true" texrepeat="{repetitions} {repetitions}" specular="0" reflectance="0"/>'
        )
    for name, x, y, z, a, b, c in boxes():  # a texture lies in a geom's x and y
        geoms.write(f'<geom type="box" material="{name}" pos="{x} {y} {z}" size="{a} {c} {b}" euler="90 0 0"/>')
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><visual><global offwidth="{WIDTH}" offheight="{HEIGHT}"/><map znear="0.02" zfar="20"/>'
        '<headlight ambient="0.55 0.55 0.55" diffuse="0 0 0" specular="0 0 0"/><quality shadowsize="4096"/></visual>'
        '<asset><texture type="skybox" builtin="gradient" rgb1="0.55 0.7 0.9" rgb2="0.8 0.87 0.95" width="256"'
        f' height="256"/>{materials.getvalue()}</asset><worldbody><light directional="true" pos="-6 -10 14"'
        ' dir="0.5 0.8 -1" diffuse="0.6 0.6 0.55" specular="0 0 0"/><geom type="plane" material="ground"'
        f' size="20 20 0.1"/>{geoms.getvalue()}</worldbody></mujoco>',
        assets,
    )


def choose_poses(rng: np.random.Generator) -> Iterator[Float64]:
    """T_world_camera (4, 4) along the street, at two heights in turn, towards the facade."""
    for k in range(NUM_VIEWS):
        x = 8.0 * (k // 2) / (NUM_VIEWS // 2 - 1) - 4.0 + rng.uniform(-0.3, 0.3)
        height = rng.uniform(2.6, 3.4) if k % 2 == 0 else rng.uniform(1.4, 1.9)
        eye = np.array([x, -rng.uniform(5.5, 8.0), height])
        forward = np.array([0.6 * x + rng.uniform(-0.8, 0.8), 0.0, rng.uniform(2.4, 3.8)]) - eye
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        T = np.eye(4)
        T[:3] = np.column_stack([right, np.cross(forward, right), forward, eye])
        yield T


class Camera:
    """Draws a model without moving parts."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model, self._state = model, mujoco.MjData(model)
        mujoco.mj_forward(model, self._state)
        self._renderer = mujoco.Renderer(model, HEIGHT, WIDTH)

    def take(self, T_world_camera: Float64) -> tuple[UInt8, Float32]:
        """Colour (H, W, 3) and exact depth (H, W) [m], 0 in the sky."""
        renderer, visual, extent = self._renderer, self._model.vis.map, self._model.stat.extent
        renderer.update_scene(self._state)
        near = visual.znear * extent
        for eye in renderer.scene.camera:
            eye.pos, eye.forward, eye.up = T_world_camera[:3, 3], T_world_camera[:3, 2], -T_world_camera[:3, 1]
            eye.frustum_near, eye.frustum_far, eye.frustum_center = near, visual.zfar * extent, 0.0
            eye.frustum_top, eye.frustum_width = near * HEIGHT / 2 / FOCAL, near * WIDTH / 2 / FOCAL
            eye.frustum_bottom = -eye.frustum_top
        color = renderer.render().copy()
        renderer.enable_depth_rendering()
        depth = renderer.render().copy()
        renderer.disable_depth_rendering()
        return color, np.where(depth < SKY, depth, np.float32(0))


def add_noise(color: UInt8, rng: np.random.Generator) -> UInt8:
    return np.clip(color + rng.normal(0, COLOR_NOISE, color.shape), 0, 255).astype(np.uint8)


def match(left: UInt8, right: UInt8, baseline: float, finer: int) -> Float32:
    """Depth (H, W) [m] of the left image by semi-global matching; 0 without texture, or if matches disagree."""
    num_disparities = 16 * math.ceil(finer * FOCAL * baseline / NEAREST / 16)
    matcher = cv2.StereoSGBM.create(0, num_disparities, 5, 8 * 75, 32 * 75, 1, 0, 15, 100, 2, cv2.STEREO_SGBM_MODE_HH)
    gray, other = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (left, right))
    fine, other = (cv2.resize(i, None, fx=finer, fy=finer, interpolation=cv2.INTER_CUBIC) for i in (gray, other))
    disparity = matcher.compute(fine, other).astype(np.float32)[::finer, ::finer] / (16 * finer)
    back = cv2.flip(matcher.compute(cv2.flip(other, 1), cv2.flip(fine, 1)).astype(np.float32), 1)
    back = back[::finer, ::finer] / (16 * finer)
    u = np.arange(WIDTH)[None] - np.round(disparity).astype(np.int64)
    is_matched = (disparity > 1) & (u >= 0)
    is_matched &= np.abs(disparity - np.take_along_axis(back, np.clip(u, 0, WIDTH - 1), 1)) < UNLIKE
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), 2.0)
    is_matched &= cv2.GaussianBlur(np.square(gray - smooth), (0, 0), 4.0) > PLAIN * COLOR_NOISE**2
    depth = FOCAL * baseline / np.maximum(disparity, 0.1)
    return np.where(is_matched & (depth < FARTHEST), depth, 0.0).astype(np.float32)

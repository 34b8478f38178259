"""The optimiser iteration of `iteration.py` in plain torch operations on the CPU, with autograd: the reference.

The same equations, tiles of 16 pixels and constants as the compiled kernels. Tile lists are padded to the longest
list in a row of tiles. The row is then blended at once, because plain torch has no such kernel.
"""

import numpy as np
import torch

from benchmarks.scenes import FitProblem
from splatctrl_cli.kernels.raster import LossWeights, OptimiserSettings

TILE, DILATION, MIN_ALPHA, MAX_ALPHA, MIN_TRANSMITTANCE, MARGIN = 16, 0.3, 1 / 255, 0.99, 1e-4, 1.3
NOISE_GATE, LARGEST_LOGIT = 100.0, 6.9


class TorchIteration:
    """One iteration at a time; `parameters` are centre, log radius, colour and logit opacity, one tensor each."""

    def __init__(self, problem: FitProblem, weights: LossWeights, settings: OptimiserSettings) -> None:
        start = torch.from_numpy(problem.parameters)
        parts = [start[:, :3], start[:, 3], start[:, 4:7], start[:, 7]]
        self.parameters = [part.clone().requires_grad_() for part in parts]
        rates = [settings.lr_center, settings.lr_log_radius, settings.lr_color, settings.lr_logit_opacity]
        groups = [{"params": [p], "lr": lr} for p, lr in zip(self.parameters, rates, strict=True)]
        self.optimiser = torch.optim.Adam(groups, eps=1e-15)
        self.camera = problem.camera.tolist()
        self.color = torch.from_numpy(problem.target.color / np.float32(255.0))
        self.depth = torch.from_numpy(problem.target.depth)
        self.weights, self.settings = weights, settings
        line = torch.exp(-((torch.arange(11.0) - 5) ** 2) / (2 * 1.5**2))
        self.window = line / line.sum()

    def run(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Render, loss, backward, Adam and noise; returns the planes (5, H, W) and the loss before the step."""
        self.optimiser.zero_grad()
        planes = self._render()
        loss = self._loss(planes)
        torch.autograd.backward(loss)
        self.optimiser.step()
        self._limit_and_shake()
        return planes.detach(), loss.detach()

    def _render(self) -> torch.Tensor:
        width, height = int(self.camera[4]), int(self.camera[5])
        features, footprint = self._project()
        rows = [self._render_row(features, footprint, y0, width) for y0 in range(0, height, TILE)]
        return torch.cat(rows, dim=1)[:, :height, :width]

    def _render_row(self, features: torch.Tensor, footprint: torch.Tensor, y0: int, width: int) -> torch.Tensor:
        """A row of tiles (5, 16, tiles * 16); the whole image at once took five times as long."""
        lists, is_entry = _tile_lists(footprint.detach(), y0, width)
        within = torch.arange(TILE * TILE)
        u = (torch.arange(len(lists)) * TILE)[:, None] + within % TILE
        v = y0 + within // TILE
        mean_u, mean_v, a, b, c, opacity, _, _ = footprint[lists].unbind(2)
        du, dv = u[:, None, :] - mean_u[:, :, None], v - mean_v[:, :, None]
        power = -0.5 * (a[:, :, None] * du * du + c[:, :, None] * dv * dv) - b[:, :, None] * du * dv
        alpha = (opacity[:, :, None] * torch.exp(power)).clamp(max=MAX_ALPHA)
        alpha = torch.where((alpha >= MIN_ALPHA) & is_entry[:, :, None], alpha, 0.0)
        after = torch.cumprod(1 - alpha, dim=1)
        before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
        weight = torch.where(after >= MIN_TRANSMITTANCE, alpha * before, 0.0)
        blended = torch.bmm(features[lists].transpose(1, 2), weight)  # (tiles, 5, 256)
        return blended.reshape(-1, 5, TILE, TILE).permute(1, 2, 0, 3).reshape(5, TILE, -1)

    def _project(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Features (N, 5) to blend, and u, v, conic a, b, c, opacity, half width and height (N, 8), by depth."""
        fx, fy, cx, cy, width, height = self.camera[:6]
        centers, log_radii, colors, logits = self.parameters
        points = centers @ torch.tensor(self.camera[6:15]).reshape(3, 3).T + torch.tensor(self.camera[15:18])
        x, y, z = points.unbind(1)
        tx = (x / z).clamp(-MARGIN * (cx + 0.5) / fx, MARGIN * (width - 0.5 - cx) / fx)
        ty = (y / z).clamp(-MARGIN * (cy + 0.5) / fy, MARGIN * (height - 0.5 - cy) / fy)
        q = (torch.exp(log_radii) / z) ** 2
        A, C = q * fx**2 * (1 + tx**2) + DILATION, q * fy**2 * (1 + ty**2) + DILATION
        B = q * fx * fy * tx * ty
        det = A * C - B * B
        opacity = torch.sigmoid(logits)
        level = 2 * torch.log((255 * opacity).clamp(min=1.0))
        half_width, half_height = torch.sqrt(level * A + 1e-12), torch.sqrt(level * C + 1e-12)
        footprint = [fx * x / z + cx, fy * y / z + cy, C / det, -B / det, A / det, opacity, half_width, half_height]
        order = torch.argsort(z.detach(), stable=True)
        features = torch.stack([*colors.unbind(1), z, torch.ones_like(z)], 1)
        return features[order], torch.stack(footprint, 1)[order]

    def _loss(self, planes: torch.Tensor) -> torch.Tensor:
        w, color, opacity = self.weights, planes[:3], planes[4]
        l1 = (color - self.color).abs().mean()
        d_ssim = 1 - self._ssim(color, self.color).mean()
        depth = torch.where(opacity > 0.1, planes[3] / opacity, planes[3]) if w.normalised else planes[3]
        is_valid = self.depth > 0
        l_depth = (depth - self.depth).abs()[is_valid].mean()
        empty = (1 - opacity)[is_valid].mean()
        reg = self.settings.regulariser * torch.sigmoid(self.parameters[3]).sum()
        return w.color * ((1 - w.dssim) * l1 + w.dssim * d_ssim) + w.depth * l_depth + w.opacity * empty + reg

    def _ssim(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        maps = torch.cat([x, y, x * x, y * y, x * y])[None]
        count = maps.shape[1]
        row = self.window.reshape(1, 1, 1, 11).repeat(count, 1, 1, 1)
        maps = torch.nn.functional.conv2d(maps, row, padding=(0, 5), groups=count)
        maps = torch.nn.functional.conv2d(maps, row.transpose(2, 3), padding=(5, 0), groups=count)
        mx, my, xx, yy, xy = maps[0].reshape(5, 3, *x.shape[1:])
        c1, c2 = 0.01**2, 0.03**2
        structure = (2 * (xy - mx * my) + c2) / (xx - mx * mx + yy - my * my + c2)
        ssim: torch.Tensor = (2 * mx * my + c1) / (mx * mx + my * my + c1) * structure
        return ssim

    @torch.no_grad()
    def _limit_and_shake(self) -> None:
        centers, log_radii, colors, logits = self.parameters
        s = self.settings
        log_radii.clamp_(float(torch.log(torch.tensor(s.min_radius))), float(torch.log(torch.tensor(s.max_radius))))
        colors.clamp_(0.0, 1.0)
        logits.clamp_(-LARGEST_LOGIT, LARGEST_LOGIT)
        radii = torch.exp(log_radii)
        scale = s.noise * s.lr_center * radii**2
        scale = scale * torch.sigmoid(-NOISE_GATE * (torch.sigmoid(logits) - s.min_opacity))
        step = scale[:, None] * torch.randn_like(centers)
        half = 0.5 * radii[:, None]
        centers += torch.maximum(torch.minimum(step, half), -half)


def _tile_lists(footprint: torch.Tensor, y0: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Splats (tiles, K) of each tile of the row at y0, front to back, and a mask of entries that are not padding."""
    u, v, half_width, half_height = footprint[:, [0, 1, 6, 7]].T
    in_row = ((v + half_height >= y0) & (v - half_height <= y0 + TILE - 1)).nonzero()[:, 0]
    u, half_width = u[in_row], half_width[in_row]
    x0 = torch.arange(0, width, TILE)[:, None]
    meets = (u + half_width >= x0) & (u - half_width <= x0 + TILE - 1)
    tile, entry = meets.nonzero(as_tuple=True)
    counts = meets.sum(1)
    place = torch.arange(len(tile)) - (counts.cumsum(0) - counts)[tile]
    lists = torch.zeros(len(counts), int(counts.max()), dtype=torch.long)
    lists[tile, place] = in_row[entry]
    return lists, torch.arange(lists.shape[1]) < counts[:, None]

"""Views of scenes with depth on a device, pairs of them, and where points of one lie in the other."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

# A point is seen where the depth there is its own to this share.
_SAME_DEPTH = 0.02
# Where depths around a point differ by more there is an edge: it lies on what its nearest pixel shows.
_EDGE = 0.05
_RASTER = 16
_MIN_OVERLAP = 0.2


class Views(NamedTuple):
    """B views.

    Attributes:
        light: (B, 1, H, W) radiance.
        depth: (B, 1, H, W) z at the pixels' centres; infinite where there is nothing.
        camera: (B, 3) focal length and centre, pixels.
        T_world_camera: (B, 4, 4) float64.
    """

    light: Tensor
    depth: Tensor
    camera: Tensor
    T_world_camera: Tensor

    def take(self, index: Tensor) -> "Views":
        """Some of them."""
        return Views(*(each[index] for each in self))


class Places(NamedTuple):
    """Of points of a view in another: pixels (B, N, 2), whether they are in the image and seen there, (B, N) bool."""

    pixels: Tensor
    inside: Tensor
    visible: Tensor


def transfer(source: Views, target: Views, points: Tensor) -> Places:
    """Where points (B, N, 2) of each source lie in the target of the same number."""
    # The inverse of a rigid motion; a solver would wait for the device.
    R = target.T_world_camera[:, :3, :3].transpose(1, 2)
    t = source.T_world_camera[:, :3, 3:] - target.T_world_camera[:, :3, 3:]
    R_target_source = (R @ source.T_world_camera[:, :3, :3]).to(points.dtype)
    t_target_source = (R @ t).squeeze(-1).to(points.dtype)
    inverse = _inverse_depth(source.depth, points)
    seen = inverse > 1e-6
    z = 1.0 / inverse.clamp_min(1e-6)
    focal, centre = source.camera[:, None, :1], source.camera[:, None, 1:]
    rays = torch.cat([(points - centre) / focal, torch.ones_like(points[..., :1])], dim=-1)
    moved = (R_target_source[:, None] * rays[..., None, :]).sum(dim=-1) * z[..., None] + t_target_source[:, None]
    front = moved[..., 2] > 1e-3
    depth = moved[..., 2].clamp_min(1e-3)
    pixels = moved[..., :2] / depth[..., None] * target.camera[:, None, :1] + target.camera[:, None, 1:]
    height, width = target.depth.shape[-2:]
    last = torch.tensor([width - 1, height - 1], dtype=pixels.dtype, device=pixels.device)
    inside = seen & front & ((pixels >= 0) & (pixels <= last)).all(dim=-1)
    corner = pixels.nan_to_num(0.0).clamp_min(0.0).minimum(last).floor().long()
    flat = target.depth.flatten(1)
    differs = torch.full_like(depth, torch.inf)
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):
        u, v = (corner[..., 0] + du).clamp_max(width - 1), (corner[..., 1] + dv).clamp_max(height - 1)
        differs = torch.minimum(differs, (flat.gather(1, v * width + u) / depth - 1.0).abs())
    return Places(
        torch.where(seen[..., None] & front[..., None], pixels, -1e3), inside, inside & (differs < _SAME_DEPTH)
    )


def _inverse_depth(depth: Tensor, points: Tensor) -> Tensor:
    """At points (B, N, 2); of the nearest pixel beside edges."""
    height, width = depth.shape[-2:]
    inverse = 1.0 / depth.flatten(1)
    corner = points.floor()
    fraction = points - corner
    u0, v0 = corner[..., 0].long(), corner[..., 1].long()

    def at(u: Tensor, v: Tensor) -> Tensor:
        return inverse.gather(1, v.clamp(0, height - 1) * width + u.clamp(0, width - 1))

    values = torch.stack([at(u0, v0), at(u0 + 1, v0), at(u0, v0 + 1), at(u0 + 1, v0 + 1)], dim=-1)
    du, dv = fraction.unbind(dim=-1)
    weights = torch.stack([(1 - du) * (1 - dv), du * (1 - dv), (1 - du) * dv, du * dv], dim=-1)
    smooth = values.amin(dim=-1) > (1.0 - _EDGE) * values.amax(dim=-1)
    nearest = values.gather(-1, weights.argmax(dim=-1, keepdim=True)).squeeze(-1)
    return torch.where(smooth, (values * weights).sum(dim=-1), nearest)


class ViewStore:
    """A ring of scenes with V views each, out of which pairs that overlap are drawn.

    Args:
        scenes: places.
        views: V.
        size: side of the square images.
        device: where all lies.
    """

    def __init__(self, scenes: int, views: int, size: int, device: torch.device) -> None:
        shape = scenes, views
        self._views = Views(
            torch.zeros((*shape, 1, size, size), dtype=torch.float16, device=device),
            torch.full((*shape, 1, size, size), torch.inf, device=device),
            torch.ones((*shape, 3), device=device),
            torch.eye(4, dtype=torch.float64, device=device).expand(*shape, 4, 4).clone(),
        )
        self._good = torch.zeros((scenes, views, views), device=device)
        self.filled, self._next, self._scenes, self._count = 0, 0, scenes, views

    def add(self, views: Views) -> None:
        """A scene's V views, B = V."""
        for kept, new in zip(self._views, views, strict=True):
            kept[self._next] = new.to(kept)
        count, device = self._count, views.depth.device
        first = torch.arange(count, device=device).repeat_interleave(count)
        second = torch.arange(count, device=device).repeat(count)
        size = views.depth.shape[-1]
        ticks = (torch.arange(_RASTER, device=device) + 0.5) * size / _RASTER
        raster = torch.stack(torch.meshgrid(ticks, ticks, indexing="xy"), dim=-1).reshape(1, -1, 2)
        views = views._replace(depth=views.depth.float(), camera=views.camera.float())
        seen = transfer(views.take(first), views.take(second), raster.expand(len(first), -1, -1)).visible
        overlap = seen.float().mean(dim=1).view(count, count)
        overlap = torch.minimum(overlap, overlap.T) * (1.0 - torch.eye(count, device=device))
        self._good[self._next] = (overlap > _MIN_OVERLAP).float()
        self._next = (self._next + 1) % self._scenes
        self.filled = min(self.filled + 1, self._scenes)

    def draw(self, count: int, generator: torch.Generator) -> tuple[Views, Views]:
        """Pairs, drawn alike among all that overlap."""
        good = self._good[: self.filled].flatten()
        if not bool(good.any()):
            good = torch.ones_like(good)
        # Scenes alike, whatever number of their pairs overlap.
        good = good.view(self.filled, -1)
        share = good / good.sum(dim=1, keepdim=True).clamp_min(1.0)
        index = torch.multinomial(share.flatten(), count, replacement=True, generator=generator)
        scene, pair = index // self._count**2, index % self._count**2
        sides = []
        for view in (pair // self._count, pair % self._count):
            light, depth, camera, T = (each[scene, view] for each in self._views)
            sides.append(Views(light.float(), depth, camera, T))
        return sides[0], sides[1]


def sample(maps: Tensor, points: Tensor) -> Tensor:
    """Bilinear values (B, N) of (B, 1, H, W) at pixels (B, N, 2)."""
    height, width = maps.shape[-2:]
    scale = torch.tensor([2.0 / width, 2.0 / height], device=points.device)
    grid = ((points + 0.5) * scale - 1.0).unsqueeze(1)
    return functional.grid_sample(maps, grid, align_corners=False, padding_mode="border")[:, 0, 0]

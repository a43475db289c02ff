"""Where a point of one view appears in another, and whether it is seen there: flow, disparity, occlusion, tracks."""

from typing import NamedTuple

import torch
from torch import Tensor

from sigmaslam_synthetic.rendering.renderer import RenderedViews
from sigmaslam_synthetic.rendering.visibility import Sight, move

_BORDER = 1e-6  # pixels; what stands still at the image's edge stays in it whatever the rounding


class ProjectedPoints(NamedTuple):
    """N points of a source view in a target view.

    Attributes:
        pixels: (2, N) float64 in the target; NaN where there is no such pixel.
        depth: (N,) float64 z in the target, metres.
        visible: (N,) bool: in front of the target's camera, inside its image and not hidden.
    """

    pixels: Tensor
    depth: Tensor
    visible: Tensor


def transfer(
    source: Sight, source_view: Tensor, facet: Tensor, places: Tensor, target: Sight, target_view: Tensor
) -> ProjectedPoints:
    """Moves N seen points from views of one sight to views of another; bodies move along.

    Args:
        source, target: of the same renderer.
        source_view, target_view: (N,) int64.
        facet: (N,) int64, what is seen in the source.
        places: (2, N) float64 on the source's grid.
    """
    return arrive(target, target_view, source.points(source_view, facet, places), facet)


def arrive(target: Sight, view: Tensor, points: Tensor, facet: Tensor, occlusion: bool = True) -> ProjectedPoints:
    """Points (3, N), each in the frame of its facet's mover, seen from views (N,) of a sight.

    Without `occlusion` what hides them is not asked for, which saves drawing the target.
    """
    mover = target.surfaces.mover.index_select(0, facet)
    there = move(target.T_view_mover, view, mover, points)
    depth = there[2]
    front = depth > target.near
    pixels, seen_at = target.eye.project(torch.where(front, there, torch.ones_like(there)))
    pixels = torch.where(front, pixels, torch.nan)
    camera = target.eye.camera
    within = (pixels + _BORDER >= 0).all(dim=0)
    inside = within & (pixels[0] <= camera.width - 1 + _BORDER) & (pixels[1] <= camera.height - 1 + _BORDER)
    visible = front & inside
    if occlusion:
        index = visible.nonzero().squeeze(1)
        visible[index] = ~target.hidden(view[index], seen_at[:, index], 1.0 / depth[index], facet[index])
    return ProjectedPoints(pixels, depth, visible)


def at_pixels(views: RenderedViews, view: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """What is seen at pixels (2, N) of views (N,): facets (N,), -1 for none, and places on the grid (2, N)."""
    places = views.sight.eye.to_grid(pixels)
    on_grid = places.isfinite().all(dim=0)
    facet = torch.full_like(view, -1)
    facet[on_grid] = views.sight.resolve(view[on_grid], places[:, on_grid])
    return facet, places


def flow(source: RenderedViews, target: Sight, occlusion: bool = True) -> tuple[Tensor, Tensor]:
    """Flow of every pixel from the views of `source` to those of the same number in `target`.

    Returns:
        (V, H, W, 2) float32 pixels, NaN where nothing is seen or the point leaves the front of the camera; (V, H, W)
        bool, whether the point is visible in the target; see `arrive` for `occlusion`.
    """
    shape = source.facet.shape
    facet = source.facet.reshape(-1)
    hit = (facet >= 0).nonzero().squeeze(1)
    view = hit // (shape[1] * shape[2])
    within = hit - view * (shape[1] * shape[2])
    sight = source.sight
    places = sight.eye.centres(facet.device)[:, within]
    seen = facet[hit]
    mover = sight.surfaces.mover.index_select(0, seen)
    in_view = sight.eye.rays(places) * source.depth.reshape(-1)[hit]
    points = move(torch.linalg.inv(sight.T_view_mover), view, mover, in_view)
    moved = arrive(target, view, points, seen, occlusion)
    row = within // shape[2]
    pixels = torch.stack([within - row * shape[2], row])
    result = torch.full((facet.numel(), 2), torch.nan, dtype=torch.float32, device=facet.device)
    result[hit] = (moved.pixels - pixels).float().T
    visible = torch.zeros_like(facet, dtype=torch.bool)
    visible[hit] = moved.visible
    return result.reshape(*shape, 2), visible.reshape(shape)

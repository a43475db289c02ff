"""Blob detection as a graph: Hessian response, maxima, sub-pixel peaks, all exportable to ONNX.

Published learned detectors localise worse than classical ones (repeatability within 1 px), so the network only says
which keypoints are worth keeping. Of the classical ones the determinant of the Hessian repeats best
(docs/notebook, features).
"""

import torch
from torch import Tensor
from torch.nn import functional

CELL = 4
"""Images are worked on as cells of CELL x CELL pixels, one channel a pixel: convolutions run ten times faster so."""
BORDER = 8
_SIGMA = 1.4
# Reach of the filters, pixels: a cell and its neighbours hold it.
_REACH = 4
_NMS_WINDOW = 3
# Less is round-off: one grey level of 255 gives 1e-6.
_MIN_RESPONSE = 1e-9
# Response is compared with its surroundings to this power: 0 keeps the strongest peaks wherever they crowd, 1 spreads
# them as evenly as texture allows.
_EVENING_POWER = 0.75
_EVENING_CELLS = 4
_EVENING_WINDOW = 5


def to_cells(image: Tensor) -> Tensor:
    """(B, 1, H, W) -> (B, 16, H/4, W/4), channel 4 i + j is pixel (i, j) of the cell; H and W multiples of 4.

    `functional.pixel_unshuffle` as a convolution, which ONNX Runtime computes eight times faster.
    """
    return functional.conv2d(image, _pixels_of_a_cell(image), stride=CELL)


def to_half_cells(image: Tensor) -> Tensor:
    """Cells of the image at half its size (means of 2x2 pixels): (B, 1, H, W) -> (B, 16, H/8, W/8)."""
    mean = _pixels_of_a_cell(image).repeat_interleave(2, dim=2).repeat_interleave(2, dim=3) / 4.0
    return functional.conv2d(image, mean, stride=2 * CELL)


def _pixels_of_a_cell(image: Tensor) -> Tensor:
    """(16, 1, 4, 4): filter k picks pixel k of a cell; of the image's type and device."""
    size = CELL * CELL
    return torch.eye(size, dtype=image.dtype, device=image.device).view(size, 1, CELL, CELL)


def hessian_response(cells: Tensor) -> Tensor:
    """Determinant of the Hessian of the image smoothed by 1.4 px, (B, 16, h, w) -> (B, 16, h, w), in cells.

    Positive on blobs, bright or dark, negative on saddles (Beaudet 1978; Lindeberg 1998). Near the border of the image
    it is meaningless.
    """
    size = CELL * CELL
    uu, vv, uv = functional.conv2d(cells, _HESSIAN_KERNELS.to(cells), padding=1).split(size, dim=1)
    return uu * vv - uv * uv


def _hessian_kernels() -> Tensor:
    """(48, 16, 3, 3): second derivatives uu, vv, uv of each pixel of a cell from that cell and its 8 neighbours."""
    places = torch.arange(-_REACH + 1, _REACH, dtype=torch.float64)
    smooth = torch.exp(-0.5 * (places / _SIGMA) ** 2)
    smooth = functional.pad(smooth / smooth.sum(), (1, 1))
    first = 0.5 * (smooth.roll(1) - smooth.roll(-1))
    second = smooth.roll(1) + smooth.roll(-1) - 2.0 * smooth
    # Scaled by sigma^2, so that the response does not depend on sigma for structures of that size.
    filters = [torch.outer(smooth, second), torch.outer(second, smooth), torch.outer(first, first)]
    size = CELL * CELL
    kernels = torch.zeros(3, size, 3 * CELL, 3 * CELL, dtype=torch.float64)
    taps = 2 * _REACH + 1
    for kind, taps_2d in enumerate(filters):
        for pixel in range(size):
            v, u = divmod(pixel, CELL)
            kernels[kind, pixel, v : v + taps, u : u + taps] = _SIGMA**2 * taps_2d
    cells = kernels.view(3 * size, 3, CELL, 3, CELL).permute(0, 2, 4, 1, 3)
    return cells.reshape(3 * size, size, 3, 3).float()


# Made once: training detects in every image.
_HESSIAN_KERNELS = _hessian_kernels()


def detect(cells: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The `count` strongest blobs, evened out over the image, with sub-pixel places.

    Args:
        cells: (B, 16, h, w) from `to_cells`, h and w multiples of 4.
        count: number of peaks, at most 16 h w.
    Returns:
        keypoints (B, count, 2) pixels (u, v) and their strengths (B, count), zero where the image has fewer.
    """
    response = hessian_response(cells)
    evened = response / _surroundings(response)
    flat = functional.pixel_shuffle(response, CELL)
    scores = functional.pixel_shuffle(evened, CELL)
    peak = functional.max_pool2d(scores, _NMS_WINDOW, stride=1, padding=_NMS_WINDOW // 2)
    kept = torch.where((scores >= peak) & (flat > _MIN_RESPONSE), scores, torch.zeros_like(scores))
    inner = kept[:, :, BORDER:-BORDER, BORDER:-BORDER]
    kept = functional.pad(inner, (BORDER, BORDER, BORDER, BORDER))
    strength, index = torch.topk(kept.flatten(1), count, dim=1)
    return _fit_peaks(flat, index), strength


def _surroundings(response: Tensor) -> Tensor:
    """What the response is measured against, (B, 1, h, w): its mean around a cell to a power."""
    cells = response.clamp_min(0.0).mean(dim=1, keepdim=True)
    # The outermost cells respond to the border of the image.
    cells = functional.pad(cells[:, :, 1:-1, 1:-1], (1, 1, 1, 1), mode="replicate")
    block = functional.avg_pool2d(cells, _EVENING_CELLS)
    local = functional.avg_pool2d(block, _EVENING_WINDOW, 1, _EVENING_WINDOW // 2, count_include_pad=False)
    overall = block.mean(dim=(2, 3), keepdim=True)
    level = (local + 0.05 * overall).clamp_min(1e-14) ** _EVENING_POWER
    return functional.interpolate(level, scale_factor=float(_EVENING_CELLS), mode="bilinear", align_corners=False)


def _fit_peaks(response: Tensor, index: Tensor) -> Tensor:
    """Peaks of the quadratics through 3x3 pixels around (B, N) flat indices into (B, 1, H, W): (B, N, 2) pixels."""
    width = response.shape[-1]
    v = torch.div(index, width, rounding_mode="floor")
    u = index - v * width
    flat = response.flatten(1)
    # Peaks of strength zero may lie on the border; their neighbours are clamped into the image and not used.
    last = flat.shape[1] - 1

    def at(du: int, dv: int) -> Tensor:
        return flat.gather(1, (index + dv * width + du).clamp(0, last))

    centre, left, right, above, below = at(0, 0), at(-1, 0), at(1, 0), at(0, -1), at(0, 1)
    gradient_u = 0.5 * (right - left)
    gradient_v = 0.5 * (below - above)
    curvature_uu = right - 2.0 * centre + left
    curvature_vv = below - 2.0 * centre + above
    curvature_uv = 0.25 * (at(1, 1) - at(1, -1) - at(-1, 1) + at(-1, -1))
    determinant = curvature_uu * curvature_vv - curvature_uv * curvature_uv
    safe = determinant > 1e-3 * (curvature_uu * curvature_vv).abs()
    scale = torch.where(safe, 1.0 / torch.where(safe, determinant, torch.ones_like(determinant)), 0.0)
    offset_u = (-scale * (curvature_vv * gradient_u - curvature_uv * gradient_v)).clamp(-0.75, 0.75)
    offset_v = (-scale * (curvature_uu * gradient_v - curvature_uv * gradient_u)).clamp(-0.75, 0.75)
    return torch.stack([u.to(offset_u.dtype) + offset_u, v.to(offset_v.dtype) + offset_v], dim=-1)

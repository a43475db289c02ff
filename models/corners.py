"""Shi-Tomasi corners as a graph: response, maxima, sub-pixel peaks, all exportable to ONNX.

Classical corners localise better than those of the published learned detectors (repeatability within 1 px), so the
network only says which of them are worth keeping.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

BORDER = 8
_NMS_WINDOW = 5
_EVENING_WINDOW = 65
_EVENING_STRIDE = 16
# Response is compared with its surroundings to this power: 0 keeps the strongest corners wherever they crowd, 1 spreads
# them as evenly as texture allows.
_EVENING_POWER = 0.75


def corner_response(image: Tensor) -> Tensor:
    """Smaller eigenvalue of the structure tensor (Shi & Tomasi 1994), (B, 1, H, W) -> (B, 1, H, W).

    Same definition as kornia's `gftt_response` (a test compares them), with a 5-tap binomial window instead of its
    7x7 Gaussian and few enough convolutions to run five times faster in ONNX Runtime.
    """
    gradients = functional.conv2d(functional.pad(image, (1, 1, 1, 1), mode="replicate"), _sobel(image))
    gradient_u, gradient_v = gradients[:, 0:1], gradients[:, 1:2]
    products = torch.cat([gradient_u * gradient_u, gradient_v * gradient_v, gradient_u * gradient_v], dim=1)
    taps = image.new_tensor([1.0, 4.0, 6.0, 4.0, 1.0]) / 16.0
    rows = functional.conv2d(products, taps.view(1, 1, 1, 5).repeat(3, 1, 1, 1), padding=(0, 2), groups=3)
    tensor = functional.conv2d(rows, taps.view(1, 1, 5, 1).repeat(3, 1, 1, 1), padding=(2, 0), groups=3)
    uu, vv, uv = tensor[:, 0:1], tensor[:, 1:2], tensor[:, 2:3]
    half = 0.5 * (uu - vv)
    return 0.5 * (uu + vv) - torch.sqrt(half * half + uv * uv)


def _sobel(image: Tensor) -> Tensor:
    kernel = image.new_tensor([[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]]) / 8.0
    return torch.stack([kernel, kernel.T]).unsqueeze(1)


def corner_scores(response: Tensor) -> Tensor:
    """Scores of local maxima, evened out over the image; zero elsewhere and near the border.

    Args:
        response: (B, 1, H, W), H and W multiples of 16.
    Returns:
        (B, 1, H, W), not negative.
    """
    peak = functional.max_pool2d(response, _NMS_WINDOW, stride=1, padding=_NMS_WINDOW // 2)
    block = functional.avg_pool2d(response, _EVENING_STRIDE)
    cells = _EVENING_WINDOW // _EVENING_STRIDE + 1
    local = functional.avg_pool2d(block, cells, stride=1, padding=cells // 2, count_include_pad=False)
    overall = response.mean(dim=(2, 3), keepdim=True)
    # The power is taken on the coarse map, where it costs nothing.
    level = (local + 0.05 * overall).clamp_min(1e-12) ** _EVENING_POWER
    level = functional.interpolate(level, scale_factor=float(_EVENING_STRIDE), mode="bilinear", align_corners=False)
    evened = response / level
    kept = torch.where(response >= peak, evened, torch.zeros_like(evened))
    inner = kept[:, :, BORDER:-BORDER, BORDER:-BORDER]
    return functional.pad(inner, (BORDER, BORDER, BORDER, BORDER))


def select_peaks(scores: Tensor, response: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """The `count` best peaks with sub-pixel positions.

    Args:
        scores: (B, 1, H, W) from `corner_scores`.
        response: (B, 1, H, W), the surface on which a quadratic is fitted around each peak.
        count: number of peaks, at most H * W.
    Returns:
        keypoints (B, count, 2) pixel coordinates (u, v), and their scores (B, count), zero where the image has fewer.
    """
    width = scores.shape[-1]
    best, index = torch.topk(scores.flatten(1), count, dim=1)
    v = torch.div(index, width, rounding_mode="floor")
    u = index - v * width
    flat = response.flatten(1)
    # Peaks with score zero may lie on the border; their neighbours are clamped into the image and not used.
    last = flat.shape[1] - 1

    def at(du: int, dv: int) -> Tensor:
        return flat.gather(1, (index + dv * width + du).clamp(0, last))

    centre = at(0, 0)
    gradient_u = 0.5 * (at(1, 0) - at(-1, 0))
    gradient_v = 0.5 * (at(0, 1) - at(0, -1))
    curvature_uu = at(1, 0) - 2.0 * centre + at(-1, 0)
    curvature_vv = at(0, 1) - 2.0 * centre + at(0, -1)
    curvature_uv = 0.25 * (at(1, 1) - at(1, -1) - at(-1, 1) + at(-1, -1))
    determinant = curvature_uu * curvature_vv - curvature_uv * curvature_uv
    safe = determinant > 1e-3 * (curvature_uu * curvature_vv).abs()
    scale = torch.where(safe, 1.0 / torch.where(safe, determinant, torch.ones_like(determinant)), 0.0)
    offset_u = (-scale * (curvature_vv * gradient_u - curvature_uv * gradient_v)).clamp(-0.75, 0.75)
    offset_v = (-scale * (curvature_uu * gradient_v - curvature_uv * gradient_u)).clamp(-0.75, 0.75)
    keypoints = torch.stack([u.to(offset_u.dtype) + offset_u, v.to(offset_v.dtype) + offset_v], dim=-1)
    return keypoints, best

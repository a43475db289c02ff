"""What two cameras make of the light that they get: unlike blur, gain, vignetting, rows, noise, rounding and JPEG."""

import math

import torch
from torch import Tensor
from torch.nn import functional

from sigmaslam_training.stereo.layered_scenes import Pairs


def photograph(pairs: Pairs, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Grey values (B, 1, H, W) 0 to 255 of both eyes; disparities stay what they are."""
    count, _, height, width = pairs.left.shape
    device = pairs.left.device

    def uniform(low: float, high: float) -> Tensor:
        return low + (high - low) * torch.rand((count, 1, 1, 1), generator=generator, device=device)

    def normal(sigma: float) -> Tensor:
        return sigma * torch.randn((count, 1, 1, 1), generator=generator, device=device)

    def often(probability: float) -> Tensor:
        return torch.rand((count, 1, 1, 1), generator=generator, device=device) < probability

    zero = torch.zeros((count, 1, 1, 1), device=device)
    # Common to both eyes.
    exposure = uniform(0.2, 0.65) / pairs.left.mean(dim=(1, 2, 3), keepdim=True).clamp_min(1e-3)
    gamma, black = torch.exp(uniform(-0.7, 0.3)), torch.where(often(0.3), uniform(0.0, 0.3), zero)
    blur, vignetting = torch.where(often(0.7), uniform(0.0, 0.9), zero), torch.where(often(0.4), uniform(0.0, 0.5), zero)
    read, shot = torch.exp(uniform(math.log(0.2), math.log(5.0))), torch.exp(uniform(math.log(0.002), math.log(0.1)))
    unlike = torch.where(often(0.7), uniform(0.0, 1.0), zero)
    rows = torch.where(often(0.7), uniform(0.0, 1.0), zero)
    quality = torch.where(often(0.25), torch.exp(uniform(math.log(1.0), math.log(12.0))), zero)
    u = ((torch.arange(width, device=device) + 0.5) / width * 2.0 - 1.0).expand(count, 1, height, width)
    v = ((torch.arange(height, device=device) + 0.5) / height * 2.0 - 1.0)[:, None].expand(count, 1, height, width)
    radius = (u.square() + v.square()) / 2.0
    eyes = []
    for eye, image in enumerate((pairs.left, pairs.right)):
        light = image
        if eye:
            # Roll, pitch and unlike focal lengths move the rows.
            off = rows * (normal(0.4) + normal(0.4) * u + normal(0.4) * v) * 2.0 / height
            grid = torch.stack([u[:, 0], (v + off)[:, 0]], dim=3)
            light = functional.grid_sample(light, grid, "bicubic", "border", align_corners=False)
        light = _blur(light, (blur + unlike * uniform(0.0, 0.5)).flatten())
        light = light * (1.0 - (vignetting + unlike * normal(0.05)) * radius)
        light = (light * exposure * torch.exp(unlike * normal(0.12))).clamp_min(0.0)
        grey = 255.0 * (black + (1.0 - black) * light ** (gamma * torch.exp(unlike * normal(0.08))))
        grey = grey + unlike * normal(4.0)
        if eye:
            grey = _cover(grey, generator)
        noise = torch.randn(grey.shape, generator=generator, device=device)
        grey = grey + noise * torch.sqrt(read.square() + shot * grey.clamp_min(0.0))
        grey = grey.clamp(0.0, 255.0).round()
        eyes.append(torch.where(quality > 0.0, _compress(grey, quality.clamp_min(1.0)), grey))
    return eyes[0], eyes[1]


def _blur(image: Tensor, sigma: Tensor) -> Tensor:
    """Gaussian point spread, of each image (B, 1, H, W) its own (B,)."""
    count, _, height, width = image.shape
    taps = torch.arange(-3, 4, device=image.device)
    kernel = torch.exp(-0.5 * (taps / sigma.clamp_min(0.1)[:, None]).square())
    kernel = kernel / kernel.sum(dim=1, keepdim=True)
    rows = functional.pad(image.reshape(1, count, height, width), (3, 3, 3, 3), mode="reflect")
    rows = functional.conv2d(rows, kernel[:, None, :, None], groups=count)
    return functional.conv2d(rows, kernel[:, None, None, :], groups=count).reshape(image.shape)


def _cover(image: Tensor, generator: torch.Generator) -> Tensor:
    """Patches of one in three of the right images show their mean: no partner is there."""
    count, _, height, width = image.shape
    draws = torch.rand((5, count, 1, 1, 1), generator=generator, device=image.device)
    u = torch.arange(width, device=image.device) / width
    v = torch.arange(height, device=image.device)[:, None] / height
    inside = ((u - draws[0]).abs() < 0.08 * draws[1]) & ((v - draws[2]).abs() < 0.15 * draws[3])
    return torch.where(inside & (draws[4] < 0.33), image.mean(dim=(1, 2, 3), keepdim=True), image)


def _compress(grey: Tensor, step: Tensor) -> Tensor:
    """Rounds what blocks of 8 x 8 pixels are made of, high frequencies more, as JPEG does; H and W multiples of 8."""
    count, _, height, width = grey.shape
    k = torch.arange(8, device=grey.device, dtype=grey.dtype)
    basis = torch.cos(math.pi * (k + 0.5) * k[:, None] / 8.0) * 0.5
    basis[0] = math.sqrt(0.125)
    blocks = grey.reshape(count, height // 8, 8, width // 8, 8).transpose(2, 3)
    coarse = (1.0 + 0.5 * (k + k[:, None])) * step[..., None]
    values = ((basis @ (blocks - 128.0) @ basis.T) / coarse).round() * coarse
    blocks = basis.T @ values @ basis + 128.0
    return blocks.transpose(2, 3).reshape(grey.shape).clamp(0.0, 255.0).round()

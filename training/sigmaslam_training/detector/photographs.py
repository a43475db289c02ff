"""What a camera makes of light, for a batch on the device: other cameras for each image."""

import math

import torch
from torch import Tensor
from torch.nn import functional


def photograph(light: Tensor, generator: torch.Generator) -> Tensor:
    """Images (B, 1, H, W) in [0, 1] of radiance: shade, shadows, blur, vignetting, gain, noise, gamma, eight bits."""
    count, _, height, width = light.shape
    device = light.device

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand((count, *(shape or (1, 1, 1))), generator=generator, device=device)

    def chance(share: float) -> Tensor:
        return torch.rand((count, 1, 1, 1), generator=generator, device=device) < share

    x = torch.linspace(-1.0, 1.0, width, device=device).view(1, 1, 1, -1)
    y = torch.linspace(-1.0, 1.0, height, device=device).view(1, 1, -1, 1)
    shade = functional.interpolate(uniform(0.4, 1.3, 1, 3, 3), (height, width), mode="bicubic").clamp_min(0.1)
    light = torch.where(chance(0.4), light * shade, light)
    # What is not of the scene's surfaces and differs between the images: dirt, glints, leaves, compression, at all
    # scales and faint, so that what has little contrast is known to match badly.
    clutter = torch.zeros_like(light)
    for step in (1, 2, 4, 8):
        shape = (count, 1, height // step, width // step)
        drawn = torch.randn(shape, generator=generator, device=device)
        clutter += functional.interpolate(drawn, (height, width), mode="bilinear") * uniform(0.0, 1.0)
    strength = torch.where(chance(0.5), uniform(0.0, 0.02), uniform(0.02, 0.08))
    light = light * (1.0 + strength * clutter).clamp(0.3, 2.0)
    # A shadow whose edge is a line, which is not of the scene.
    angle = uniform(0.0, 2 * math.pi)
    beyond = ((x * angle.cos() + y * angle.sin() - uniform(-0.7, 0.7)) * uniform(3.0, 200.0)).sigmoid()
    light = torch.where(chance(0.15), light * (1.0 - uniform(0.2, 0.8) * beyond), light)
    light = light * uniform(0.25, 0.6) / light.mean(dim=(2, 3), keepdim=True).clamp_min(1e-6)
    light = light.clamp_max(1.5)
    sigma = torch.where(chance(0.15), uniform(1.0, 2.0), uniform(0.25, 0.9))
    taps = torch.arange(-4, 5, device=device).view(1, 1, -1)
    kernel = torch.exp(-0.5 * (taps / sigma.view(-1, 1, 1)) ** 2)
    kernel = kernel / kernel.sum(dim=2, keepdim=True)
    padded = functional.pad(light.transpose(0, 1), (4, 4, 4, 4), mode="reflect")
    padded = functional.conv2d(padded, kernel.unsqueeze(2), groups=count)
    light = functional.conv2d(padded, kernel.unsqueeze(3), groups=count).transpose(0, 1)
    light = light * (1.0 - uniform(0.0, 0.4) * 0.5 * (x**2 + y**2))
    photons = torch.exp(uniform(math.log(400.0), math.log(20000.0)))
    read = torch.where(chance(0.2), uniform(2.0, 8.0), uniform(0.3, 2.5)) / 255.0
    noise = torch.randn(light.shape, generator=generator, device=device)
    signal = light + noise * (light.clamp_min(0.0) / photons + read**2).sqrt()
    signal = (signal + uniform(-0.01, 0.04)).clamp(0.0, 1.0).clamp_min(1e-6) ** uniform(0.45, 1.2)
    return (signal * 255.0).round() / 255.0

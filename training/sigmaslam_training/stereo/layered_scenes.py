"""Stereo pairs of layers: slanted planes and curved sheets before one another, any number at once, on a GPU as well.

A layer is a disparity, a mask and a texture as functions of the left image's plane. Every pixel of an eye takes the
nearest layer there; in the right eye the place in the left image's plane is found by Newton's steps.
Disparities are exact, and so is what is hidden.
"""

import math
import random
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

_LAYERS = (6, 14)
_FINE = 2  # samples along a pixel's side
_ITERATIONS = 3
# Disparities of the nearest layers, pixels, drawn evenly in the logarithm; steepest change along a row.
_NEAREST = (8.0, 185.0)
_STEEPEST = 0.5
_WAVES = 2
# Kinds of masks.
_ELLIPSE, _BOX, _POLE, _LEAVES, _FENCE, _KINDS = range(6)
_PLAIN = 0.2  # share of layers that show hardly any texture


class Pairs(NamedTuple):
    """Pairs before the cameras.

    Attributes:
        left, right: (B, 1, H, W) light in [0, 1] and beyond.
        disparity: (B, 1, H, W) of the left image, pixels; NaN where there is none.
    """

    left: Tensor
    right: Tensor
    disparity: Tensor


class _Layer(NamedTuple):
    """One layer of B scenes; every number is (B, 1, 1)."""

    base: Tensor
    along: Tensor
    down: Tensor
    waves: list[tuple[Tensor, Tensor, Tensor, Tensor]]
    kind: Tensor
    centre: tuple[Tensor, Tensor]
    turn: tuple[Tensor, Tensor]
    size: tuple[Tensor, Tensor]
    period: Tensor
    texture: Tensor
    place: tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
    contrast: Tensor
    brightness: Tensor


class LayeredScenes:
    """Draws pairs.

    Args:
        textures: (N, S, S) uint8 bank.
        size: (H, W) of the images.
        generator: source of all randomness, on the device where the pairs are drawn.
    """

    def __init__(self, textures: Tensor, size: tuple[int, int], generator: torch.Generator) -> None:
        self.replace_textures(textures)
        self._height, self._width = size
        self._generator = generator
        self._numbers = random.Random(generator.initial_seed())
        self._device = generator.device

    def replace_textures(self, textures: Tensor) -> None:
        """Takes another bank; all are brought to one contrast."""
        bank = textures.float() / 255.0
        bank = bank - bank.mean(dim=(1, 2), keepdim=True)
        spread = bank.square().mean(dim=(1, 2), keepdim=True).sqrt().clamp_min(0.02)
        self.textures = (0.25 * bank / spread).clamp(-0.6, 0.6).half()

    def draw(self, count: int) -> Pairs:
        """So many pairs."""
        nearest = self._log_uniform(count, *_NEAREST)
        layers = [self._layer(count, nearest, first=True)]
        number = self._numbers.randint(*_LAYERS)
        layers += [self._layer(count, nearest, first=False) for _ in range(number)]
        fine = _FINE
        u = (torch.arange(self._width * fine, device=self._device) + 0.5) / fine - 0.5
        v = ((torch.arange(self._height * fine, device=self._device) + 0.5) / fine - 0.5)[:, None]
        u, v = u.expand(1, len(v), len(u)), v.expand(1, len(v), len(u))
        left, disparity = self._see(layers, u, v, right=False)
        right, _ = self._see(layers, u, v, right=True)
        return Pairs(
            functional.avg_pool2d(left[:, None], fine),
            functional.avg_pool2d(right[:, None], fine),
            _middle(disparity[:, None], fine),
        )

    def _see(self, layers: list[_Layer], u: Tensor, v: Tensor, right: bool) -> tuple[Tensor, Tensor]:
        """Light and disparity (B, h, w) of the nearest layer at pixels (1, h, w) of one eye."""
        light: Tensor | None = None
        nearest: Tensor | None = None
        for layer in layers:
            x = u
            if right:
                x = u + _disparity(layer, u, v)
                for _ in range(_ITERATIONS):
                    x = x - (x - u - _disparity(layer, x, v)) / (1.0 - _slope(layer, x, v))
            disparity = _disparity(layer, x, v)
            seen = self._shade(layer, x, v)
            if light is None or nearest is None:
                light, nearest = seen, disparity.expand_as(seen).clone()
                continue
            before = _inside(layer, x, v) & (disparity > nearest)
            light = torch.where(before, seen, light)
            nearest = torch.where(before, disparity, nearest)
        assert light is not None and nearest is not None
        return light, nearest

    def _shade(self, layer: _Layer, x: Tensor, v: Tensor) -> Tensor:
        a, b, c, d, e, f = layer.place
        grid = torch.stack([a * x + b * v + e, c * x + d * v + f], dim=3)
        # Textures go on beyond their ends as mirrors show them.
        grid = (torch.remainder(grid + 1.0, 4.0) - 2.0).abs() - 1.0
        bank = self.textures[layer.texture].float()[:, None]
        texture = functional.grid_sample(bank, grid, mode="bilinear", padding_mode="border", align_corners=False)
        return (layer.brightness + layer.contrast * texture[:, 0]).clamp_min(0.0)

    def _layer(self, count: int, nearest: Tensor, first: bool) -> _Layer:
        width, height = float(self._width), float(self._height)
        depth = self._uniform(count, 0.0, 1.0) ** 1.5 * nearest
        base = 0.3 * depth if first else depth
        # A ground or a wall that comes near fast, or something that faces the camera.
        slanted = self._uniform(count, 0.0, 1.0) < (0.7 if first else 0.4)
        along = torch.where(slanted, self._normal(count) * nearest / width, self._normal(count) * 0.02)
        down = torch.where(slanted, self._normal(count) * 1.5 * nearest / height, self._normal(count) * 0.02)
        waves, slope = [], along.abs()
        for _ in range(_WAVES):
            length = self._log_uniform(count, 30.0, 500.0)
            angle = self._uniform(count, 0.0, 6.2832)
            curved = (self._uniform(count, 0.0, 1.0) < 0.4).float()
            height_of = curved * self._uniform(count, 0.0, 0.08) * length
            height_of = torch.minimum(height_of, 0.15 * nearest)
            k = 6.2832 / length
            waves.append((height_of, k * angle.cos(), k * angle.sin(), self._uniform(count, 0.0, 6.2832)))
            slope = slope + height_of * k
        # So steep that rows are never seen from behind.
        shrink = (_STEEPEST / slope.clamp_min(1e-6)).clamp_max(1.0)
        along = along * shrink
        waves = [(h * shrink, p, q, r) for h, p, q, r in waves]
        kind = torch.randint(0, _KINDS, (count, 1, 1), generator=self._generator, device=self._device)
        thin = kind == _POLE
        turn = torch.where(
            self._uniform(count, 0.0, 1.0) < 0.5, 0.03 * self._normal(count), self._uniform(count, 0.0, 3.1416)
        )
        size = self._log_uniform(count, 0.03 * width, 0.45 * width), self._log_uniform(count, 0.03 * width, 0.45 * width)
        size = torch.where(thin, self._log_uniform(count, 0.6, 8.0), size[0]), torch.where(thin, 2.0 * size[1], size[1])
        period = torch.where(kind == _LEAVES, self._log_uniform(count, 4.0, 60.0), self._log_uniform(count, 8.0, 60.0))
        texture = torch.randint(0, len(self.textures), (count,), generator=self._generator, device=self._device)
        side = float(self.textures.shape[-1])
        # Texels a pixel; sheets seen aslant have more of them along one axis.
        scale = self._log_uniform(count, 0.3, 2.0) * 2.0 / side
        spin = torch.where(slanted, self._uniform(count, 0.0, 6.2832), 0.1 * self._normal(count))
        stretch = self._log_uniform(count, 0.5, 1.0)
        place = (
            scale * spin.cos(),
            -scale * spin.sin() * stretch,
            scale * spin.sin(),
            scale * spin.cos() * stretch,
            self._uniform(count, -2.0, 2.0),
            self._uniform(count, -2.0, 2.0),
        )
        plain = self._uniform(count, 0.0, 1.0) < _PLAIN
        contrast = torch.where(plain, self._log_uniform(count, 0.02, 0.15), self._log_uniform(count, 0.2, 1.0))
        return _Layer(
            base,
            along,
            down,
            waves,
            kind,
            (self._uniform(count, -0.05 * width, 1.2 * width), self._uniform(count, 0.0, height)),
            (turn.cos(), turn.sin()),
            size,
            period,
            texture,
            place,
            contrast,
            self._uniform(count, 0.2, 0.8),
        )

    def _uniform(self, count: int, low: float, high: float) -> Tensor:
        draws = torch.rand((count, 1, 1), generator=self._generator, device=self._device)
        return low + (high - low) * draws

    def _log_uniform(self, count: int, low: float, high: float) -> Tensor:
        return low * torch.exp(self._uniform(count, 0.0, math.log(high / low)))

    def _normal(self, count: int) -> Tensor:
        return torch.randn((count, 1, 1), generator=self._generator, device=self._device)


def _disparity(layer: _Layer, x: Tensor, v: Tensor) -> Tensor:
    x, v = x - layer.centre[0], v - layer.centre[1]
    result = layer.base + layer.along * x + layer.down * v
    for height, across, down, phase in layer.waves:
        result = result + height * torch.sin(across * x + down * v + phase)
    # Nothing is behind infinity; what would be lies there.
    return result.clamp_min(0.0)


def _slope(layer: _Layer, x: Tensor, v: Tensor) -> Tensor:
    """Change of the disparity along a row, pixels a pixel."""
    x, v = x - layer.centre[0], v - layer.centre[1]
    result = layer.along.expand_as(x)
    for height, across, down, phase in layer.waves:
        result = result + height * across * torch.cos(across * x + down * v + phase)
    return result


def _inside(layer: _Layer, x: Tensor, v: Tensor) -> Tensor:
    x, v = x - layer.centre[0], v - layer.centre[1]
    cosine, sine = layer.turn
    across, along = (cosine * x + sine * v) / layer.size[0], (cosine * v - sine * x) / layer.size[1]
    ellipse = across.square() + along.square() < 1.0
    box = (across.abs() < 1.0) & (along.abs() < 1.0)
    wave = 6.2832 / layer.period
    leaves = (wave * (x + 0.4 * v)).sin() + (wave * (1.37 * v - 0.3 * x)).sin() + (0.43 * wave * (x - v)).sin() > 0.4
    stripes = (wave * across * layer.size[0]).sin() > 0.5
    kind = layer.kind
    inside = torch.where(kind == _ELLIPSE, ellipse, box)
    inside = torch.where(kind == _LEAVES, ellipse & leaves, inside)
    return torch.where(kind == _FENCE, box & stripes, inside)


def _middle(values: Tensor, side: int) -> Tensor:
    """One of the values of each pixel (B, 1, H, W): the mean, or where surfaces meet that of the nearer half."""
    parts = functional.pixel_unshuffle(values, side).sort(dim=1).values
    mean = parts.mean(dim=1, keepdim=True)
    nearer = parts[:, side * side // 2 : side * side // 2 + 1]
    return torch.where(parts[:, -1:] - parts[:, :1] < 1.0, mean, nearer)

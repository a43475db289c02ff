"""All textures of a scene with their mip levels in one image, so that one look-up serves every surface."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from sigmaslam.synthetic.textures import paint

SIZE = 512  # side of a texture, texels
_LEVELS = 8  # down to 4 x 4
_COLUMNS = 4


class Atlas:
    """Textures by (kind, seed), grey values in [0, 1], repeated by mirroring.

    Args:
        textures: kinds and seeds, see `textures.paint`.
        device: where look-ups run.
    """

    def __init__(self, textures: Sequence[tuple[str, int]], device: torch.device) -> None:
        rows = -(-len(textures) // _COLUMNS)
        columns = min(len(textures), _COLUMNS)
        image = np.zeros((rows * SIZE, columns * SIZE * 3 // 2), dtype=np.float32)
        for k, (kind, seed) in enumerate(textures):
            top, left = SIZE * (k // _COLUMNS), SIZE * 3 // 2 * (k % _COLUMNS)
            image[top : top + SIZE, left : left + SIZE * 3 // 2] = _block(kind, seed)
        self._image = torch.from_numpy(image).to(device)[None, None]
        # Pixel place to grid_sample's [-1, 1].
        self._scale = (2.0 / image.shape[1], 2.0 / image.shape[0])

    def sample(self, texture: Tensor, place: Tensor, level: Tensor) -> Tensor:
        """Trilinear look-up.

        Args:
            texture: (N,) int64 index.
            place: (N, 2) float texels at full size, 0 at the edge of the first texel.
            level: (N,) mip level, clamped to what there is.
        Returns:
            (N,) float32.
        """
        folded = torch.remainder(place, 2 * SIZE)
        folded = torch.minimum(folded, 2 * SIZE - folded)
        level = level.clamp(0, _LEVELS - 1)
        lower = level.floor()
        share = level - lower
        corner = torch.stack([(texture % _COLUMNS) * (SIZE * 3 // 2), (texture // _COLUMNS) * SIZE], dim=-1)
        fine = self._bilinear(corner, folded, lower)
        coarse = self._bilinear(corner, folded, (lower + 1).clamp_max(_LEVELS - 1))
        return torch.lerp(fine, coarse, share)

    def _bilinear(self, corner: Tensor, place: Tensor, level: Tensor) -> Tensor:
        shrink = torch.exp2(-level)
        size = SIZE * shrink
        x = torch.clamp(place[:, 0] * shrink, min=0.5).minimum(size - 0.5) + corner[:, 0]
        y = torch.clamp(place[:, 1] * shrink, min=0.5).minimum(size - 0.5) + corner[:, 1]
        # Levels from 1 on stand in a column to the right of level 0.
        small = level > 0
        x = torch.where(small, x + SIZE, x)
        y = torch.where(small, y + (SIZE - 2 * size), y)
        grid = torch.stack([x * self._scale[0] - 1.0, y * self._scale[1] - 1.0], dim=-1)[None, None]
        return functional.grid_sample(self._image, grid, mode="bilinear", align_corners=False)[0, 0, 0]


@lru_cache(maxsize=96)
def _block(kind: str, seed: int) -> np.ndarray:
    """A texture and its halvings, (SIZE, 1.5 SIZE) float32."""
    block = np.zeros((SIZE, SIZE * 3 // 2), dtype=np.float32)
    level = paint(kind, SIZE, seed).astype(np.float32) / 255.0
    block[:, :SIZE] = level
    top = 0
    for _ in range(1, _LEVELS):
        level = np.asarray(cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
        side = len(level)
        block[top : top + side, SIZE : SIZE + side] = level
        top += side
    return block

"""All textures of a scene with their mip levels in one image, so that one look-up serves every surface."""

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from sigmaslam_synthetic.rendering.textures import paint

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
            left, top = self.corner(k)
            image[top : top + SIZE, left : left + SIZE * 3 // 2] = _block(kind, seed)
        self._image = torch.from_numpy(image).to(device)[None, None]
        # Pixel place to grid_sample's [-1, 1].
        self._scale = (2.0 / image.shape[1], 2.0 / image.shape[0])

    def corner(self, texture: int) -> tuple[int, int]:
        """Where texture number `texture` begins in the atlas, pixels (u, v)."""
        return SIZE * 3 // 2 * (texture % _COLUMNS), SIZE * (texture // _COLUMNS)

    def sample(self, corner: Tensor, place: Tensor, level: Tensor) -> Tensor:
        """Trilinear look-up.

        Args:
            corner: (2, N) float32 corner of each texture.
            place: (2, N) float32 texels at full size, 0 at the edge of the first texel.
            level: (N,) mip level, clamped to what there is.
        Returns:
            (N,) float32.
        """
        # Mirrored: 0 to SIZE and back.
        folded = (place - (2 * SIZE) * torch.floor((place + SIZE) * (0.5 / SIZE))).abs()
        level = level.clamp(0, _LEVELS - 1)
        lower = level.floor()
        fine = self._bilinear(corner, folded, lower)
        coarse = self._bilinear(corner, folded, (lower + 1).clamp_max(_LEVELS - 1))
        return torch.lerp(fine, coarse, level - lower)

    def _bilinear(self, corner: Tensor, place: Tensor, level: Tensor) -> Tensor:
        shrink = torch.exp2(-level)
        size = SIZE * shrink
        x, y = torch.minimum((place * shrink).clamp_min(0.5), size - 0.5) + corner
        # Levels from 1 on stand in a column to the right of level 0, one below the other.
        small = level.clamp_max(1.0)
        x = x + SIZE * small
        y = y + (SIZE - 2 * size) * small
        # As the two parts of a complex number x and y come to lie side by side ten times faster than by stacking.
        grid = torch.view_as_real(torch.complex(x * self._scale[0] - 1.0, y * self._scale[1] - 1.0))[None, None]
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

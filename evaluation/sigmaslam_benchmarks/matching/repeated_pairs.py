"""Image pairs of repeated structure: boards, tiles and grids whose places look alike, one period from the next.

A pair is a function of (seed, index).
"""

import cv2
import numpy as np

from sigmaslam_synthetic.camera.sensor import expose, random_sensor
from sigmaslam_synthetic.homography_pairs import HomographyPair, random_view, warp
from sigmaslam_synthetic.rendering.bank import TextureBank
from sigmaslam_synthetic.rendering.fills import log_uniform
from sigmaslam_synthetic.rendering.textures import KINDS

_TEXTURE_SIZE = 448
_CANVAS = 1.5  # side of the plane, in sides of the images
_PERIODS = (14.0, 96.0)  # pixels, drawn evenly in the logarithm
_BOARDS = 0.5  # share of the pairs whose pattern ends within the plane, on a plain or textured ground
_STILL = 0.5  # share of the pairs that are shifted only, ...
_WHOLE = 0.5  # ... and of these the share shifted by whole periods
_LARGEST_SHIFT = 0.35  # in sides of the images
_STRENGTH = 0.25  # largest, of the warps of the others, as of `HomographyPairs`
_ONE_CAMERA = 0.5  # share of the pairs whose images are of one sensor
_SOFTNESS = 0.7  # of the pattern's edges, pixels


class RepeatedPairs:
    """Random-access stream of pairs of planes with a periodic pattern.

    Which period a keypoint belongs to often cannot be told from its descriptor, and where the pattern fills both images
    nor from its neighbours: right and wrong matches look the same, and their probability must say so.

    Args:
        seed: of the whole stream.
        size: side of the square images in pixels.
    """

    def __init__(self, seed: int, size: int = 224) -> None:
        self.seed = seed
        self.size = size
        self._bank = TextureBank(seed, KINDS, _TEXTURE_SIZE)

    def pair(self, index: int) -> HomographyPair:
        """The pair of that index, the same whenever it is asked for."""
        rng = np.random.default_rng((self.seed, 1, index))
        side = round(_CANVAS * self.size)
        period = round(log_uniform(rng, *_PERIODS))
        plane = self._plane(index, side, period, rng)
        H_0_plane, H_1_plane = self._views(side, period, rng)
        sensors = [random_sensor(rng)] * 2 if rng.random() < _ONE_CAMERA else [random_sensor(rng) for _ in range(2)]
        images = [
            expose(warp(plane, H, self.size), sensor, rng).astype(np.float32) / np.float32(255.0)
            for H, sensor in zip((H_0_plane, H_1_plane), sensors, strict=True)
        ]
        H_1_0 = H_1_plane @ np.linalg.inv(H_0_plane)
        nothing = np.zeros((self.size, self.size), dtype=bool)
        return HomographyPair(images[0], images[1], H_1_0 / H_1_0[2, 2], nothing)

    def _plane(self, index: int, side: int, period: int, rng: np.random.Generator) -> np.ndarray:
        motif = _checks(period, rng) if rng.random() < 0.5 else self._cut(index, period, rng)
        repeats = -(-side // period)
        plane = np.tile(motif, (repeats, repeats))[:side, :side]
        if rng.random() < _BOARDS:
            ground = np.full_like(plane, rng.integers(20, 236))
            if rng.random() < 0.5:
                ground = cv2.resize(self._bank.texture(index + 1), (side, side), interpolation=cv2.INTER_LINEAR)
            shape = np.maximum(rng.uniform(0.25, 0.75, 2) * side // period, 2).astype(int) * period
            top, left = (rng.random(2) * np.maximum(side - shape, 1)).astype(int)
            board = slice(top, top + shape[0]), slice(left, left + shape[1])
            ground[board] = plane[: ground[board].shape[0], : ground[board].shape[1]]
            plane = ground
        return np.asarray(cv2.GaussianBlur(plane, (0, 0), _SOFTNESS))

    def _cut(self, index: int, period: int, rng: np.random.Generator) -> np.ndarray:
        """(P, P) a piece of a texture."""
        texture = self._bank.texture(index)
        top, left = rng.integers(0, _TEXTURE_SIZE - period, 2)
        return texture[top : top + period, left : left + period]

    def _views(self, side: int, period: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Homographies from the plane to either image, (3, 3)."""
        if rng.random() >= _STILL:
            strength = rng.uniform(0.0, _STRENGTH)
            return random_view(rng, side, self.size, strength), random_view(rng, side, self.size, strength)
        shift = _LARGEST_SHIFT * self.size * rng.uniform(-1, 1, 2)
        if rng.random() < _WHOLE:
            shift = np.round(shift / period) * period
        H_0_plane, H_1_plane = np.eye(3), np.eye(3)
        H_0_plane[:2, 2] = -((side - self.size) // 2)
        H_1_plane[:2, 2] = H_0_plane[:2, 2] + shift
        return H_0_plane, H_1_plane


def _checks(period: int, rng: np.random.Generator) -> np.ndarray:
    """(P, P) uint8, two squares of either grey."""
    dark, bright = np.sort(rng.uniform(10, 245, 2))
    bright = max(bright, min(dark + 40.0, 255.0))
    second = (np.arange(period) >= period // 2).astype(int)
    return np.where(second[:, None] ^ second, bright, dark).astype(np.uint8)

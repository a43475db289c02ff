"""Image pairs under random homographies of a procedural texture: the cheap training stream.

A pair is a pure function of (seed, index), so that a run can be resumed anywhere and repeated exactly.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import cv2
import numpy as np

from sigmaslam.synthetic.textures import dead_leaves, noise_texture

_TEXTURE_SIZE = 448
_TEXTURES_A_BLOCK = 16  # a batch of up to 16 pairs sees 16 different textures ...
_USES_OF_A_TEXTURE = 32  # ... and the next 31 batches see them again under other warps


@dataclass(frozen=True, slots=True)
class HomographyPair:
    """Two views of a plane.

    Attributes:
        image0, image1: (H, W) float32 in [0, 1].
        H_1_0: (3, 3) homography that takes pixels of image 0 to image 1.
    """

    image0: np.ndarray
    image1: np.ndarray
    H_1_0: np.ndarray


class HomographyPairs:
    """Random-access stream of homography pairs.

    Args:
        seed: of the whole stream.
        size: side of the square images in pixels.
    """

    def __init__(self, seed: int, size: int = 224) -> None:
        self.seed = seed
        self.size = size
        self._textures: OrderedDict[int, np.ndarray] = OrderedDict()

    def pair(self, index: int) -> HomographyPair:
        """The pair of that index, the same whenever it is asked for."""
        rng = np.random.default_rng((self.seed, 1, index))
        texture = self._texture(index)
        H_0_texture = _random_view(rng, self.size, strength=0.5)
        H_1_texture = _random_view(rng, self.size, strength=1.0)
        images = [_warp(texture, H, self.size) for H in (H_0_texture, H_1_texture)]
        if rng.random() < 0.25:
            images[1] = _occlude(images[1], rng)
        images = [_sense(image, rng) for image in images]
        H_1_0 = H_1_texture @ np.linalg.inv(H_0_texture)
        return HomographyPair(images[0], images[1], H_1_0 / H_1_0[2, 2])

    def _texture(self, index: int) -> np.ndarray:
        block = index // (_TEXTURES_A_BLOCK * _USES_OF_A_TEXTURE)
        key = block * _TEXTURES_A_BLOCK + index % _TEXTURES_A_BLOCK
        if key not in self._textures:
            rng = np.random.default_rng((self.seed, 0, key))
            self._textures[key] = dead_leaves((_TEXTURE_SIZE, _TEXTURE_SIZE), rng)
            while len(self._textures) > _TEXTURES_A_BLOCK:
                self._textures.popitem(last=False)
        return self._textures[key]


def _random_view(rng: np.random.Generator, size: int, strength: float) -> np.ndarray:
    """Homography from texture pixels to the pixels of one view, (3, 3).

    Rotation to +-40 degrees, scale e^+-0.45, shear, perspective and shift, each scaled by `strength`; one view in
    eight is almost unmoved, as in a video.
    """
    if rng.random() < 0.125:
        strength *= 0.15
    angle = np.deg2rad(40.0) * strength * rng.uniform(-1, 1)
    scale = np.exp(0.45 * strength * rng.uniform(-1, 1))
    shear = 0.25 * strength * rng.uniform(-1, 1)
    stretch = np.exp(0.2 * strength * rng.uniform(-1, 1))
    linear = (
        scale
        * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        @ np.array([[stretch, shear], [0.0, 1.0 / stretch]])
    )
    to_centre, H, to_view = np.eye(3), np.eye(3), np.eye(3)
    to_centre[:2, 2] = -_TEXTURE_SIZE / 2
    H[:2, :2] = linear
    H[2, :2] = 0.6 * strength / size * rng.uniform(-1, 1, 2)
    shift = 0.15 * size * strength * rng.uniform(-1, 1, 2)
    to_view[:2, 2] = size / 2 + shift
    return np.asarray(to_view @ H @ to_centre)


def _warp(texture: np.ndarray, H: np.ndarray, size: int) -> np.ndarray:
    image = cv2.warpPerspective(texture, H, (size, size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return image.astype(np.float32) / 255.0


def _occlude(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A foreign patch over part of the second view: what it hides has no match."""
    size = image.shape[0]
    centre = tuple(int(c) for c in rng.uniform(0, size, 2))
    axes = tuple(int(a) for a in rng.uniform(0.08, 0.3, 2) * size)
    mask = np.zeros(image.shape, np.uint8)
    cv2.ellipse(mask, centre, axes, float(rng.uniform(0, 180)), 0, 360, 1, -1)
    patch = rng.uniform(0, 1) + 0.15 * noise_texture(image.shape, rng)
    return np.where(mask > 0, np.clip(patch, 0, 1), image).astype(np.float32)


def _sense(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Sensor and light: shading, gamma, gain, blur, motion blur, noise, quantisation."""
    size = image.shape[0]
    if rng.random() < 0.4:
        shade = cv2.resize(
            rng.uniform(0.5, 1.3, (3, 3)).astype(np.float32), (size, size), interpolation=cv2.INTER_CUBIC
        )
        image = image * shade
    image = np.clip(image, 0, 1) ** np.exp(rng.uniform(-0.6, 0.6))
    contrast = np.exp(rng.uniform(-1.2, 0.1))
    image = contrast * image + rng.uniform(0, 1 - min(contrast, 1.0))
    if rng.random() < 0.5:
        image = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.3, 1.4))
    if rng.random() < 0.15:
        image = cv2.filter2D(image, -1, _motion_kernel(rng))
    noise = np.exp(rng.uniform(np.log(0.002), np.log(0.04)))
    image = image + noise * rng.standard_normal(image.shape, np.float32) * np.sqrt(0.3 + np.clip(image, 0, 1))
    return (np.round(np.clip(image, 0, 1) * 255) / 255).astype(np.float32)


def _motion_kernel(rng: np.random.Generator) -> np.ndarray:
    length, angle = rng.uniform(2, 7), rng.uniform(0, np.pi)
    kernel = np.zeros((9, 9), np.float32)
    reach = 0.5 * length * np.array([np.cos(angle), np.sin(angle)])
    start, stop = (tuple(int(x) for x in np.round((4 + s * reach) * 16)) for s in (-1, 1))
    cv2.line(kernel, start, stop, 1.0, 1, cv2.LINE_AA, 4)
    return kernel / max(float(kernel.sum()), 1e-6)

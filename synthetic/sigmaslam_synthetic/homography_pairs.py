"""Image pairs under random homographies of a procedural texture: the cheap training stream.

A pair is a pure function of (seed, index), so that a run can be resumed anywhere and repeated exactly.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from sigmaslam_synthetic.camera.sensor import expose, random_sensor
from sigmaslam_synthetic.rendering.bank import TextureBank
from sigmaslam_synthetic.rendering.fills import fixed_point, log_uniform
from sigmaslam_synthetic.rendering.textures import leaf_outline

_TEXTURE_SIZE = 448


@dataclass(frozen=True, slots=True)
class HomographyPair:
    """Two views of a plane.

    Attributes:
        image0, image1: (H, W) float32 in [0, 1].
        H_1_0: (3, 3) homography that takes pixels of image 0 to image 1.
        hidden1: (H, W) bool, what something else stands before in image 1.
    """

    image0: np.ndarray
    image1: np.ndarray
    H_1_0: np.ndarray
    hidden1: np.ndarray

    def transfer(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where points (N, 2) of image 0 lie in image 1 (N, 2), and whether they are seen there (N,) bool."""
        homogeneous = np.concatenate([points, np.ones_like(points[:, :1])], axis=1) @ self.H_1_0.T
        front = homogeneous[:, 2] > 1e-6
        places = homogeneous[:, :2] / np.where(front, homogeneous[:, 2], 1.0)[:, None]
        last = np.array(self.hidden1.shape[::-1]) - 1
        visible = front & ((places >= 0) & (places <= last)).all(axis=1)
        u, v = np.clip(np.round(places), 0, last).astype(int).T
        return places, visible & ~self.hidden1[v, u]


class HomographyPairs:
    """Random-access stream of homography pairs.

    Args:
        seed: of the whole stream.
        size: side of the square images in pixels.
        kinds: of the textures, as `TextureBank` takes them.
        strengths: of the warps of the two views; at 1 a view is turned by up to 40 degrees and scaled by up to e^0.45.
    """

    def __init__(
        self,
        seed: int,
        size: int = 224,
        kinds: tuple[str, ...] = ("leaves",),
        strengths: tuple[float, float] = (0.5, 1.0),
    ) -> None:
        self.seed = seed
        self.size = size
        self._strengths = strengths
        self._bank = TextureBank(seed, kinds, _TEXTURE_SIZE)

    def pair(self, index: int) -> HomographyPair:
        """The pair of that index, the same whenever it is asked for."""
        rng = np.random.default_rng((self.seed, 1, index))
        texture = self._bank.texture(index)
        if rng.random() < 0.3:  # seen from afar
            texture = _shrunk(texture, np.exp(rng.uniform(0.1, 0.9)))
        H_0_texture, H_1_texture = (
            random_view(rng, texture.shape[0], self.size, strength) for strength in self._strengths
        )
        images = [warp(texture, H, self.size) for H in (H_0_texture, H_1_texture)]
        hidden = np.zeros((self.size, self.size), dtype=bool)
        if rng.random() < 0.3:
            foreign = self._bank.texture(index + 1)
            for _ in range(int(rng.integers(1, 4))):
                images[1], mask = _occlude(images[1], foreign, rng)
                hidden |= mask
        images = [_sense(image, rng) for image in images]
        H_1_0 = H_1_texture @ np.linalg.inv(H_0_texture)
        return HomographyPair(images[0], images[1], H_1_0 / H_1_0[2, 2], hidden)


def _shrunk(texture: np.ndarray, factor: float) -> np.ndarray:
    side = max(2, round(texture.shape[0] / factor))
    return np.asarray(cv2.resize(texture, (side, side), interpolation=cv2.INTER_AREA))


def random_view(rng: np.random.Generator, texture_size: int, size: int, strength: float) -> np.ndarray:
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
    to_centre[:2, 2] = -texture_size / 2
    H[:2, :2] = linear
    H[2, :2] = 0.6 * strength / size * rng.uniform(-1, 1, 2)
    shift = 0.15 * size * strength * rng.uniform(-1, 1, 2)
    to_view[:2, 2] = size / 2 + shift
    return np.asarray(to_view @ H @ to_centre)


def warp(texture: np.ndarray, H: np.ndarray, size: int) -> np.ndarray:
    """A texture (S, S) uint8, mirrored at its borders, as a view of that size sees it: (H, W) float32 in [0, 1]."""
    image = cv2.warpPerspective(texture, H, (size, size), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return image.astype(np.float32) / 255.0


def _occlude(image: np.ndarray, foreign: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The second view with a patch of another texture over part of it, and what that hides (H, W) bool."""
    size = image.shape[0]
    mask: np.ndarray = np.zeros(image.shape, np.uint8)
    outline = leaf_outline(log_uniform(rng, 0.06, 0.25) * size, rng) + rng.uniform(0, size, 2)
    cv2.fillPoly(mask, [fixed_point(outline)], 255, cv2.LINE_AA, 4)
    if rng.random() < 0.3:  # nearer than the focus
        mask = cv2.blur(mask, (9, 9))
    patch = warp(foreign, random_view(rng, foreign.shape[0], size, strength=1.0), size)
    return np.asarray(image + mask * np.float32(1 / 255) * (patch - image)), mask > 64


def _sense(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Uneven light, then a random camera that moved while its shutter was open."""
    if rng.random() < 0.4:
        shade = rng.uniform(0.5, 1.3, (3, 3)).astype(np.float32)
        image = image * cv2.resize(shade, image.shape[::-1], interpolation=cv2.INTER_CUBIC)
    angle, motion = rng.uniform(0, 2 * np.pi), 12.0 if rng.random() < 0.25 else 0.0
    flow = (motion * np.array([np.cos(angle), np.sin(angle)])).astype(np.float32)
    grey = expose(image, random_sensor(rng), rng, flow)
    return grey.astype(np.float32) / np.float32(255.0)

"""What a camera does to the light it gets: gain, blur, shot and read noise, eight bits."""

from dataclasses import dataclass

import cv2
import numpy as np


@dataclass(frozen=True, slots=True)
class Sensor:
    """A grey-level sensor.

    Attributes:
        gain: factor on the image.
        blur: standard deviation of the lens's Gaussian blur, pixels.
        read_noise: standard deviation of the Gaussian noise, grey levels.
        photons_at_white: mean photon count of grey level 255; shot noise has its square root.
    """

    gain: float = 1.0
    blur: float = 0.5
    read_noise: float = 0.8
    photons_at_white: float = 20000.0


def expose(image: np.ndarray, sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """The photograph of an ideal image.

    Args:
        image: (H, W) in [0, 1].
        sensor: what takes it.
        rng: source of the noise.
    Returns:
        (H, W) uint8.
    """
    light = sensor.gain * image.astype(np.float64)
    if sensor.blur > 0:
        blurred = cv2.GaussianBlur(light, (0, 0), sensor.blur, borderType=cv2.BORDER_REFLECT)
        light = np.asarray(blurred, dtype=np.float64)
    photons = rng.poisson(np.maximum(light, 0.0) * sensor.photons_at_white)
    grey = 255.0 * photons / sensor.photons_at_white + sensor.read_noise * rng.standard_normal(light.shape)
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)

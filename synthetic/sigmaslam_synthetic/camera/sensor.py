"""What a camera does to the light it gets: blurs, vignetting, gain, noise, gamma, eight bits, JPEG.

Lens distortion is not here: the renderer traces the distorted rays exactly.
"""

from dataclasses import dataclass
from functools import cache
from statistics import NormalDist

import cv2
import numpy as np

from sigmaslam.errors import InputError

MIN_GAUSSIAN_PHOTONS = 20.0
"""Below this mean count shot noise is drawn from the exact Poisson law, above from the Gaussian of its moments."""
MAX_MOTION_TAPS = 32
_DISC_RADII = (0.0, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0)  # pixels; larger discs are cut to the last


@dataclass(frozen=True, slots=True)
class Sensor:
    """A grey-level camera, `dataclasses.asdict` of which is JSON.

    Attributes:
        gain: factor on the light (exposure), before the photons are counted.
        offset: black level that is added to the signal, share of white.
        blur: standard deviation of the lens's Gaussian point spread, pixels.
        vignetting: share of the light that the corner pixels lose, in [0, 1); falls off as cos^4 of the ray's angle.
        shutter: share of the frame interval that the shutter is open; motion is blurred over flow x shutter.
        photons_at_white: mean photon count of signal 1; shot noise has its square root.
        read_noise: standard deviation of the Gaussian noise, grey levels of 255.
        salt_and_pepper: probability that a pixel is stuck, black and white alike.
        gamma: exponent of the encoding: grey = 255 signal^gamma.
        bits: depth of the quantiser, 1 to 8; white is 255 for each.
        jpeg_quality: 1 to 100, None for no compression.
        focus_distance: depth of the plane in focus, metres.
        aperture: pixels of blur-disc radius per unit of inverse depth |1/z - 1/focus_distance|; 0 = all is sharp.

    Raises:
        ValueError: a value is out of range.
    """

    gain: float = 1.0
    offset: float = 0.0
    blur: float = 0.5
    vignetting: float = 0.0
    shutter: float = 0.0
    photons_at_white: float = 20000.0
    read_noise: float = 0.8
    salt_and_pepper: float = 0.0
    gamma: float = 1.0
    bits: int = 8
    jpeg_quality: int | None = None
    focus_distance: float = 1.0
    aperture: float = 0.0

    def __post_init__(self) -> None:
        for name in ("gain", "photons_at_white", "gamma", "focus_distance"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be above 0")
        for name in ("blur", "shutter", "read_noise", "aperture"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}; it must be 0 or more")
        if not (0 <= self.vignetting < 1 and 0 <= self.salt_and_pepper <= 1):
            raise ValueError(
                f"vignetting {self.vignetting} must be in [0, 1), salt_and_pepper {self.salt_and_pepper} in [0, 1]"
            )
        if not 1 <= self.bits <= 8:
            raise ValueError(f"bits is {self.bits}; an 8-bit image holds 1 to 8")
        if self.jpeg_quality is not None and not 1 <= self.jpeg_quality <= 100:
            raise ValueError(f"jpeg_quality is {self.jpeg_quality}; use 1 to 100, or None for no compression")


def expose(
    image: np.ndarray,
    sensor: Sensor,
    rng: np.random.Generator,
    flow: np.ndarray | None = None,
    depth: np.ndarray | None = None,
) -> np.ndarray:
    """The photograph of an ideal image.

    In this order: motion blur, depth of field, point spread, vignetting, gain, shot noise, black level, read noise,
    saturation, salt and pepper, gamma, quantisation, JPEG.

    Shot noise is Poisson where fewer than `MIN_GAUSSIAN_PHOTONS` photons are expected. Elsewhere it is Gaussian
    with the Poisson law's mean and variance (its skewness, at most 0.22, is lost), so that one draw from a table of
    quantiles serves shot and read noise together, in a fraction of the time of Poisson draws.

    Args:
        image: (H, W) linear light, 1 is white at gain 1; more saturates.
        sensor: what takes it.
        rng: source of the noise.
        flow: (H, W, 2) true displacement of each pixel in one frame interval, pixels; where it is not finite nothing
            is blurred. A constant field is fast, and may be given as (2,). The shutter opens half its time before the
            instant of the image. What an edge uncovers while it moves is guessed from its neighbours.
        depth: (H, W) z of each pixel, metres, for the depth of field; infinite is far, NaN or <= 0 is in focus.
    Returns:
        (H, W) uint8.
    """
    light: np.ndarray = np.asarray(image, dtype=np.float32)
    if flow is not None and sensor.shutter > 0:
        light = _blur_motion(light, np.asarray(flow, dtype=np.float32), sensor.shutter)
    if depth is not None and sensor.aperture > 0:
        light = _blur_out_of_focus(light, depth, sensor)
    if sensor.blur > 0:
        light = cv2.GaussianBlur(light, (0, 0), sensor.blur, borderType=cv2.BORDER_REFLECT)
    if sensor.vignetting > 0:
        light = light * _vignette(light.shape[0], light.shape[1], sensor.vignetting)
    if sensor.gain != 1.0:
        light = light * np.float32(sensor.gain)
    signal = _add_noise(light, sensor, rng)
    if sensor.offset != 0.0:
        signal += np.float32(sensor.offset)
    np.clip(signal, 0.0, 1.0, out=signal)
    if sensor.salt_and_pepper > 0:
        stuck = rng.binomial(signal.size, sensor.salt_and_pepper)
        where = rng.choice(signal.size, stuck, replace=False, shuffle=False)
        signal.ravel()[where] = rng.integers(0, 2, stuck)
    if sensor.gamma != 1.0:
        signal = cv2.pow(signal, sensor.gamma)
    steps = 2**sensor.bits - 1
    grey: np.ndarray = np.rint(signal * np.float32(steps))
    photograph = np.rint(grey * np.float32(255.0 / steps)).astype(np.uint8) if steps != 255 else grey.astype(np.uint8)
    if sensor.jpeg_quality is None:
        return photograph
    _, coded = cv2.imencode(".jpg", photograph, (cv2.IMWRITE_JPEG_QUALITY, sensor.jpeg_quality))
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_GRAYSCALE))


def random_sensor(rng: np.random.Generator) -> Sensor:
    """A camera of the training distribution.

    Contrast e^-1.2 to e^0.1 over a random black level, and noise of 0.2 to 4 % of white with the shape of shot
    noise, hold for the encoded image, whatever the gamma (e^-0.8 to e^0.6, so that 1/2.2 is among them): the
    linear gain, black level and noise follow from them. Shading by lamps belongs to the scene, and the direction of
    motion blur to `expose`'s flow. Depth of field is off.
    """
    gamma = float(np.exp(rng.uniform(-0.8, 0.6)))
    contrast = float(np.exp(rng.uniform(-1.2, 0.1)))
    black = rng.uniform(0.0, 1.0 - min(contrast, 1.0))
    offset = black ** (1 / gamma)
    gain = (black + contrast) ** (1 / gamma) - offset
    # Noise sigma n (0.3 + signal)^1/2 of the encoded image, taken back through the encoding at middle grey.
    middle = black + 0.5 * min(contrast, 1.0)
    noise = np.exp(rng.uniform(np.log(0.002), np.log(0.04))) * middle ** (1 / gamma - 1) / gamma
    return Sensor(
        gain=float(gain),
        offset=float(offset),
        blur=float(rng.uniform(0.3, 1.4)) if rng.random() < 0.5 else 0.0,
        vignetting=float(rng.uniform(0.0, 0.6)) if rng.random() < 0.4 else 0.0,
        shutter=float(rng.uniform(0.0, 0.6)),
        photons_at_white=float(noise**-2),
        read_noise=float(255.0 * np.sqrt(0.3) * noise),
        salt_and_pepper=float(np.exp(rng.uniform(np.log(1e-4), np.log(1e-2)))) if rng.random() < 0.15 else 0.0,
        gamma=gamma,
        jpeg_quality=int(rng.integers(30, 96)) if rng.random() < 0.2 else None,
    )


def exposure_gains(rng: np.random.Generator, frames: int, drift: float, difference: float) -> np.ndarray:
    """Gains of the two cameras of a pair, whose exposures wander together and apart.

    Args:
        rng: source of all randomness; a longer sequence begins as a shorter one.
        frames: number of pairs.
        drift: largest log of the common gain, the geometric mean of the two.
        difference: largest log of the quotient of the two gains.
    Returns:
        (frames, 2) gains of the left and the right camera, smooth over periods of 40 frames and more.
    """
    if frames < 1:
        raise InputError(f"frames is {frames}; give at least 1")
    share = rng.uniform(0.2, 1.0, (2, 3))
    share /= share.sum(axis=1, keepdims=True)
    periods = np.exp(rng.uniform(np.log(40.0), np.log(600.0), (2, 3)))
    phases = rng.uniform(0, 2 * np.pi, (2, 3))
    frame = np.arange(frames)[:, None, None]
    common, ratio = np.moveaxis((share * np.sin(2 * np.pi * frame / periods + phases)).sum(axis=-1), -1, 0)
    logs = np.stack([drift * common + 0.5 * difference * ratio, drift * common - 0.5 * difference * ratio], axis=-1)
    return np.asarray(np.exp(logs))


def _blur_motion(light: np.ndarray, flow: np.ndarray, shutter: float) -> np.ndarray:
    """The mean of the light along shutter x flow, (H, W, 2) or (2,) pixels, centred on each pixel."""
    if flow.ndim == 1 or bool((flow == flow[0, 0]).all()):
        smear = np.float32(shutter) * (flow if flow.ndim == 1 else flow[0, 0])
        if not np.isfinite(smear).all() or float(np.abs(smear).max()) < 0.05:
            return light
        return np.asarray(cv2.filter2D(light, -1, _line_kernel(smear), borderType=cv2.BORDER_REPLICATE))
    valid = np.isfinite(flow).all(axis=-1)
    along_x, along_y = (np.where(valid, np.float32(shutter) * flow[..., i], np.float32(0)) for i in (0, 1))
    longest = float(np.sqrt((along_x**2 + along_y**2).max()))
    taps = min(MAX_MOTION_TAPS, int(np.ceil(longest)) + 1)  # a pixel apart, between which remap interpolates
    if longest < 0.05:
        return light
    x, y = (np.arange(n, dtype=np.float32) for n in light.shape[::-1])
    total: np.ndarray = np.zeros_like(light)
    for share in ((np.arange(taps) + 0.5) / taps - 0.5).astype(np.float32):
        at_x, at_y = share * along_x + x, share * along_y + y[:, None]
        total += cv2.remap(light, at_x, at_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return total / np.float32(taps)


def _line_kernel(smear: np.ndarray) -> np.ndarray:
    """The filter that averages along smear (2,): points 1/8 pixel apart, each spread bilinearly; sums to 1."""
    taps = max(2, int(np.ceil(8 * np.linalg.norm(smear))))
    line = ((np.arange(taps) + 0.5) / taps - 0.5)[:, None] * smear.astype(np.float64)
    half = np.ceil(np.abs(line).max(axis=0)).astype(int)
    columns, rows = (np.arange(-n, n + 1) for n in half)
    across = np.maximum(0.0, 1.0 - np.abs(line[:, :1] - columns))
    down = np.maximum(0.0, 1.0 - np.abs(line[:, 1:] - rows))
    return np.asarray((down.T @ across / taps).astype(np.float32))


def _blur_out_of_focus(light: np.ndarray, depth: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Each pixel's light under its own disc, blended between blurred copies of the image in radius squared.

    The blend keeps the disc's variance, which goes with its radius squared. Light of a sharp edge leaks into a
    blurred neighbour, as each pixel gathers by its own disc.
    """
    focusable = depth > 0  # not for NaN
    inverse = 1.0 / np.where(focusable, depth, 1.0)
    radius = np.where(focusable, sensor.aperture * np.abs(inverse - 1.0 / sensor.focus_distance), 0.0)
    square = np.minimum(radius, _DISC_RADII[-1]).astype(np.float32) ** 2
    result, lower, sharper = light, 0.0, light
    for upper in _DISC_RADII[1:]:
        share = (square - np.float32(lower**2)) / np.float32(upper**2 - lower**2)
        if not (share > 0).any():
            break
        softer = cv2.filter2D(light, -1, _disc_kernel(upper), borderType=cv2.BORDER_REFLECT)
        blend = sharper + np.minimum(share, np.float32(1)) * (softer - sharper)
        result = np.where(share > 0, blend, result)
        lower, sharper = upper, softer
    return np.asarray(result)


def _disc_kernel(radius: float) -> np.ndarray:
    """A disc of that radius in pixels, whose edge is sampled 8 times a pixel; sums to 1."""
    half = int(np.ceil(radius))
    side = 2 * half + 1
    fine = (np.arange(8 * side) + 0.5) / 8 - side / 2
    inside = (fine**2 + fine[:, None] ** 2 <= radius**2).reshape(side, 8, side, 8).mean(axis=(1, 3))
    return np.asarray((inside / inside.sum()).astype(np.float32))


def _vignette(height: int, width: int, loss: float) -> np.ndarray:
    """(height, width) factors cos^4 of the ray's angle: 1 at the centre, 1 - loss at the corner pixels."""
    corner = 0.25 * ((height - 1) ** 2 + (width - 1) ** 2)
    tangent = ((1.0 - loss) ** -0.5 - 1.0) / max(corner, 1.0)  # of the angle, squared, at a radius of 1 pixel
    x = ((np.arange(width) - 0.5 * (width - 1)) ** 2 * tangent).astype(np.float32)
    y = ((np.arange(height) - 0.5 * (height - 1)) ** 2 * tangent + 1.0).astype(np.float32)
    secant = y[:, None] + x
    return np.asarray(np.float32(1) / (secant * secant))


def _add_noise(light: np.ndarray, sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """A new signal (H, W) float32: the light with shot and read noise."""
    per_photon = np.float32(1.0 / sensor.photons_at_white)
    variance: np.ndarray = np.maximum(light, np.float32(0)) * per_photon
    few = (light < MIN_GAUSSIAN_PHOTONS * per_photon) & (light > 0)
    counted = light
    if few.any():
        variance[few] = 0.0
        counted = light.copy()
        counted[few] = rng.poisson(light[few].astype(np.float64) * sensor.photons_at_white) * per_photon
    variance += np.float32((sensor.read_noise / 255.0) ** 2)
    signal = _normal(light.shape, rng)
    signal *= np.sqrt(variance, out=variance)
    signal += counted
    return signal


def _normal(shape: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Standard normal float32 numbers, of 65536 equally likely values up to 4.2: twice as fast as rng's own or more."""
    draws = np.frombuffer(rng.bytes(2 * int(np.prod(shape))), dtype="<u2")
    return np.asarray(_normal_quantiles()[draws].reshape(shape))


@cache
def _normal_quantiles() -> np.ndarray:
    """(65536,) float32 quantiles of the standard normal law at the middles of equal shares, to unit variance."""
    law = NormalDist()
    upper = np.array([law.inv_cdf(0.5 + (k + 0.5) / 65536) for k in range(32768)])
    upper /= np.sqrt(np.mean(upper**2))
    return np.concatenate([-upper[::-1], upper]).astype(np.float32)

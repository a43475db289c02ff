"""What `sigmaslam train render` offers: a domain, its stereo camera, its clock and the folder layout of its field."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sigmaslam.geometry.camera import CameraModel, DistortionModel
from sigmaslam_synthetic.camera.rig import Miscalibration, Rig, loose_rig, parallel_rig
from sigmaslam_synthetic.camera.sensor import Sensor
from sigmaslam_synthetic.worlds import colon, hall, organ, room, rubble, street, tool
from sigmaslam_synthetic.worlds.episode import Episode, Wish

Layout = Literal["kitti", "euroc"]


@dataclass(frozen=True, slots=True)
class Preset:
    """A kind of sequence.

    Attributes:
        generate: makes a random world as wished for.
        width, height: pixels.
        focal: pixels, at this width.
        baseline: metres.
        fps: pairs per second.
        layout: of the folder.
        distortion_model, distortion: of both lenses; with distortion the pair is not rectified.
    """

    generate: Callable[[np.random.Generator, Wish], Episode]
    width: int
    height: int
    focal: float
    baseline: float
    fps: float
    layout: Layout = "kitti"
    distortion_model: DistortionModel = "none"
    distortion: tuple[float, ...] = ()

    def rig(self, width: int, height: int, rng: np.random.Generator, errors: Miscalibration) -> Rig:
        """The stereo camera at another size; the field of view across stays the same."""
        focal = self.focal * width / self.width
        camera = CameraModel(
            width, height, focal, focal, (width - 1) / 2, (height - 1) / 2, 0.0, self.distortion_model, self.distortion
        )
        if self.distortion_model == "none":
            return parallel_rig(camera, self.baseline, errors)
        return loose_rig(camera, self.baseline, rng, errors)


PRESETS = {
    "room": Preset(room.generate, 640, 480, 460.0, 0.11, 20.0),
    "street": Preset(street.generate, 1242, 376, 718.0, 0.54, 10.0),
    "drone": Preset(hall.generate, 752, 480, 458.0, 0.11, 20.0, "euroc", "radtan", (-0.283, 0.074, 0.00019, 1.8e-05)),
    "colon": Preset(colon.generate, 640, 480, 350.0, 0.005, 25.0, "euroc", "equidistant", (-0.012, 0.004, -0.002, 0.0)),
    "organ": Preset(organ.generate, 640, 512, 520.0, 0.0045, 25.0),
    "tool": Preset(tool.generate, 640, 512, 520.0, 0.005, 25.0),
    "rubble": Preset(rubble.generate, 640, 480, 460.0, 0.11, 20.0),
}

# Sensors by name: what comes after the light has reached the lens.
SENSORS = {
    "ideal": Sensor(blur=0.0, read_noise=0.0, photons_at_white=1e9),
    "normal": Sensor(blur=0.5, vignetting=0.15, shutter=0.1, photons_at_white=10500.0, read_noise=0.4),
    "harsh": Sensor(
        blur=0.9,
        vignetting=0.4,
        shutter=0.5,
        photons_at_white=1500.0,
        read_noise=2.5,
        salt_and_pepper=2e-4,
        gamma=0.6,
        jpeg_quality=60,
    ),
    # A camera that opens its shutter for half of the time because there is little light.
    "slow": Sensor(blur=0.5, vignetting=0.15, shutter=0.5, photons_at_white=10500.0, read_noise=0.4),
}
# Largest logs of the common gain and of the quotient of the two cameras' gains.
EXPOSURES = {"ideal": (0.0, 0.0), "normal": (0.06, 0.06), "harsh": (0.4, 0.25), "slow": (0.06, 0.06)}

"""A robot with wheels in the plane, (9.43) and (9.44), with what is not known about its wheels and its sensor.

The state is the pose on SE(2), then nine constants that the filter estimates on the way:

| component | unit | what it is |
|---|---|---|
| speed scale, turn scale | 1 | relative error of the metres driven and the radians turned |
| speed offset, turn offset | m/s, rad/s | what the controls say of a robot at rest |
| drift | rad | direction of driving, seen from the heading: slip, or wheels that are not square to the sensor |
| bearing offset | rad | how the sensor is turned on the robot |
| range scale | 1 | relative error of the sensor's distances |
| sensor ahead, sensor left | m | where the sensor stands, beside where it is said to |
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from sigmaslam_filters import SE2, Diagonal, Euclidean, Gaussian, MeasurementModel, MotionModel, Product, stack
from sigmaslam_filters.systems import range_and_bearing_residual
from sigmaslam_localisation.recording import Recording

BODY = SE2("right")
CONSTANTS = (
    *("speed scale", "turn scale", "speed offset", "turn offset", "drift"),
    *("bearing offset", "range scale", "sensor ahead", "sensor left"),
)
SPACE = Product(BODY, Euclidean(len(CONSTANTS)))


@dataclass(frozen=True, slots=True)
class RobotNoise:
    """Standard deviations of an ordinary indoor robot. They are where a filter starts; its own data decide the rest.

    Attributes:
        start: of the first pose: metres, metres, radians.
        constants: of the constants before anything was seen, in the order of `CONSTANTS`.
        drive: of the metres driven: per square root of a second, and per square root of a metre.
        turn: of the radians turned: per square root of a second, and per square root of a radian.
        distance: of a sighting's distance: metres, and a share of the distance.
        bearing: of a sighting's direction, radians.
    """

    start: tuple[float, float, float] = (0.01, 0.01, 0.01)
    constants: tuple[float, ...] = (0.05, 0.05, 0.02, 0.005, 0.05, 0.01, 0.03, 0.02, 0.02)
    drive: tuple[float, float] = (0.01, 0.1)
    turn: tuple[float, float] = (0.02, 0.1)
    distance: tuple[float, float] = (0.03, 0.05)
    bearing: float = 0.02


@dataclass(frozen=True, slots=True)
class WheeledRobot:
    """Models of a robot that sees landmarks at known places.

    Attributes:
        kind: of its sightings, see `Recording`.
        lever: metres by which the sensor stands ahead of the robot's centre.
        noise: standard deviations.
    """

    kind: str
    lever: float
    noise: RobotNoise = RobotNoise()

    @classmethod
    def of(cls, recording: Recording) -> "WheeledRobot":
        """The robot that made a recording."""
        return cls(recording.kind, recording.lever)

    def prior(self, start: Tensor) -> Gaussian:
        """The belief at the first pose (..., 3)."""
        deviations = start.new_tensor([*self.noise.start, *self.noise.constants])
        mean = torch.nn.functional.pad(start, (0, len(CONSTANTS)))
        return Gaussian(mean, torch.diag(deviations.square()).expand(*start.shape[:-1], -1, -1))

    def motion(self, path: Tensor, duration: Tensor) -> MotionModel:
        """A step's motion; its inputs are the path (..., 2) and the duration (..., 1).

        The noise is that of the metres driven and the radians turned, and goes through the kinematics with them.
        """
        variance = [
            rates[0] ** 2 * duration + rates[1] ** 2 * path[..., i].abs()
            for i, rates in enumerate((self.noise.drive, self.noise.turn))
        ]
        return MotionModel(_drive, Diagonal(torch.stack(variance, dim=-1)), additive=False)

    def measurement(self) -> MeasurementModel:
        """Sighting of one landmark (..., 2), of unit noise."""
        unit = Diagonal(torch.ones(2, dtype=torch.float64))
        if self.kind == "cartesian":
            return MeasurementModel(self._seen_at, unit)
        return MeasurementModel(self._distance_and_bearing, unit, residual=range_and_bearing_residual)

    def variance(self, value: Tensor) -> Tensor:
        """Variances (..., 2) of sightings (..., 2), from the distance that was measured."""
        constant, share = self.noise.distance
        if self.kind == "cartesian":
            return (constant**2 + share**2 * value.square().sum(dim=-1, keepdim=True)).expand_as(value)
        distance = constant**2 + (share * value[..., 0]) ** 2
        return torch.stack([distance, torch.full_like(distance, self.noise.bearing**2)], dim=-1)

    def _seen_at(self, state: Tensor, landmark: Tensor) -> Tensor:
        """Metres ahead of the sensor and to its left (..., 2), (9.45)."""
        x, y = landmark[..., 0] - state[..., 0], landmark[..., 1] - state[..., 1]
        sine, cosine = torch.sin(state[..., 2]), torch.cos(state[..., 2])
        ahead, left = cosine * x + sine * y - self.lever - state[..., 10], cosine * y - sine * x - state[..., 11]
        sine, cosine = torch.sin(state[..., 8]), torch.cos(state[..., 8])
        scale = 1.0 + state[..., 9]
        return stack([scale * (cosine * ahead - sine * left), scale * (sine * ahead + cosine * left)])

    def _distance_and_bearing(self, state: Tensor, landmark: Tensor) -> Tensor:
        place = self._seen_at(state, landmark)
        ahead, left = place[..., 0], place[..., 1]
        return stack([torch.sqrt(ahead * ahead + left * left), torch.atan2(left, ahead)])


def _drive(state: Tensor, noise: Tensor, path: Tensor, duration: Tensor) -> Tensor:
    """An arc in the direction of the drift."""
    seconds = duration[..., 0]
    distance = path[..., 0] * (1.0 + state[..., 3]) + seconds * state[..., 5] + noise[..., 0]
    turn = path[..., 1] * (1.0 + state[..., 4]) + seconds * state[..., 6] + noise[..., 1]
    drift = state[..., 7]
    moved = BODY.retract(state[..., :3], stack([distance * torch.cos(drift), distance * torch.sin(drift), turn]))
    return stack([*moved.unbind(-1), *state[..., 3:].unbind(-1)])

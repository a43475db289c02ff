"""A robot that finds the landmarks on its way: simultaneous localisation and mapping in the plane.

The state is that of `WheeledRobot`, then the places x, y of all landmarks in the world, metres. Which landmark a
sighting is of is known. A landmark that was not seen yet stands at the origin, independent of all else, and has no part
in anything; its first sighting puts it into its place, by the inverse of (9.45), with the covariances that the robot's
pose, the constants and the sighting's noise give it, the cross covariances among them.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from sigmaslam_filters import BayesFilter, Diagonal, Euclidean, Gaussian, MeasurementModel, MotionModel, Product
from sigmaslam_filters.core.layout import concatenate
from sigmaslam_localisation.wheeled_robot import BODY, CONSTANTS, WheeledRobot

ROBOT_SIZE = BODY.point_size + len(CONSTANTS)
"""Components of a state before the landmarks, in points and in tangents."""


@dataclass(frozen=True, slots=True)
class MappingRobot:
    """Models of a robot whose state holds the landmarks.

    Attributes:
        robot: its own models.
        landmarks: how many there are.
    """

    robot: WheeledRobot
    landmarks: int

    @property
    def space(self) -> Product:
        """SE(2) x R^(9 + 2 landmarks)."""
        return Product(BODY, Euclidean(len(CONSTANTS) + 2 * self.landmarks))

    def prior(self, start: Tensor) -> Gaussian:
        """The belief at the first pose (..., 3), before any landmark was seen."""
        alone = self.robot.prior(start)
        size = 2 * self.landmarks
        mean = torch.nn.functional.pad(alone.mean, (0, size))
        covariance = torch.eye(ROBOT_SIZE + size, dtype=mean.dtype).repeat(*mean.shape[:-1], 1, 1)
        covariance[..., :ROBOT_SIZE, :ROBOT_SIZE] = alone.covariance
        return Gaussian(mean, covariance)

    def motion(self, path: Tensor, duration: Tensor) -> MotionModel:
        """As the robot's; the landmarks stand still."""
        return self.robot.motion(path, duration)

    def measurement(self) -> MeasurementModel:
        """Sighting of the landmark whose number is the input (..., 1), of unit noise."""
        known = self.robot.measurement()

        def see(state: Tensor, landmark: Tensor) -> Tensor:
            return known.function(state, _places(state, landmark))

        return MeasurementModel(see, known.noise, residual=known.residual)

    def variance(self, value: Tensor) -> Tensor:
        """As the robot's."""
        return self.robot.variance(value)

    def admit(
        self, bayes: BayesFilter, belief: Gaussian, value: Tensor, variance: Tensor, landmark: Tensor, new: Tensor
    ) -> Gaussian:
        """The belief with landmarks that were seen for the first time.

        Args:
            bayes: the filter on `space`.
            belief: (...,).
            value: (..., L, 2) sightings.
            variance: (..., L, 2) of their components.
            landmark: (..., L) numbers of the landmarks, integers.
            new: (..., L) whether the sighting is the first of its landmark.
        """
        for slot in new.any(dim=tuple(range(new.ndim - 1))).nonzero().flatten().tolist():
            there = new[..., slot]
            noise = Diagonal(torch.where(there[..., None], variance[..., slot, :], 1.0))
            # Another robot of the batch may have nothing there: NaN times zero would still be NaN.
            seen = torch.where(there[..., None], value[..., slot, :], 1.0)
            number = torch.where(there, landmark[..., slot], -1)[..., None]
            belief = bayes.predict(belief, MotionModel(self._put, noise, additive=False), seen, number).belief
        return belief

    def _put(self, state: Tensor, noise: Tensor, value: Tensor, landmark: Tensor) -> Tensor:
        """The state with the landmark of that number (..., 1) where a sighting says; unchanged for -1."""
        place = self.robot.place(state, value + noise)
        numbers = torch.arange(self.landmarks).repeat_interleave(2)
        places = torch.where(
            numbers == landmark, place.repeat(*[1] * (place.ndim - 1), self.landmarks), state[..., ROBOT_SIZE:]
        )
        return concatenate([state[..., :ROBOT_SIZE].expand(*places.shape[:-1], -1), places])


def _places(state: Tensor, landmark: Tensor) -> Tensor:
    """Places (..., 2) in the states of the landmarks with these numbers (..., 1)."""
    first = ROBOT_SIZE + 2 * landmark.long()
    index = torch.cat([first, first + 1], dim=-1)
    batch = torch.broadcast_shapes(state.shape[:-1], index.shape[:-1])
    return torch.gather(state.expand(*batch, -1), -1, index.expand(*batch, -1))

"""A robot that finds the landmarks on its way: simultaneous localisation and mapping in the plane.

The state is that of `WheeledRobot`, then the places x, y of all landmarks in the world, metres. Which landmark a
sighting is of is known. A landmark that was not seen yet stands at the origin, independent of all else, and has no part
in anything; its first sighting puts it into its place, by the inverse of (9.45), with the covariances that the robot's
pose, the constants and the sighting's noise give it, the cross covariances among them.

No sighting says where the world's frame is, how it is turned, or how long its metre is. A filter whose tangents are
changes of x, y and heading forgets that: the tangent of a turned world depends on the estimate, and updates at
different estimates add up to information that no sighting gave (Julier and Uhlmann 2001). In `MapSpace` what cannot be
seen is the same tangent at all estimates, as in the invariant filter of Barrau and Bonnabel (2015).
"""

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sigmaslam_filters import BayesFilter, Diagonal, Gaussian, MeasurementModel, MotionModel
from sigmaslam_filters.core.layout import concatenate
from sigmaslam_filters.manifolds.lie_groups import Pair, exp_se2, log_se2, turn, wrap_angle
from sigmaslam_filters.manifolds.spaces import Manifold
from sigmaslam_filters.manifolds.tangent_maps import tangent_maps
from sigmaslam_localisation.wheeled_robot import BODY, CONSTANTS, SPACE, WheeledRobot

ROBOT_SIZE = BODY.point_size + len(CONSTANTS)
"""Components of a state before the landmarks, in points and in tangents."""


@dataclass(frozen=True)
class MapSpace(Manifold):
    """States as points; tangents are twists that move the sensor and the landmarks, in units of the sensor's metre.

    A tangent has a translation of the sensor, a turn about the origin, which is that of all, the constants' changes,
    and a translation of each landmark. Of the group of these motions tangents are carried from one point to another as
    they are (`parallel`), as otherwise a turn at one estimate would be another motion at the next.

    Attributes:
        lever: metres by which the sensor is said to stand ahead of the robot's centre.
        landmarks: how many there are.
        origin: x, y in the world, metres, near the robot for the sake of round-off.
    """

    lever: float
    landmarks: int
    origin: tuple[float, float]
    parallel = True

    @property
    def point_size(self) -> int:
        """Length of a point and of a tangent."""
        return ROBOT_SIZE + 2 * self.landmarks

    tangent_size = point_size

    def _retract(self, point: Tensor, tangent: Tensor) -> Tensor:
        angle = tangent[..., 2:3]
        places, heading = self.sensed(point)
        x, y = turn(torch.sin(angle), torch.cos(angle), places)
        a, b = exp_se2(_columns(tangent), angle)
        constants = point[..., 3:ROBOT_SIZE] + tangent[..., 3:ROBOT_SIZE]
        scale = 1.0 + constants[..., 6:7]
        places = (x + a) / scale + self.origin[0], (y + b) / scale + self.origin[1]
        return self._at_lever(_joined(places, wrap_angle(heading + angle + constants[..., 5:6]), constants), -1.0)

    def _local(self, point: Tensor, other: Tensor) -> Tensor:
        (places, heading), ((a, b), other_heading) = self.sensed(point), self.sensed(other)
        angle = wrap_angle(other_heading - heading)
        x, y = turn(torch.sin(angle), torch.cos(angle), places)
        constants = other[..., 3:ROBOT_SIZE] - point[..., 3:ROBOT_SIZE]
        return _joined(log_se2((a - x, b - y), angle), angle, constants)

    def sensed(self, point: Tensor) -> tuple[Pair, Tensor]:
        """Places (..., 1 + M) of sensor and landmarks from the origin, in the sensor's metre; its heading (..., 1)."""
        scale, (x, y) = 1.0 + point[..., 9:10], _columns(self._at_lever(point, 1.0))
        return (scale * (x - self.origin[0]), scale * (y - self.origin[1])), point[..., 2:3] - point[..., 8:9]

    def _at_lever(self, point: Tensor, sign: float) -> Tensor:
        """The point with the place of the sensor in that of the robot, or back again by a sign of -1."""
        heading = point[..., 2:3]
        lever = turn(torch.sin(heading), torch.cos(heading), (self.lever + point[..., 10:11], point[..., 11:12]))
        return torch.cat([point[..., :2] + sign * torch.cat(lever, dim=-1), point[..., 2:]], dim=-1)


def _columns(vector: Tensor) -> Pair:
    """First and second coordinates (..., 1 + M) of the robot and of all landmarks."""
    places = torch.cat([vector[..., :2], vector[..., ROBOT_SIZE:]], dim=-1)
    return places[..., 0::2], places[..., 1::2]


def _joined(columns: Pair, angle: Tensor, constants: Tensor) -> Tensor:
    """The inverse of `_columns`, with an angle (..., 1) and the constants."""
    places = torch.stack(columns, dim=-1).flatten(-2)
    middle = torch.cat([angle, constants], dim=-1).expand(*places.shape[:-1], -1)
    return torch.cat([places[..., :2], middle, places[..., 2:]], dim=-1)


@dataclass(frozen=True, slots=True)
class MappingRobot(WheeledRobot):
    """Models of a robot whose state holds the landmarks.

    Attributes:
        landmarks: how many there are.
        origin: see `MapSpace`.
    """

    landmarks: int = 0
    origin: tuple[float, float] = (0.0, 0.0)

    @classmethod
    def of_robot(cls, robot: WheeledRobot, landmarks: int, poses: Tensor) -> "MappingRobot":
        """The robot with so many landmarks, near its first poses (B, 3)."""
        x, y, _ = poses.mean(dim=0).tolist()
        return cls(robot.kind, robot.lever, robot.noise, landmarks, (x, y))

    @property
    def space(self) -> MapSpace:
        """Of the state: the robot's pose and constants, then the places of the landmarks."""
        return MapSpace(self.lever, self.landmarks, self.origin)

    def enter(self, alone: Gaussian) -> Gaussian:
        """The belief of a robot on `SPACE`, before any landmark was seen."""
        maps = tangent_maps(replace(self.space, landmarks=0))
        point = alone.mean[..., None, :]
        along = torch.eye(ROBOT_SIZE, dtype=point.dtype).expand(*point.shape[:-2], -1, -1)
        change = maps.push_local(point, SPACE.push_retract(point, along)).mT
        return self.grow(Gaussian(alone.mean, change @ alone.covariance @ change.mT))

    def grow(self, belief: Gaussian) -> Gaussian:
        """A belief of fewer landmarks; those beyond them stand at the origin, independent of all."""
        before = belief.covariance
        more = (self.space.point_size - before.shape[-1]) // 2
        covariance = torch.eye(self.space.point_size, dtype=before.dtype).repeat(*before.shape[:-2], 1, 1)
        covariance[..., : before.shape[-1], : before.shape[-1]] = before
        places = belief.mean.new_tensor(self.origin).repeat(*before.shape[:-2], more)
        return Gaussian(torch.cat([belief.mean, places], dim=-1), covariance)

    def measurement(self) -> MeasurementModel:
        """Sighting of the landmark whose number is the input (..., 1), of unit noise."""
        known = WheeledRobot.measurement(self)

        def see(state: Tensor, landmark: Tensor) -> Tensor:
            index = ROBOT_SIZE + 2 * landmark.long() + torch.arange(2)
            batch = torch.broadcast_shapes(state.shape[:-1], index.shape[:-1])
            return known.function(state, state.expand(*batch, -1).gather(-1, index.expand(*batch, -1)))

        return MeasurementModel(see, known.noise, residual=known.residual)

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

    def place(self, state: Tensor, value: Tensor) -> Tensor:
        """Where in the world (..., 2) a landmark is of which that was seen, the inverse of (9.45)."""
        ahead, left = value[..., :1], value[..., 1:]
        if self.kind == "range-bearing":
            ahead, left = ahead * torch.cos(left), ahead * torch.sin(left)
        (x, y), heading = replace(self.space, landmarks=0).sensed(state[..., :ROBOT_SIZE])
        ahead, left = turn(torch.sin(heading), torch.cos(heading), (ahead, left))
        return torch.cat([x + ahead, y + left], dim=-1) / (1.0 + state[..., 9:10]) + state.new_tensor(self.origin)

    def _put(self, state: Tensor, noise: Tensor, value: Tensor, landmark: Tensor) -> Tensor:
        """The state with the landmark of that number (..., 1) where a sighting says; unchanged for -1."""
        place = self.place(state, value + noise)
        numbers = torch.arange(self.landmarks).repeat_interleave(2)
        places = torch.where(
            numbers == landmark, place.repeat(*[1] * (place.ndim - 1), self.landmarks), state[..., ROBOT_SIZE:]
        )
        return concatenate([state[..., :ROBOT_SIZE].expand(*places.shape[:-1], -1), places])

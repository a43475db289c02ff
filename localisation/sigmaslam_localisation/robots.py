"""Robots of a recording, localised in two passes: the first finds delay, constants and noise, the second uses them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sigmaslam.errors import InputError
from sigmaslam_filters import Gaussian, degree_of_belief
from sigmaslam_filters.manifolds import Space
from sigmaslam_filters.manifolds.tangent_maps import tangent_maps
from sigmaslam_localisation.localise import FilterName, Localisation, localise, make_filter
from sigmaslam_localisation.mapping_robot import ROBOT_SIZE, MappingRobot, MapSpace
from sigmaslam_localisation.recording import PlanarTruth, Recording
from sigmaslam_localisation.robot_step import Platform
from sigmaslam_localisation.smoothing import Smoother
from sigmaslam_localisation.steps import DELAYS, Steps, make_steps
from sigmaslam_localisation.wheeled_robot import BODY, CONSTANTS, SPACE, WheeledRobot


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkMap:
    """Landmarks that a robot found on its way.

    Attributes:
        landmark: (M,) indices of those that it saw.
        place: (M, 2) x, y in the world, metres.
        covariance: (2 M, 2 M) of x, y of the first, x, y of the second, and so on.
        true: (M, 2) where they are, NaN where that is not known; for scores alone.
    """

    landmark: np.ndarray
    place: np.ndarray
    covariance: np.ndarray
    true: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class RobotEstimate:
    """What is known of one robot.

    Attributes:
        name: of the robot.
        seconds: (K + 1,).
        pose: (K + 1, 3) x, y in metres, heading in radians.
        covariance: (K + 1, 3, 3) of the same, in the world.
        belief: (K + 1,) degree of belief in the position, in metres.
        seen: (K + 1, L) landmarks that were seen then, -1 for none.
        innovation: (K + 1, L, m), NaN for none.
        nis: (K + 1, L) of each sighting, of m degrees of freedom.
        weight: (K + 1, L) by robust weights.
        delay: seconds by which the robot follows its commands, or the sightings its odometry.
        constants: value and standard deviation of each by its name, at the end.
        scale: (m,) standard deviation of the sightings over the nominal one, at the end.
        truth: None if there is none.
        map: landmarks at the end; None if their places were given.
        smoothed, lagged: the same given what was seen later: all of it, or with a fixed lag; None if not asked for.
    """

    name: str
    seconds: np.ndarray
    pose: np.ndarray
    covariance: np.ndarray
    belief: np.ndarray
    seen: np.ndarray
    innovation: np.ndarray
    nis: np.ndarray
    weight: np.ndarray
    delay: float
    constants: dict[str, tuple[float, float]]
    scale: np.ndarray
    truth: PlanarTruth | None
    map: LandmarkMap | None = None
    smoothed: "RobotEstimate | None" = None
    lagged: "RobotEstimate | None" = None


def localise_robots(
    recordings: Sequence[Recording],
    filter_name: FilterName = "ukf",
    start: tuple[float, float, float] | None = None,
    tell: Callable[[str], None] = lambda _: None,
    mapping: bool = False,
    lag: float | None = None,
) -> tuple[list[RobotEstimate], list[RobotEstimate]]:
    """Estimates of each robot: of the first pass, and of the second.

    The first pass filters each robot under every one of `DELAYS` and keeps the most likely. Its poses depend on what
    was seen until then alone, but for that choice. The second begins with the constants and the noise that the first
    ended with, so its poses depend on the whole recording through these few numbers.

    Args:
        recordings: of robots of one kind.
        filter_name: see `make_filter`.
        start: x, y, heading of all robots; None: the first pose of the truth.
        tell: takes a line of progress.
        mapping: find the places of the landmarks too, each robot for itself; the recordings' are not looked at but for
            scores. The second pass begins without a map, as the first.
        lag: seconds of the fixed-lag smoother; None: nothing is smoothed. Not with `mapping`.
    Raises:
        InputError: there is no pose to start from.
    """
    count = len(DELAYS)
    steps = make_steps([each for each in recordings for _ in DELAYS], [*DELAYS] * len(recordings))
    starts = first_poses(recordings, steps.seconds[0, ::count], start)
    robot = WheeledRobot.of(recordings[0])
    prior = robot.prior(starts)
    repeated = prior[torch.arange(len(recordings)).repeat_interleave(count)]
    platform: Platform = robot
    space: Space = SPACE
    if mapping:
        mapper = MappingRobot.of_robot(robot, max(len(each.landmarks) for each in recordings), starts)
        platform, space, repeated = mapper, mapper.space, mapper.enter(repeated)
    bayes = make_filter(filter_name, space)
    first = localise(bayes, platform, repeated, steps, tell=lambda done: tell(f"first pass: {done:.0%}"))
    best = first.log_likelihood.reshape(-1, count).argmax(axis=1)
    chosen = np.arange(len(recordings)) * count + best
    delays = [DELAYS[index] for index in best]
    at_first = _estimates(recordings, delays, steps, first, chosen, space)

    steps = make_steps(recordings, delays)
    prior = _with_constants(prior, first.final[torch.from_numpy(chosen)])
    prior = mapper.enter(prior) if mapping else prior
    scale = torch.from_numpy(first.scale[-1, chosen])
    second = localise(
        bayes, platform, prior, steps, scale, lambda done: tell(f"second pass: {done:.0%}"), lag is not None
    )
    estimates = _estimates(recordings, delays, steps, second, np.arange(len(recordings)), space)
    if lag is None:
        return at_first, estimates
    tell("smoothing")
    pairs = zip(estimates, second.smoothers, strict=True)
    return at_first, [_with_smoothed(estimate, smoother, lag) for estimate, smoother in pairs]


def _with_smoothed(estimate: RobotEstimate, smoother: Smoother, lag: float) -> RobotEstimate:
    """The estimate with those that know what was seen later."""
    count = len(estimate.seconds)
    # Steps after the robot's own end are of no time and see nothing.
    seconds = np.pad(estimate.seconds, (0, len(smoother.mean) - count), mode="edge")
    found = []
    for mean, covariance in (smoother.smooth(), smoother.smooth(seconds, lag)):
        pose = mean[:count, :3]
        spread = in_world(SPACE, mean[:count], covariance[:count])[:, :3, :3]
        belief = degree_of_belief(torch.from_numpy(spread[:, :2, :2])).numpy()
        found.append(replace(estimate, pose=pose, covariance=spread, belief=belief))
    return replace(estimate, smoothed=found[0], lagged=found[1])


def first_poses(
    recordings: Sequence[Recording], seconds: np.ndarray, start: tuple[float, float, float] | None
) -> Tensor:
    """Poses (B, 3) of the robots at these times (B,): `start`, or where that is None those of the truth.

    Raises:
        InputError: there is no truth then.
    """
    if start is not None:
        return torch.tensor(start, dtype=torch.float64).expand(len(recordings), 3)
    poses = []
    for recording, second in zip(recordings, seconds, strict=True):
        pose = None if recording.truth is None else recording.truth.at(np.array([second]))[0]
        if pose is None or not np.isfinite(pose).all():
            raise InputError(f"{recording.name}: there is no true pose to start from: give --start X,Y,HEADING")
        poses.append(pose)
    return torch.from_numpy(np.stack(poses))


def _with_constants(prior: Gaussian, known: Gaussian) -> Gaussian:
    """The prior's poses, and the constants as they are known."""
    mean, covariance = prior.mean.clone(), prior.covariance.clone()
    constants = slice(BODY.point_size, ROBOT_SIZE)
    mean[:, constants] = known.mean[:, constants]
    covariance[:, constants, constants] = known.covariance[:, constants, constants]
    return Gaussian(mean, covariance)


def _estimates(
    recordings: Sequence[Recording],
    delays: Sequence[float],
    steps: Steps,
    result: Localisation,
    chosen: np.ndarray,
    space: Space,
) -> list[RobotEstimate]:
    estimates = []
    alone = replace(space, landmarks=0) if isinstance(space, MapSpace) else space
    for recording, delay, b in zip(recordings, delays, chosen, strict=True):
        K = int(steps.count[b])
        pose = result.mean[: K + 1, b, :3]
        covariance = in_world(alone, result.mean[: K + 1, b], result.covariance[: K + 1, b])[:, :3, :3]
        belief = degree_of_belief(torch.from_numpy(covariance[:, :2, :2])).numpy()
        final, deviation = result.mean[K, b], np.sqrt(np.diagonal(result.covariance[K, b]))
        nis = result.nis[:K, b]

        def after_start(column: np.ndarray, fill: float) -> np.ndarray:
            """With a row for the start, at which nothing was seen."""
            return np.concatenate([np.full_like(column[:1], fill), column])

        estimates.append(
            RobotEstimate(
                recording.name,
                steps.seconds[: K + 1, b],
                pose,
                covariance,
                belief,
                after_start(np.where(np.isnan(nis), -1, steps.landmark[:K, b]), -1),
                after_start(result.innovation[:K, b], np.nan),
                after_start(nis, np.nan),
                after_start(result.weight[:K, b], 1.0),
                delay,
                {name: (float(final[i]), float(deviation[i])) for i, name in enumerate(CONSTANTS, start=3)},
                np.sqrt(result.scale[K - 1, b]),
                recording.truth,
                _map(
                    recording, result.final[int(b)], steps.landmark[:K, b][~np.isnan(steps.value[:K, b, :, 0])], space
                ),
            )
        )
    return estimates


def _map(recording: Recording, final: Gaussian, seen: np.ndarray, space: Space) -> LandmarkMap | None:
    """What the belief at the end says of the landmarks that were seen; None if they are no part of the state."""
    if not isinstance(space, MapSpace):
        return None
    landmark = np.unique(seen)
    rows = (ROBOT_SIZE + 2 * landmark[:, None] + [0, 1]).ravel()
    mean = final.mean.numpy()
    covariance = in_world(space, mean, final.covariance.numpy())[np.ix_(rows, rows)]
    return LandmarkMap(landmark, mean[rows].reshape(-1, 2), covariance, recording.landmarks[landmark])


def in_world(space: Space, mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Covariances (..., p, p) of points (..., p) from those of tangents (..., n, n)."""
    point = torch.from_numpy(mean)
    along = torch.eye(covariance.shape[-1], dtype=point.dtype).expand(*mean.shape[:-1], -1, -1)
    change = tangent_maps(space).push_retract(point[..., None, :], along).mT.numpy()
    moved: np.ndarray = change @ covariance @ np.swapaxes(change, -1, -2)
    return moved

"""Which landmark each sighting is of, where no recording says so: likely pairs that are jointly compatible.

A filter goes once through the recording. At each time the sightings and the landmarks of the map that are compatible
one by one are paired so that as many as possible are, and the most likely ones; a pair that others could replace nearly
as well is left out, and so is the worst while all together are not compatible (Neira and Tardos 2001).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2, mode
from torch import Tensor

from sigmaslam_filters import BayesFilter, Diagonal, several
from sigmaslam_localisation.localise import FilterName, make_filter
from sigmaslam_localisation.mapping_robot import MappingRobot
from sigmaslam_localisation.recording import Recording
from sigmaslam_localisation.robot_step import RobotStep
from sigmaslam_localisation.robots import first_poses
from sigmaslam_localisation.sighting_noise import repetition
from sigmaslam_localisation.steps import DELAYS, Steps, make_steps
from sigmaslam_localisation.wheeled_robot import SPACE, WheeledRobot

COMPATIBLE = 0.999
"""Share of right pairs whose innovations lie within the gate, one by one and all of a time together."""
NEW = 1.0 - 1e-6
"""The same of the gate outside which a sighting is of no known landmark; what lies between the gates is left out."""
ODDS = 99.0
"""By which a pair must be more likely than the best that could replace it."""
ALIKE = 0.68
"""Share of pairs of sightings of one landmark that differ by less than the views of two that are alike: the noise hides
which of them is seen, and to take one for the other does no more harm than it.
"""
NOBODY = -1
"""Number of the landmark of a sighting that is left out."""
_FORBIDDEN, _UNPAIRED = 1e6, 1e3  # costs; those of pairs are squared sigmas within a gate, with a log-determinant


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """What a robot expects to see of each landmark of its map.

    Attributes:
        value: (M, m).
        covariance: (M m, M m) of all, from the uncertainty of the state alone.
        difference: of a sighting (..., m) and one that is expected.
    """

    value: np.ndarray
    covariance: np.ndarray
    difference: Callable[[np.ndarray, np.ndarray], np.ndarray]

    def pair(self, sightings: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Landmarks (L,) of sightings (L, m) with noise of that variance (L, m), `NOBODY` where none is sure; and
        whether each (L,) is so far from all that it is of none.
        """
        M, m = self.value.shape
        innovation = self.difference(sightings[:, None], self.value)
        blocks = self.covariance.reshape(M, m, M, m)[np.arange(M), :, np.arange(M)]
        spread = blocks + variance[:, None, :, None] * np.eye(m)
        distance = np.einsum("lni,lni->ln", innovation, np.linalg.solve(spread, innovation[..., None])[..., 0])
        cost = np.where(distance <= chi2.ppf(COMPATIBLE, m), distance + np.linalg.slogdet(spread)[1], _FORBIDDEN)
        choices = _choose(cost)
        scores = np.array([self._score(each, innovation, variance) for each in choices])
        best = scores.argmin()
        found = choices[best].copy()
        for row, column in enumerate(choices[best]):
            rivals = np.where(choices[:, row] == column, np.inf, scores)
            other = choices[rivals.argmin(), row]
            if column != NOBODY and rivals.min() - scores[best] <= 2.0 * np.log(ODDS):
                apart = np.inf if other == NOBODY else self.difference(self.value[column], self.value[other])
                if np.sum(apart**2 / variance[row]) > 2.0 * chi2.ppf(ALIKE, m):
                    found[row] = NOBODY
        return found, (distance > chi2.ppf(NEW, m)).all(axis=1)

    def _score(self, chosen: np.ndarray, innovation: np.ndarray, variance: np.ndarray) -> float:
        """Twice the negative log-likelihood of landmarks (L,) that are chosen together, by innovations (L, M, m)."""
        rows, m = np.flatnonzero(chosen != NOBODY), variance.shape[1]
        index = (chosen[rows, None] * m + np.arange(m)).ravel()
        joint = self.covariance[np.ix_(index, index)] + np.diag(variance[rows].ravel())
        off = innovation[rows, chosen[rows]].ravel()
        squared = float(off @ np.linalg.solve(joint, off))
        if squared > chi2.ppf(COMPATIBLE, max(len(off), 1)):
            return _FORBIDDEN
        return squared + float(np.linalg.slogdet(joint)[1]) + _UNPAIRED * (len(chosen) - len(rows))


def _choose(cost: np.ndarray) -> np.ndarray:
    """The cheapest landmarks (1 + N, L) of sightings by cost (L, M), then those without one of these N pairs each."""

    def solve(padded: np.ndarray) -> np.ndarray:
        columns = linear_sum_assignment(padded)[1]
        return np.where(columns < cost.shape[1], columns, NOBODY)

    padded = np.hstack([cost, np.full((len(cost), len(cost)), _UNPAIRED)])
    found = [solve(padded)]
    for row in np.flatnonzero(found[0] != NOBODY):
        without = padded.copy()
        without[row, found[0][row]] = _FORBIDDEN
        found.append(solve(without))
    return np.array(found)


class Association:
    """A filter that pairs what its robots see with its map as it goes: a known one, or what it has found so far.

    Attributes:
        found: (K, B, L) landmarks of the sightings of all steps, `NOBODY` where none is sure.
        count: (B,) landmarks of each robot.
    """

    def __init__(self, name: FilterName, robot: WheeledRobot, places: Tensor | None, start: Tensor, steps: Steps):
        """With the places (M, 2) of the landmarks, or None, and the first poses (B, 3)."""
        self._robot, self._places, self._steps = robot, places, steps
        self.found = np.full(steps.landmark.shape, NOBODY)
        self.count = np.full(len(start), 0 if places is None else len(places))
        self._belief = robot.prior(start)
        self._scale = torch.ones(len(start), 2, dtype=torch.float64)
        self._platform = robot
        self._bayes: BayesFilter = make_filter(name, SPACE)
        if places is None:
            mapper = MappingRobot.of_robot(robot, 0, start)
            self._platform, self._bayes = mapper, make_filter(name, mapper.space)
            self._belief = mapper.enter(self._belief)

    def run(self, tell: Callable[[float], None]) -> None:
        """Goes through all steps."""
        steps, width = self._steps, self._steps.value.shape[2]
        path, duration, value = (torch.from_numpy(each) for each in (steps.path, steps.duration, steps.value))
        nominal, there = self._robot.variance(value), ~np.isnan(steps.value).any(axis=-1)
        last = np.full((there.shape[1], 1), -np.inf)
        for k, present in enumerate(there):
            if k % 100 == 0:
                tell(k / len(there))
            step = RobotStep(self._bayes, self._platform, width)
            self._belief = step.move(self._belief, path[k], duration[k]).belief
            if not present.any():
                continue
            variance = nominal[k] * self._scale[:, None]
            new = self._pair(self.found[k], steps.value[k], variance.numpy(), present)
            last = np.pad(last, ((0, 0), (0, max(self.count.max() - last.shape[1], 0))), constant_values=-np.inf)
            number, used = np.maximum(self.found[k], 0), (self.found[k] != NOBODY) & ~new
            seconds, rows = steps.seconds[k + 1], np.arange(len(present))[:, None]
            since = torch.from_numpy(np.where(used, seconds[:, None] - last[rows, number], np.inf))
            b, slot = np.nonzero(used | new)
            last[b, number[b, slot]] = seconds[b]
            number = torch.from_numpy(number)
            seen = torch.where(torch.from_numpy(used)[..., None], value[k], torch.nan)
            position = number[..., None] if self._places is None else self._places[number]
            if used.any():
                step = RobotStep(self._bayes, self._platform, width)
                growth = repetition(since)
                self._belief, self._scale, *_ = step.look(self._belief, self._scale, seen, position, growth, nominal[k])
            if new.any() and isinstance(self._platform, MappingRobot):
                self._belief = self._platform.admit(
                    self._bayes, self._belief, value[k], variance, number, torch.from_numpy(new)
                )

    def _pair(self, found: np.ndarray, value: np.ndarray, variance: np.ndarray, present: np.ndarray) -> np.ndarray:
        """Writes the landmarks (B, L) of a step; which of the sightings (B, L) are of a new one."""
        new = np.zeros_like(present)
        expected = self._expect() if self.count.any() else None
        for b in np.flatnonzero(present.any(axis=1)):
            rows, count = np.flatnonzero(present[b]), self.count[b]
            away = np.ones(len(rows), bool)
            if expected is not None and count:
                views = Views(expected[0][b, :count], expected[1][b, : 2 * count, : 2 * count], self._differ)
                found[b, rows], away = views.pair(value[b, rows], variance[b, rows])
            if self._places is None:
                new[b, rows[away]] = True
                found[b, rows[away]] = count + np.arange(away.sum())
                self.count[b] += away.sum()
        if isinstance(self._platform, MappingRobot) and self.count.max() > self._platform.landmarks:
            self._platform = replace(self._platform, landmarks=int(self.count.max()))
            self._bayes = replace(self._bayes, space=self._platform.space)
            self._belief = self._platform.grow(self._belief)
        return new

    def _expect(self) -> tuple[np.ndarray, np.ndarray]:
        """What is expected (B, M, 2) of each landmark, and its covariance (B, 2 M, 2 M) by the state's."""
        M = int(self.count.max())
        see = several(self._platform.measurement(), M)
        position = torch.arange(M)[:, None] if self._places is None else self._places
        batch = self._belief.mean.shape[:-1]
        nothing = torch.zeros(*batch, 2 * M, dtype=torch.float64)
        noisy = replace(see, noise=Diagonal(torch.ones_like(nothing)))
        update = self._bayes.update(self._belief, noisy, nothing, position.expand(*batch, -1, -1))
        covariance = update.innovation_covariance - torch.eye(2 * M, dtype=torch.float64)
        return -update.innovation.unflatten(-1, (M, 2)).numpy(), covariance.numpy()

    def _differ(self, value: np.ndarray, expected: np.ndarray) -> np.ndarray:
        residual = self._robot.measurement().residual
        if residual is None:
            return value - expected
        return np.asarray(residual(torch.from_numpy(value), torch.from_numpy(expected)))


def associate(
    recordings: Sequence[Recording],
    filter_name: FilterName = "ukf",
    start: tuple[float, float, float] | None = None,
    tell: Callable[[str], None] = lambda _: None,
    mapping: bool = False,
) -> list[Recording]:
    """The recordings with landmarks that were found; what these say of them is looked at for scores alone.

    Of the delays that a robot may have the one counts with which most sightings are paired, less the landmarks that
    this takes. Sightings that are left out, and landmarks of a map that was found that were seen but once, are gone.

    Args:
        recordings: of robots of one kind, with one map.
        filter_name: see `make_filter`.
        start: as for `localise_robots`.
        tell: takes a line of progress.
        mapping: find the landmarks as well, each robot for itself. True places, for scores alone, are those of the
            landmark that most sightings are of.
    Raises:
        InputError: there is no pose to start from.
    """
    count = len(DELAYS)
    steps = make_steps([each for each in recordings for _ in DELAYS], [*DELAYS] * len(recordings))
    starts = first_poses(recordings, steps.seconds[0, ::count], start).repeat_interleave(count, dim=0)
    places = None if mapping else torch.from_numpy(recordings[0].landmarks)
    robot = Association(filter_name, WheeledRobot.of(recordings[0]), places, starts, steps)
    robot.run(lambda done: tell(f"association: {done:.0%}"))
    paired = (robot.found != NOBODY).sum(axis=(0, 2)) - robot.count
    best = paired.reshape(-1, count).argmax(axis=1) + count * np.arange(len(recordings))
    pairs = zip(recordings, best, strict=True)
    return [_with_landmarks(each, robot.found[:, b][~np.isnan(steps.value[:, b, :, 0])], mapping) for each, b in pairs]


def _with_landmarks(recording: Recording, found: np.ndarray, mapping: bool) -> Recording:
    """The recording's last sightings with the landmarks (S,) that were found; those before are in no step."""
    first, used = len(recording.seconds) - len(found), found != NOBODY
    places, names = recording.landmarks, recording.names
    if mapping:
        kept, times = np.unique(found[used], return_counts=True)
        kept = kept[times > 1]
        used &= np.isin(found, kept)
        most = np.array([mode(recording.landmark[first:][found == number]).mode for number in kept], int)
        places, names, found = np.vstack([places, np.full((1, 2), np.nan)])[most], None, np.searchsorted(kept, found)
    rows = first + np.flatnonzero(used)
    seen = {"seconds": recording.seconds[rows], "landmark": found[used], "sightings": recording.sightings[rows]}
    return replace(recording, **seen, landmarks=places, names=names)

"""`python -m sigmaslam.training.filter_tuning`: trains the match verifier's covariance through the filter.

The loss is the negative log likelihood of the true pose relative to the keyframe under the posterior of the
differentiable unscented update, for updates that the tracker accepts in rendered sequences. It moves the last layer's
rows of log sigma alone. An experiment: the shipped weights are made without it.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import track
from safetensors.torch import save_file
from torch import Tensor, nn

from sigmaslam.camera import StereoCamera
from sigmaslam.errors import InputError, SigmaSlamError
from sigmaslam.files import atomic_path
from sigmaslam.filters.lie import invert_se3, log_se3
from sigmaslam.filters.stereo_pose import CLONE, POSE, Update
from sigmaslam.frontend.descriptor import DescriptorFrontend
from sigmaslam.frontend.judge import MatchJudge
from sigmaslam.frontend.learned import LearnedDetector
from sigmaslam.frontend.types import Refinement, StereoView, TemporalMatches
from sigmaslam.models.export import load_verifier
from sigmaslam.models.verifier import MatchVerifier
from sigmaslam.pose_filter import PoseState, StereoPoints
from sigmaslam.readers import StereoSequence, open_sequence
from sigmaslam.rotation import se3_inverse
from sigmaslam.session import shipped_weights
from sigmaslam.tracker import Estimate, StereoTracker, _Fit
from sigmaslam.trajectory import Trajectory, read_trajectory

_LOGGER = logging.getLogger(__name__)
_TRUTH_NAMES = ("poses.txt", "mav0/state_groundtruth_estimate0/data.csv")
_LEARNING_RATE, _MOST_GRADIENT = 1e-2, 1.0

VerifierInputs = tuple[np.ndarray, np.ndarray]  # columns (M, 14) and axes (M, 2, 2), float32


@dataclass(frozen=True, slots=True)
class UpdateRecord:
    """One accepted update, with the verifier's inputs behind each noise.

    Attributes:
        prior: state that was updated.
        points: M measured landmarks.
        matches, landmarks: behind the covariances of the M places, and the M sigmas of disparity in the keyframe.
        disparities: behind the sigmas of the disparities that are known now, in the order of the points.
        intrinsics: (5,) as the filter takes them.
        T_key_camera: (4, 4) true pose of the rectified left camera relative to the keyframe.
    """

    prior: PoseState
    points: StereoPoints
    matches: VerifierInputs
    landmarks: VerifierInputs
    disparities: VerifierInputs
    intrinsics: np.ndarray
    T_key_camera: np.ndarray


@dataclass(frozen=True, slots=True)
class _Call:
    """What the verifier was given for M matches, and their keypoints (M, 2); those of image 0 are there once."""

    feed: Mapping[str, np.ndarray]
    points0: np.ndarray
    points1: np.ndarray

    def find(self, points0: np.ndarray) -> tuple[VerifierInputs, np.ndarray]:
        """Inputs of keypoints (K, 2) of image 0, and their partners; raises KeyError where one has none."""
        row_of = {tuple(point): row for row, point in enumerate(self.points0.tolist())}
        rows = np.array([row_of[tuple(point)] for point in points0.tolist()], np.int64)
        return (self.feed["columns"][rows], self.feed["axes"][rows]), self.points1[rows]


class _RecordingJudge(MatchJudge):
    """Remembers the calls of the verifier until they are cleared; of one frame the first is the stereo pair's."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[_Call] = []
        self._feed: Mapping[str, np.ndarray] = {}
        self._graph, self._verifier = self._verifier, self._listen

    def _listen(self, feed: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        self._feed = feed
        return self._graph(feed)

    def verify(
        self,
        image0: np.ndarray,
        image1: np.ndarray,
        points0: np.ndarray,
        logit: np.ndarray,
        refinement: Refinement,
        sigma: tuple[np.ndarray, np.ndarray],
    ) -> tuple[np.ndarray, np.ndarray]:
        found = super().verify(image0, image1, points0, logit, refinement, sigma)
        self.calls.append(_Call(self._feed, points0, refinement.start))
        return found


class RecordingTracker(StereoTracker):
    """Tracks with the shipped networks; `records` has accepted updates, None for those that could not be traced.

    Args:
        camera: calibration of the raw images.
        truth: poses of the raw left camera.
    """

    def __init__(self, camera: StereoCamera, truth: Trajectory) -> None:
        super().__init__(camera)
        self.records: list[UpdateRecord | None] = []
        poses = truth.poses @ se3_inverse(self._T_rectified_left)
        self._truth = {round(time, 3): T for time, T in zip(truth.timestamps.tolist(), poses, strict=True)}
        self._judge = _RecordingJudge()
        self._frontend = DescriptorFrontend("learned", LearnedDetector(self.config.max_keypoints), self._judge)
        self._now = 0.0
        self._key: tuple[float, _Call]  # time and stereo pair of the keyframe
        self._tried: list[tuple[_Fit, UpdateRecord | None]] = []

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float) -> Estimate:
        """As `StereoTracker.step`."""
        self._now = round(float(timestamp), 3)
        self._judge.calls.clear()
        self._tried.clear()
        return super().step(left, right, timestamp)

    def _take_keyframe(self, view: StereoView) -> bool:
        taken = super()._take_keyframe(view)
        if taken:
            self._key = self._now, self._judge.calls[0]
        return taken

    def _fit(self, found: TemporalMatches) -> _Fit | None:
        # A frame may try two priors with matches of their own; which fit is accepted is not known yet.
        fit = super()._fit(found)
        if fit is not None:
            self._tried.append((fit, self._trace(fit.points)))
        return fit

    def _accept(self, fit: _Fit, view: StereoView, timestamp: float) -> None:
        self.records.append(next(record for tried, record in self._tried if tried is fit))
        super()._accept(fit, view, timestamp)

    def _trace(self, points: StereoPoints) -> UpdateRecord | None:
        """The update by the latest matches and what their noise is made of; None where that or the truth is missing."""
        known = np.isfinite(points.measurement[:, 2])
        try:
            T_key_camera = se3_inverse(self._truth[self._key[0]]) @ self._truth[self._now]
            matches, places = self._judge.calls[-1].find(points.landmarks[:, :2])
            landmarks, _ = self._key[1].find(points.landmarks[:, :2])
            disparities, _ = self._judge.calls[0].find(places[known])
        except KeyError:
            return None
        state, intrinsics = self._filter.state, self._filter._intrinsics
        return UpdateRecord(state, points, matches, landmarks, disparities, intrinsics, T_key_camera)


def open_rendered(folder: Path) -> tuple[StereoSequence, Trajectory]:
    """A rendered sequence and the true poses of its left camera; raises InputError where one is missing."""
    for path in (folder / name for name in _TRUTH_NAMES):
        if path.is_file():
            return open_sequence(folder), read_trajectory(path)
    raise InputError(f"{folder} has no {' or '.join(_TRUTH_NAMES)}: make it by 'sigmaslam render NAME --truth sparse'")


def record_updates(folder: Path, frames: int | None = None) -> list[UpdateRecord]:
    """Tracks a rendered sequence, or its first frames, and records the accepted updates.

    Raises:
        InputError: the folder is no sequence or has no truth, or no update could be recorded.
    """
    sequence, truth = open_rendered(folder)
    tracker = RecordingTracker(sequence.camera, truth)
    for frame in islice(sequence.frames(), frames):
        tracker.step(frame.left, frame.right, frame.timestamp)
    records = [record for record in tracker.records if record is not None]
    if len(records) < len(tracker.records):
        _LOGGER.warning("%s: %d of %d updates could be recorded", folder, len(records), len(tracker.records))
    if not records:
        raise InputError(f"{folder}: no update at the time of a true pose could be recorded: track more frames")
    return records


def covariances(verifier: MatchVerifier, inputs: VerifierInputs) -> Tensor:
    """(M, 2, 2) float64, pixels squared."""
    axes, (_, log_sigma) = torch.from_numpy(inputs[1]).double(), verifier(torch.from_numpy(inputs[0]))
    return (axes * torch.exp(2.0 * log_sigma.double()).unsqueeze(1)) @ axes.transpose(1, 2)


def assess(verifier: MatchVerifier, record: UpdateRecord) -> tuple[Tensor, Tensor, Tensor]:
    """Repeats an update with the verifier's covariances.

    Returns:
        Negative log likelihood (), but for its constant, of the true pose relative to the keyframe; its NEES () and
        the NIS () of the update, both per degree of freedom.
    """
    prior, points = record.prior, record.points
    known = np.isfinite(points.measurement)
    noise = torch.eye(3, dtype=torch.float64).repeat(len(known), 1, 1)
    noise[:, :2, :2] = covariances(verifier, record.matches)
    noise[torch.from_numpy(known[:, 2]), 2, 2] = covariances(verifier, record.disparities)[:, 0, 0]
    landmark_sigma = _double(points.landmark_sigma)
    landmark_sigma[:, 2] = covariances(verifier, record.landmarks)[:, 0, 0].sqrt()
    state = map(_double, (prior.pose, prior.clone, prior.twist, prior.offset, prior.covariance, record.intrinsics))
    measurement = _double(np.where(known, points.measurement, 0.0))
    pose, clone, _, _, P, nis, _, _ = Update()(
        *state, _double(points.landmarks), landmark_sigma, measurement, noise, _double(known)
    )
    # Both are perturbed from the left, in the world: what they have in common does not count.
    factor = torch.linalg.cholesky(P[POSE, POSE] - P[POSE, CLONE] - P[CLONE, POSE] + P[CLONE, CLONE])
    error = log_se3(clone @ _double(record.T_key_camera) @ invert_se3(pose))
    whitened = torch.linalg.solve_triangular(factor, error.unsqueeze(1), upper=False)
    nees = (whitened * whitened).sum()
    return 0.5 * nees + torch.log(torch.diagonal(factor)).sum(), nees / 6.0, nis / int(known.sum())


def _double(values: np.ndarray) -> Tensor:
    return torch.from_numpy(values.astype(np.float64))


def tune(verifier: MatchVerifier, records: Sequence[UpdateRecord], epochs: int, seed: int) -> Iterator[float]:
    """Trains the last layer in place, one update a step, each once an epoch in random order; yields the losses.

    The loss does not depend on logits: their row has no gradient and stays.
    """
    parameters = list(verifier.requires_grad_(False).layers[-1].requires_grad_(True).parameters())
    optimiser = torch.optim.Adam(parameters, _LEARNING_RATE)
    rng = np.random.default_rng(seed)
    for index in (index for _ in range(epochs) for index in rng.permutation(len(records))):
        loss, _, _ = assess(verifier, records[index])
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(parameters, _MOST_GRADIENT)
        optimiser.step()
        yield float(loss.detach())


def main(argv: Sequence[str] | None = None) -> None:
    """Records, trains, prints how well the filter knows its poses; progress goes to the standard error."""
    parser = argparse.ArgumentParser(prog="python -m sigmaslam.training.filter_tuning", description=__doc__)
    add = parser.add_argument
    for name, use in (("--train", "to learn from"), ("--test", "to measure on")):
        text = f"sequences {use}, made by 'sigmaslam render NAME --out FOLDER --truth sparse'"
        add(name, nargs="+", type=Path, required=True, metavar="FOLDER", help=text)
    add("--out", type=Path, required=True, metavar="FILE", help="tuned weights, .safetensors")
    add("--epochs", type=int, default=4, metavar="N", help="times that each update is seen (%(default)s)")
    add("--seed", type=int, default=0, metavar="N", help="of their order (%(default)s)")
    add("--frames", type=int, metavar="N", help="tracked of each sequence, from the first (all)")
    add("--last", type=int, default=30, metavar="N", help="updates used of each sequence, the latest (%(default)s)")
    try:
        _run(parser.parse_args(argv))
    except SigmaSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def _run(arguments: argparse.Namespace) -> None:
    out, epochs, frames, last = arguments.out, arguments.epochs, arguments.frames, arguments.last
    if out.suffix != ".safetensors" or not out.parent.is_dir():
        raise InputError(f"--out {out} must end in .safetensors and be in a folder that exists")
    if min(epochs, last, 1 if frames is None else frames) < 1 or arguments.seed < 0:
        raise InputError("--epochs, --frames and --last must be at least 1, --seed at least 0")
    for folder in (*arguments.train, *arguments.test):
        open_rendered(folder)
    torch.set_num_threads(1)
    console = Console(stderr=True)
    train, test = (
        [each for folder in track(some, "tracking", console=console) for each in record_updates(folder, frames)[-last:]]
        for some in (arguments.train, arguments.test)
    )
    verifier = load_verifier(shipped_weights("verifier.safetensors"))
    steps = tune(verifier, train, epochs, arguments.seed)
    print("epoch  set    updates    NLL: mean (median)   NEES/dof: mean (median)   NIS/dof: mean (median)")
    for epoch in range(epochs + 1):
        if epoch:
            list(track(islice(steps, len(train)), f"epoch {epoch}", len(train), console=console))
        for name, records in (("train", train), ("test", test)):
            with torch.no_grad():
                values = np.array([[float(value) for value in assess(verifier, record)] for record in records])
            cells = [f"{a:.3f} ({b:.3f})" for a, b in zip(values.mean(axis=0), np.median(values, axis=0), strict=True)]
            print(f"{epoch:5}  {name:5}  {len(records):7}  {cells[0]:>20}  {cells[1]:>24}  {cells[2]:>23}", flush=True)
    with atomic_path(out) as temporary:
        save_file({name: value.contiguous() for name, value in verifier.state_dict().items()}, temporary)


if __name__ == "__main__":
    main()

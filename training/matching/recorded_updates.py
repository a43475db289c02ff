"""Updates that the tracker made in rendered sequences, with what the verifier of places was asked for each view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from sigmaslam.errors import InputError
from sigmaslam.estimation.frame_fit import FrameFit
from sigmaslam.estimation.frame_update import FrameUpdate
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.evaluation.metrics.trajectory_errors import MAX_DIFFERENCE
from sigmaslam.filters.tracking.frame_update import FrameEstimate, FrameViews, update_frame
from sigmaslam.frontend.descriptor import DescriptorFrontend
from sigmaslam.frontend.learned import LearnedDetector
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.frontend.patch_evidence import Evidence
from sigmaslam.frontend.verifier_inputs import PlaceSearch
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.se3 import se3_inverse
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.readers import StereoSequence
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.estimate import Estimate
from sigmaslam.slam.frame import Frame
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.tracker import StereoTracker

# Pixels by which a place may differ between front-end and filter: right places are differences of copied numbers.
_SAME_PLACE = 1e-9
# Relative difference of a view's covariance from what the verifier said, beside one factor for all views of a frame.
_SAME_COVARIANCE = 1e-5


@dataclass(frozen=True, slots=True)
class Questions:
    """Rows that the verifier of places was asked about.

    Attributes:
        columns: (M, C) of `sigmaslam.frontend.verifier_inputs.describe_places`.
        axes: (M, 2, 2) of the patches, as columns.
    """

    columns: Tensor
    axes: Tensor

    def covariances(self, verifier: nn.Module) -> Tensor:
        """(M, 2, 2) pixels squared."""
        covariance: Tensor = verifier(self.columns, self.axes)[1]
        return covariance


@dataclass(frozen=True, slots=True)
class RecordedUpdate:
    """One accepted update of a frame that was followed; float64, M views.

    Attributes:
        frame: the window, and what of it the frame sees; `common` is made anew by `views_noise`.
        measurement: (M, 3) (u, v, disparity), pixels, NaN for a missing disparity.
        places: behind the covariances of the M places.
        disparities: behind the sigmas of the disparities that are not missing, in the order of the views.
        noise_scale: what all variances were multiplied by when the views were made.
        shared_place, shared_disparity: of `TrackerConfig`.
        freedom: () of the Student-t.
        inflation: what the tracker multiplied the covariance of the relative pose by afterwards.
        T_last_frame: (4, 4) true pose relative to the last keyframe, of the rectified left camera.
        relative: (6, 6) covariance of the pose relative to the last keyframe as the tracker had it, not inflated.
    """

    frame: FrameViews
    measurement: Tensor
    places: Questions
    disparities: Questions
    noise_scale: float
    shared_place: float
    shared_disparity: float
    freedom: Tensor
    inflation: float
    T_last_frame: Tensor
    relative: Tensor

    def views_noise(self, verifier: nn.Module) -> tuple[Tensor, Tensor]:
        """(M, 3, 3) noise of each view alone and (M, 3, 2) `common`, as `MeasurementNoise.split`, by this verifier."""
        whole = self.noise_scale * self.places.covariances(verifier)
        of_disparity = self.noise_scale * self.disparities.covariances(verifier)[:, 0, 0]
        known = torch.isfinite(self.measurement[:, 2])
        variance = torch.ones_like(self.measurement[:, 2]).masked_scatter(known, of_disparity)
        noise = torch.nn.functional.pad((1.0 - self.shared_place) * whole, (0, 1, 0, 1))
        noise = noise + (1.0 - self.shared_disparity) * torch.diag_embed(
            torch.nn.functional.pad(variance[:, None], (2, 0))
        )
        # The symmetric root of a matrix of two rows.
        root = torch.linalg.det(whole).sqrt()[:, None, None]
        trace = torch.diagonal(whole, dim1=1, dim2=2).sum(dim=1)[:, None, None]
        symmetric = (whole + root * torch.eye(2, dtype=whole.dtype)) / (trace + 2.0 * root).sqrt()
        return noise, torch.nn.functional.pad(self.shared_place**0.5 * symmetric, (0, 0, 0, 1))

    def repeat(self, verifier: nn.Module) -> FrameEstimate:
        """The update again, with the covariances of this verifier; inflated as it was."""
        noise, common = self.views_noise(verifier)
        found = update_frame(self.measurement, noise, self.frame._replace(common=common), self.freedom)
        return found._replace(covariance=self.inflation * found.covariance)

    def log_likelihood(self, found: FrameEstimate) -> Tensor:
        """() of the true pose relative to the last keyframe, by what `repeat` found."""
        return found.log_likelihood(self.frame.poses[-1], self.T_last_frame, self.frame.poses[-2])

    def nees(self, found: FrameEstimate) -> Tensor:
        """() squared error of that pose in units of its covariance; 6 on the mean where that is right."""
        error, covariance = found.relative_error(self.frame.poses[-1], self.T_last_frame, self.frame.poses[-2])
        return error @ torch.linalg.solve(covariance, error)


@dataclass(frozen=True, slots=True)
class _Call:
    """A call of the verifier.

    Attributes:
        search: how the places were found.
        places: (M, 2) pixels.
        covariance: (M, 2, 2) that it gave them, pixels squared.
        feed: what the graph was given.
    """

    search: PlaceSearch
    places: np.ndarray
    covariance: np.ndarray
    feed: Mapping[str, np.ndarray]

    def rows_of(self, places: np.ndarray) -> np.ndarray | None:
        """(K,) rows of places (K, 2), or of their u (K, 1); None where one is not among them, or is there twice."""
        near = np.abs(places[:, None] - self.places[:, : places.shape[1]]).max(axis=2) < _SAME_PLACE
        return near.argmax(axis=1) if (near.sum(axis=1) == 1).all() else None

    def questions(self, rows: np.ndarray) -> Questions:
        """What was asked in these rows."""
        return Questions(*(torch.from_numpy(self.feed[name][rows]).double() for name in ("columns", "axes")))


class RecordingEstimator(ConfidenceEstimator):
    """Remembers what the verifier of places was asked, until `calls` is cleared."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[_Call] = []
        self._graph, self._place_verifier = self._place_verifier, self._listen
        self._feed: Mapping[str, np.ndarray] = {}

    def verify_places(
        self,
        places: np.ndarray,
        predicted: np.ndarray,
        evidence: Evidence,
        sigma0: np.ndarray,
        search: PlaceSearch,
        slope: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `ConfidenceEstimator.verify_places`."""
        answer = super().verify_places(places, predicted, evidence, sigma0, search, slope)
        if len(places):
            self.calls.append(_Call(search, places, answer[1].astype(np.float64), self._feed))
        return answer

    def _listen(self, feed: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        self._feed = feed
        return self._graph(feed)


@dataclass(frozen=True, slots=True)
class _Fit:
    """A fit of a frame's pose with what it was made from."""

    fit: FrameFit
    views: LandmarkViews
    known: Mapping[str, np.ndarray]


class _RecordingUpdate(FrameUpdate):
    """Remembers the fits of a frame near its prediction, until `fits` is cleared."""

    def __init__(self, window: KeyframeWindow, iterations: int) -> None:
        super().__init__(window, iterations)
        self.fits: list[_Fit] = []

    def fit(
        self,
        views: LandmarkViews,
        pose: np.ndarray,
        step_covariance: np.ndarray,
        min_inliers: int,
        start: np.ndarray | None = None,
        scale: float = 1.0,
    ) -> FrameFit | None:
        """As `FrameUpdate.fit`."""
        found = super().fit(views, pose, step_covariance, min_inliers, start, scale)
        if found is not None and start is None:
            factor = self._prior_factor(step_covariance, -1)
            self.fits.append(_Fit(found, views, self._views(views.landmark, views.common, pose, factor)))
        return found


class RecordingTracker(StereoTracker):
    """Tracks a rendered sequence as it ships.

    Args:
        camera: of the sequence.
        truth: poses of its left camera.
        estimator: of the matches.

    Attributes:
        updates: those that could be traced back to the verifier.
        followed: how many frames were followed, whose updates should be there.
    """

    def __init__(self, camera: StereoCamera, truth: Trajectory) -> None:
        config, self._estimator = TrackerConfig(), RecordingEstimator()
        detector = LearnedDetector(config.max_keypoints, threads=1)
        super().__init__(camera, DescriptorFrontend("learned", detector, self._estimator), config=config, threads=1)
        self._recording = _RecordingUpdate(self._window, config.iterations)
        self._localiser = replace(self._localiser, update=self._recording)
        self._truth = Trajectory(truth.timestamps, truth.poses @ se3_inverse(self._T_rectified_left))
        self._last_keyframe = np.eye(4)
        self.updates: list[RecordedUpdate] = []
        self.followed = 0

    def step(self, left: np.ndarray, right: np.ndarray, timestamp: float) -> Estimate:
        """As `StereoTracker.step`."""
        self._estimator.calls.clear()
        self._recording.fits.clear()
        estimate = super().step(left, right, timestamp)
        if estimate.tracks is not None:
            self._last_keyframe = self._true_pose(timestamp)
        return estimate

    def _correct(self, fit: FrameFit, matches: GuidedMatches, frame: Frame, timestamp: float) -> FrameFit:
        inflated = super()._correct(fit, matches, frame, timestamp)
        made = next((each for each in self._recording.fits if each.fit is fit), None)
        if made is not None and self._estimator.calls[0].search is PlaceSearch.IN_TIME:
            self.followed += 1
            traced = self._trace(made, inflated.inflation, timestamp)
            self.updates += [] if traced is None else [traced]
        return inflated

    def _trace(self, made: _Fit, inflation: float, timestamp: float) -> RecordedUpdate | None:
        """The update with what the verifier was asked; None where a view cannot be told to be of one question."""
        measurement, calls = made.views.measurement, self._estimator.calls
        if len(calls) < 2 or calls[1].search is not PlaceSearch.PREDICTED_ALONG_ROWS:
            return None
        in_time, along_rows = calls[:2]
        known = np.isfinite(measurement[:, 2])
        rows = in_time.rows_of(measurement[:, :2])
        # Patches in the right image may also be off in v.
        rows_right = along_rows.rows_of(measurement[known, :1] - measurement[known, 2:])
        if rows is None or rows_right is None:
            return None
        of_place = made.views.covariance[:, :2, :2] / in_time.covariance[rows]
        of_disparity = made.views.noise[known, 2, 2] / along_rows.covariance[rows_right, 0, 0]
        ratios = np.append(of_place[:, [0, 1], [0, 1]], of_disparity / (1.0 - self.config.shared_disparity))
        noise_scale = float(np.median(ratios))
        if np.abs(ratios / noise_scale - 1.0).max() > _SAME_COVARIANCE:
            return None
        return RecordedUpdate(
            FrameViews(*(torch.from_numpy(np.asarray(made.known[name])) for name in FrameViews._fields)),
            torch.from_numpy(measurement),
            in_time.questions(rows),
            along_rows.questions(rows_right),
            noise_scale,
            self.config.shared_place,
            self.config.shared_disparity,
            torch.tensor(self._window.student_freedom, dtype=torch.float64),
            inflation,
            torch.from_numpy(se3_inverse(self._last_keyframe) @ self._true_pose(timestamp)),
            torch.from_numpy(made.fit.relative),
        )

    def _true_pose(self, timestamp: float) -> np.ndarray:
        distance = np.abs(self._truth.timestamps - timestamp)
        if distance.min() > MAX_DIFFERENCE:
            raise InputError(f"there is no true pose at {timestamp:.3f} s: render the sequence again")
        return np.asarray(self._truth.poses[distance.argmin()])


def record_updates(sequence: StereoSequence, truth: Trajectory) -> list[RecordedUpdate]:
    """Tracks a rendered sequence and records the updates of the frames that were followed.

    Raises:
        InputError: none could be recorded.
    """
    tracker = RecordingTracker(sequence.camera, truth)
    for frame in sequence.frames():
        tracker.step(frame.left, frame.right, frame.timestamp)
    if not tracker.updates:
        counts = f"none of {tracker.followed} followed frames"
        raise InputError(f"{sequence.source}: the updates of {counts} could be recorded: render more frames")
    return tracker.updates

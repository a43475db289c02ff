"""The back end: a window of keyframes whose landmarks are marginalised, and the update of a frame against it.

Every keyframe of the window keeps the views of its landmarks. The joint posterior of the keyframes' poses and the
stereo calibration follows from what is known of them without these landmarks (the prior) and from all views at once,
each landmark eliminated from its own equations (the MSCKF's null space by Schur's complement). So every measurement
counts once, a landmark's error is shared by all its views as it should be, and a long track ties all the keyframes that
saw it. A keyframe that leaves the window takes its landmarks along: their views become part of the prior.

A frame that is no keyframe is estimated from the window's posterior and its own views alone, and then forgotten but for
the velocity: nothing of it can be counted twice.

Poses are perturbed from the left, in the world: views see relative poses alone, for which a common motion of all is the
same vector everywhere, so that no linearisation point can leak information into what cannot be seen.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from sigmaslam.camera import RectifiedStereo
from sigmaslam.rotation import nearest_rigid, se3_adjoint, se3_exp, se3_inverse, se3_log
from sigmaslam.session import load_step

CALIBRATION = slice(0, 3)
CALIBRATION_SIZE = 3
LANDMARK_SIZE = 4
# 99.9 % quantiles of chi-square with 0, 1, 2 and 3 degrees of freedom.
CHI_SQUARE_999 = np.array([0.0, 10.827566170662733, 13.815510557964274, 16.26623619623813])
# 99.99 % quantile of chi-square with 6 degrees of freedom.
_CHI_SQUARE_6 = 27.856341436212
# Of the robust loss by which a frame's pose is first found: its scales in standard deviations.
_ROBUST_SCALES = (6.0, 4.0, 3.0)
# Errors of right matches have longer tails than a Gaussian's: degrees of freedom of the Student-t that is fitted.
_STUDENT_FREEDOM = 4.0
# A disparity that is not there: its variance, pixels squared.
_UNKNOWN = 1e12
# Least spread of sigma points: share of the scene's depth, radians, pixels; with it alone slopes are derivatives.
_LEAST_SPREAD = 1e-6
# Largest standard deviation that sigma points are drawn from: share of the scene's depth and radians.
_MOST_SPREAD = 0.05


def pose_slice(clone: int) -> slice:
    """Where the pose of a keyframe, or behind the last that of the frame, stands in the state."""
    return slice(CALIBRATION_SIZE + 6 * clone, CALIBRATION_SIZE + 6 * clone + 6)


@dataclass(frozen=True, slots=True)
class Views:
    """Landmarks seen by one frame.

    Attributes:
        rows: (M,) which landmarks of the window, each once.
        measurement: (M, 3) (u, v, disparity); the disparity may be NaN.
        noise: (M, 3, 3) its covariance.
    """

    rows: np.ndarray
    measurement: np.ndarray
    noise: np.ndarray

    def select(self, index: np.ndarray) -> Views:
        """The views of that index or mask."""
        return Views(self.rows[index], self.measurement[index], self.noise[index])

    @property
    def components(self) -> np.ndarray:
        """(M,) how many numbers each view measures, 2 or 3."""
        return np.isfinite(self.measurement).sum(axis=1)


def join_views(parts: list[Views]) -> Views:
    """All views of all parts."""
    names = ("rows", "measurement", "noise")
    return Views(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


@dataclass(frozen=True, slots=True)
class FrameFit:
    """Posterior of a frame's pose together with the window.

    Attributes:
        pose: (4, 4) T_world_camera.
        relative: (6, 6) covariance of the pose relative to the last keyframe, perturbed from the left in the world.
        covariance: (6, 6) of the pose, likewise.
        calibration, calibration_covariance: (3,), (3, 3) as this frame adds to it.
        kept: (M,) bool, the views that agree.
        nis, dof: of the kept ones.
    """

    pose: np.ndarray
    relative: np.ndarray
    covariance: np.ndarray
    calibration: np.ndarray
    calibration_covariance: np.ndarray
    kept: np.ndarray
    nis: float
    dof: int

    @property
    def nis_per_dof(self) -> float:
        """1 where the covariances are right."""
        return self.nis / max(self.dof, 1)


@dataclass(slots=True)
class Landmarks:
    """The window's landmarks, a table.

    Attributes:
        host: (L,) position of the keyframe that they were first seen in.
        feature: (L,) index among its features.
        measured, variance: (L, 4), (L, 4) (u, v, disparity) there, zero for what its disparities are off by in all
            views alike, and their variances.
        estimate: (L, 4) refined by all views.
        covariance: (L, 4, 4) of that given poses and calibration.
        dependence: (L, 4, n) how it moves with the state (calibration and poses of the window).
        views: (L,) how many keyframes and frames have confirmed it.
        misses: (L,) frames in a row in which it was looked for and not found.
        serial: (L,) number that stays.
    """

    host: np.ndarray
    feature: np.ndarray
    measured: np.ndarray
    variance: np.ndarray
    estimate: np.ndarray
    covariance: np.ndarray
    dependence: np.ndarray
    views: np.ndarray
    misses: np.ndarray
    serial: np.ndarray

    def __len__(self) -> int:
        return len(self.host)

    @classmethod
    def empty(cls, size: int) -> Landmarks:
        """No landmark, for a state of that size."""
        whole = np.zeros(0, np.int64)
        flat, square = np.zeros((0, LANDMARK_SIZE)), np.zeros((0, LANDMARK_SIZE, LANDMARK_SIZE))
        return cls(whole, whole, flat, flat, flat, square, np.zeros((0, LANDMARK_SIZE, size)), whole, whole, whole)

    def select(self, index: np.ndarray) -> Landmarks:
        """The landmarks of that index or mask."""
        return Landmarks(*(getattr(self, name)[index] for name in self.__slots__))


@dataclass(slots=True)
class _Observations:
    """Views by keyframes other than the host, a table."""

    landmark: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    clone: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    measurement: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    noise: np.ndarray = field(default_factory=lambda: np.zeros((0, 3, 3)))

    def select(self, index: np.ndarray) -> _Observations:
        return _Observations(self.landmark[index], self.clone[index], self.measurement[index], self.noise[index])

    def append(self, clone: int, views: Views) -> _Observations:
        return _Observations(
            np.r_[self.landmark, views.rows],
            np.r_[self.clone, np.full(len(views.rows), clone)],
            np.concatenate([self.measurement, views.measurement]),
            np.concatenate([self.noise, views.noise]),
        )


@dataclass(frozen=True, slots=True)
class _Slopes:
    """Measurements of landmarks by views, linearised: expectation, derivatives by state and landmark, what is left."""

    mean: np.ndarray
    by_state: np.ndarray
    by_landmark: np.ndarray
    left: np.ndarray
    in_front: np.ndarray


class KeyframeWindow:
    """Poses of the last keyframes, the stereo calibration, and the landmarks that tie them; owns the state.

    Args:
        camera: the rectified pair.
        calibration_sigma: (3,) prior of the calibration, pixels; zero switches a state off.
        backend: "onnx" or "torch".
        linearisation: "unscented", or "extended": first derivatives.
        iterations: linearisations of a frame's update.
    """

    def __init__(
        self,
        camera: RectifiedStereo,
        calibration_sigma: np.ndarray,
        backend: str = "onnx",
        linearisation: str = "unscented",
        iterations: int = 2,
    ) -> None:
        self.camera = camera
        self._intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.fx * camera.baseline])
        self._transfer = load_step("stereo_transfer", backend)
        self._unscented = linearisation == "unscented"
        self._iterations = iterations
        self.poses = np.zeros((0, 4, 4))
        self.calibration = np.zeros(CALIBRATION_SIZE)
        self.covariance = np.diag(calibration_sigma.astype(float) ** 2)
        self.landmarks = Landmarks.empty(CALIBRATION_SIZE)
        self.depth = 1.0
        self._observations = _Observations()
        self._prior_poses = self.poses
        self._prior_calibration = self.calibration
        self._prior = self.covariance
        self._next_serial = 0

    def __len__(self) -> int:
        return len(self.poses)

    def restart(self) -> None:
        """Forgets all keyframes and landmarks; what is known of the calibration stays."""
        self.poses = self._prior_poses = np.zeros((0, 4, 4))
        self._prior = self.covariance = self.covariance[CALIBRATION, CALIBRATION]
        self._prior_calibration = self.calibration
        self.landmarks = Landmarks.empty(CALIBRATION_SIZE)
        self._observations = _Observations()

    def add_keyframe(self, pose: np.ndarray, step: np.ndarray, step_covariance: np.ndarray, walk: np.ndarray) -> None:
        """Adds a keyframe to the end of the window.

        Args:
            pose: (4, 4) estimate of T_world_camera.
            step: (4, 4) T_last_new as it was expected without its images; of the first one T_world_camera.
            step_covariance: (6, 6) of that, perturbed from the left in the world.
            walk: (3,) variances by which the calibration may have moved since the last keyframe.
        """
        count = len(self.poses)
        expected = self._prior_poses[-1] @ step if count else step
        size = CALIBRATION_SIZE + 6 * count
        grown = np.zeros((2, size + 6, size + 6))
        last = pose_slice(count - 1) if count else slice(0, 0)
        for new, old in zip(grown, (self._prior, self.covariance), strict=True):
            new[:size, :size] = old
            new[range(CALIBRATION_SIZE), range(CALIBRATION_SIZE)] += walk
            if count:
                new[size:, :size] = old[last, :]
                new[:size, size:] = old[:, last]
                new[size:, size:] = old[last, last]
            new[size:, size:] += step_covariance
        self._prior, self.covariance = grown
        self._prior_poses = np.concatenate([self._prior_poses, nearest_rigid(expected)[None]])
        self.poses = np.concatenate([self.poses, nearest_rigid(pose)[None]])
        self.landmarks.dependence = np.pad(self.landmarks.dependence, ((0, 0), (0, 0), (0, 6)))

    def add_views(self, views: Views) -> None:
        """Remembers what the last keyframe sees of landmarks of earlier ones."""
        self._observations = self._observations.append(len(self.poses) - 1, views)

    def add_landmarks(self, feature: np.ndarray, measured: np.ndarray, variance: np.ndarray) -> None:
        """Adds landmarks that the last keyframe sees first.

        Args:
            feature: (K,) index among the keyframe's features.
            measured: (K, 3) (u, v, disparity).
            variance: (K, 4) of these, and of what the disparities are off by in all views alike.
        """
        count = len(feature)
        size = len(self.covariance)
        new = Landmarks(
            np.full(count, len(self.poses) - 1),
            feature,
            np.pad(measured, ((0, 0), (0, 1))),
            variance,
            np.pad(measured, ((0, 0), (0, 1))),
            np.eye(LANDMARK_SIZE) * variance[:, None, :],
            np.zeros((count, LANDMARK_SIZE, size)),
            np.ones(count, np.int64),
            np.zeros(count, np.int64),
            self._next_serial + np.arange(count),
        )
        self._next_serial += count
        old = self.landmarks
        self.landmarks = Landmarks(
            *(np.concatenate([getattr(old, name), getattr(new, name)]) for name in Landmarks.__slots__)
        )

    def solve(self, iterations: int = 2) -> None:
        """Posterior of poses, calibration and landmarks from the prior and all views: Gauss-Newton, then a gate."""
        factor = _root(self._prior)
        for _ in range(iterations):
            information, vector, elimination = self._eliminate(self._observations)
            offset = self._from_prior()
            state, self.covariance = _condition(factor, information, vector + information @ offset)
            self._move(state - offset, elimination)
        self._drop_outliers()

    def tie(self, pose: np.ndarray, match: np.ndarray, origin: np.ndarray) -> bool:
        """Ties the last keyframe to a pose that an old keyframe gives it: a loop is closed.

        What happened between the two is independent of where the old one was, so that its covariance is common to both
        and the match says something about the rest alone.

        Args:
            pose: (4, 4) T_world_camera of the last keyframe as the old one sees it.
            match: (6, 6) covariance of that given the old one, perturbed from the left in the world.
            origin: (6, 6) covariance of the old one's pose, likewise.
        Returns:
            False, and nothing is changed, where the two poses contradict each other.
        """
        last = pose_slice(len(self.poses) - 1)
        estimated = self.covariance[last, last] - origin + match
        apart = se3_log(pose @ se3_inverse(self.poses[-1]))
        if apart @ np.linalg.lstsq(estimated, apart, rcond=1e-12)[0] > _CHI_SQUARE_6:
            return False
        common = np.zeros((len(self._prior), 6))
        for clone in range(len(self.poses)):
            common[pose_slice(clone)] = origin
        drift = self._prior[:, last] - common
        gain = np.linalg.lstsq(drift[last] + match, drift.T, rcond=1e-12)[0].T
        step = gain @ se3_log(pose @ se3_inverse(self._prior_poses[-1]))
        self._prior_poses = nearest_rigid(se3_exp(step[CALIBRATION_SIZE:].reshape(-1, 6)) @ self._prior_poses)
        self._prior_calibration = self._prior_calibration + step[CALIBRATION]
        root = _root(self._prior - gain @ drift.T)
        self._prior = root @ root.T
        self.solve()
        return True

    def predict(
        self, rows: np.ndarray, pose: np.ndarray, step_covariance: np.ndarray, anchor: int = -1
    ) -> tuple[np.ndarray, ...]:
        """Where a frame should see landmarks.

        Args:
            rows: (K,) which.
            pose: (4, 4) expected T_world_camera.
            step_covariance: (6, 6) of it relative to a keyframe, perturbed from the left in the world.
            anchor: that keyframe; the last one by default.
        Returns:
            (u, v, disparity) (K, 3), its covariance without the measurement's noise (K, 3, 3), in front (K,) bool.
        """
        covariance = _factor_with_frame(_root(self.covariance), step_covariance, anchor % len(self.poses))
        covariance = covariance @ covariance.T
        slopes = self._linearise_frame(rows, pose, np.zeros(len(covariance)), covariance, np.zeros((len(rows), 4)))
        noise, by_state = self._frame_noise(rows, slopes, np.zeros((len(rows), 3, 3)))
        return slopes.mean, noise + _spread(by_state, covariance), slopes.in_front

    def fit_frame(
        self, views: Views, pose: np.ndarray, step_covariance: np.ndarray, least: int, start: np.ndarray | None = None
    ) -> FrameFit | None:
        """Posterior of a frame's pose; nothing is remembered.

        Args:
            views: what it sees.
            pose, step_covariance: as of `predict`: the prior.
            least: fewer inliers are no pose.
            start: (4, 4) pose to linearise at first, close to the truth; then the innovations are not gated against
                the prior but only their rest after the update.
        Returns:
            None where too few views agree.
        """
        factor = _factor_with_frame(_root(self.covariance), step_covariance, len(self.poses) - 1)
        prior = factor @ factor.T
        frame = pose_slice(len(self.poses))
        components = views.components
        offset = np.zeros(len(prior))
        spread = prior
        if start is not None:
            offset[frame] = se3_log(start @ se3_inverse(pose))
            spread = _certain_frame(prior, frame)
        # Landmarks are estimated along with the pose: measured places and depths in the role of known ones would
        # draw the pose towards no motion.
        moved = np.zeros((len(views.rows), LANDMARK_SIZE))
        step, kept = 0, None
        while True:
            slopes = self._linearise_frame(views.rows, pose, offset, spread, moved)
            noise, by_state = self._frame_noise(views.rows, slopes, views.noise)
            expected = slopes.mean - (slopes.by_landmark @ moved[..., None])[..., 0]
            residual, noise = _masked(views.measurement - expected, noise)
            scale = np.linalg.inv(noise)
            squared = np.einsum("mi,mij,mj->m", residual, scale, residual)
            usable = slopes.in_front & (squared < _UNKNOWN)
            if step >= self._iterations:
                agree = usable & (squared <= CHI_SQUARE_999[components])
                if step == self._iterations + 2 or (kept is not None and (agree == kept).all()):
                    break
                kept = agree
            if usable.sum() < least or (kept is not None and kept.sum() < least):
                return None
            whitened = _whiten(np.concatenate([by_state, residual[..., None]], axis=2), noise)
            if kept is not None:
                weight = kept * _student_weight(squared, components)
                solution, posterior = self._weigh(factor, whitened, offset, weight)
            else:
                # A loss that narrows, first about what the prior expects.
                if step == 0 and start is None:
                    squared = _squared(residual, noise + _spread(by_state, prior))
                for limit in _ROBUST_SCALES:
                    weight = usable / (1.0 + squared / limit**2) ** 2
                    solution, posterior = self._weigh(factor, whitened, offset, weight)
                    left = residual - by_state @ (solution - offset)
                    squared = np.einsum("mi,mij,mj->m", left, scale, left)
            left = residual - by_state @ (solution - offset)
            own = self.landmarks.covariance[views.rows] @ slopes.by_landmark.transpose(0, 2, 1)
            moved = (own @ (scale @ left[..., None]))[..., 0]
            offset, spread = solution, posterior
            step += 1
        kept &= agree
        if kept.sum() < least:
            return None
        paid = np.linalg.lstsq(factor, offset, rcond=1e-12)[0]
        last = pose_slice(len(self.poses) - 1)
        cross = posterior[frame, last]
        return FrameFit(
            nearest_rigid(se3_exp(offset[frame]) @ pose),
            posterior[frame, frame] + posterior[last, last] - cross - cross.T,
            posterior[frame, frame],
            self.calibration + offset[CALIBRATION],
            posterior[CALIBRATION, CALIBRATION],
            kept,
            float(paid @ paid + squared[kept].sum()),
            int(components[kept].sum()),
        )

    def retire_oldest(self) -> Landmarks:
        """Drops the oldest keyframe; its landmarks' views become part of the prior. Returns these landmarks."""
        leaving = self.landmarks.host == 0
        information, vector, _ = self._eliminate(self._observations.select(leaving[self._observations.landmark]))
        offset = self._from_prior()
        moved, covariance = _condition(_root(self._prior), information, vector + information @ offset)
        count = len(self.poses)
        self._prior_poses = nearest_rigid(se3_exp(moved[CALIBRATION_SIZE:].reshape(count, 6)) @ self._prior_poses)[1:]
        self._prior_calibration = self._prior_calibration + moved[CALIBRATION]
        rest = np.r_[0:CALIBRATION_SIZE, CALIBRATION_SIZE + 6 : len(covariance)]
        self._prior = covariance[np.ix_(rest, rest)]
        self.covariance = self.covariance[np.ix_(rest, rest)]
        self.poses = self.poses[1:]
        retired = self.landmarks.select(leaving)
        self._forget(~leaving)
        self.landmarks.host = self.landmarks.host - 1
        self.landmarks.dependence = self.landmarks.dependence[:, :, rest]
        self._observations.clone = self._observations.clone - 1
        return retired

    def true_disparity(self, landmarks: np.ndarray) -> np.ndarray:
        """(u, v, disparity) (K, 3) of landmarks (K, 4) without what the calibration and their own errors add."""
        x = (landmarks[:, 0] - landmarks[:, 2] - self.camera.cx) / self.camera.fx
        y = (landmarks[:, 1] - self.camera.cy) / self.camera.fy
        constant, yaw, pitch = self.calibration
        bias = landmarks[:, 3] + constant + yaw * x * x + pitch * x * y
        return np.column_stack([landmarks[:, :2], landmarks[:, 2] - bias])

    # ---- the equations

    @staticmethod
    def _weigh(
        factor: np.ndarray, whitened: np.ndarray, offset: np.ndarray, weight: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Posterior mean and covariance from derivatives with residuals (3 M, n + 1) about `offset`, weighted (M,)."""
        rows = whitened * np.sqrt(np.repeat(weight, 3))[:, None]
        by, rest = rows[:, :-1], rows[:, -1]
        information, vector = by.T @ by, by.T @ rest
        return _condition(factor, information, vector + information @ offset)

    def _from_prior(self) -> np.ndarray:
        """The estimate minus the prior's mean, in the state's coordinates."""
        poses = se3_log(self.poses @ se3_inverse(self._prior_poses)).ravel()
        return np.r_[self.calibration - self._prior_calibration, poses]

    def _eliminate(self, observations: _Observations) -> tuple[np.ndarray, np.ndarray, _Elimination]:
        """Information matrix and vector of the state at the estimate, every landmark's own equations solved for it."""
        landmarks = self.landmarks
        seen, owner = np.unique(observations.landmark, return_inverse=True)
        slopes, residual, noise, components = self._linearise_observations(observations)
        noise[~slopes.in_front] = _UNKNOWN * np.eye(3)
        size = len(self.covariance)
        stacked = np.concatenate([slopes.by_state, slopes.by_landmark, residual[..., None]], axis=2)
        whitened = np.linalg.solve(np.linalg.cholesky(noise), stacked)
        weight = _student_weight((whitened[:, :, -1] ** 2).sum(axis=1), components)
        whitened *= np.sqrt(weight)[:, None, None]
        by_state, by_landmark, rest = whitened[:, :, :size], whitened[:, :, size:-1], whitened[:, :, -1:]
        products = by_landmark.transpose(0, 2, 1) @ np.concatenate([by_landmark, by_state, rest], axis=2)
        order = np.argsort(owner, kind="stable")
        begins = np.searchsorted(owner[order], np.arange(len(seen)))
        sums = (
            np.add.reduceat(products[order], begins, axis=0)
            if len(seen)
            else np.zeros((0, LANDMARK_SIZE, LANDMARK_SIZE + size + 1))
        )
        own = sums[:, :, :LANDMARK_SIZE] + np.eye(LANDMARK_SIZE) / landmarks.variance[seen][:, None, :]
        vector = sums[:, :, -1] + (landmarks.measured[seen] - landmarks.estimate[seen]) / landmarks.variance[seen]
        lower = np.linalg.cholesky(own)
        reduced = np.linalg.solve(lower, np.concatenate([sums[:, :, LANDMARK_SIZE:-1], vector[..., None]], axis=2))
        tall, flat = by_state.reshape(-1, size), reduced[:, :, :size].reshape(-1, size)
        information = tall.T @ tall - flat.T @ flat
        right = tall.T @ rest.ravel() - flat.T @ reduced[:, :, -1].ravel()
        inverse = np.linalg.inv(own)
        return (
            information,
            right,
            _Elimination(seen, inverse, -inverse @ sums[:, :, LANDMARK_SIZE:-1], (inverse @ vector[..., None])[..., 0]),
        )

    def _move(self, step: np.ndarray, elimination: _Elimination) -> None:
        self.calibration = self.calibration + step[CALIBRATION]
        self.poses = nearest_rigid(se3_exp(step[CALIBRATION_SIZE:].reshape(-1, 6)) @ self.poses)
        seen = elimination.rows
        self.landmarks.estimate[seen] += elimination.step + elimination.dependence @ step
        self.landmarks.covariance[seen] = elimination.covariance
        self.landmarks.dependence[seen] = elimination.dependence

    def _drop_outliers(self) -> None:
        """Views that do not fit the solution are forgotten."""
        slopes, residual, noise, components = self._linearise_observations(self._observations)
        agree = slopes.in_front & (_squared(residual, noise) <= CHI_SQUARE_999[components])
        if not agree.all():
            self._observations = self._observations.select(agree)

    def _linearise_observations(
        self, observations: _Observations
    ) -> tuple[_Slopes, np.ndarray, np.ndarray, np.ndarray]:
        """Views by keyframes at the estimate: slopes, residuals (O, 3), their noise (O, 3, 3), components (O,)."""
        landmarks = self.landmarks
        slopes = self._linearise(
            self.poses,
            self.calibration,
            self.covariance,
            landmarks.estimate[observations.landmark],
            landmarks.covariance[observations.landmark],
            landmarks.host[observations.landmark],
            observations.clone,
        )
        residual, noise = _masked(observations.measurement - slopes.mean, observations.noise + slopes.left)
        return slopes, residual, noise, np.isfinite(observations.measurement).sum(axis=1)

    def _forget(self, kept: np.ndarray) -> None:
        """Keeps only some landmarks, and their views."""
        number = np.cumsum(kept) - 1
        views = kept[self._observations.landmark]
        self._observations = self._observations.select(views)
        self._observations.landmark = number[self._observations.landmark]
        self.landmarks = self.landmarks.select(kept)

    def _linearise_frame(
        self, rows: np.ndarray, pose: np.ndarray, offset: np.ndarray, covariance: np.ndarray, moved: np.ndarray
    ) -> _Slopes:
        """Views of landmarks by the frame, with the state moved by `offset` from the window's estimate and `pose`.

        The landmarks follow the state, and lie `moved` (M, 4) from there.
        """
        size = len(self.covariance)
        poses = np.concatenate([self.poses, pose[None]])
        poses = se3_exp(offset[CALIBRATION_SIZE:].reshape(-1, 6)) @ poses
        landmarks = self.landmarks
        return self._linearise(
            poses,
            self.calibration + offset[CALIBRATION],
            covariance,
            landmarks.estimate[rows] + landmarks.dependence[rows] @ offset[:size] + moved,
            landmarks.covariance[rows],
            landmarks.host[rows],
            np.full(len(rows), len(self.poses)),
        )

    def _frame_noise(self, rows: np.ndarray, slopes: _Slopes, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Noise with that of the landmarks, and derivatives by the state with those through the landmarks."""
        size = len(self.covariance)
        by_state = slopes.by_state.copy()
        by_state[:, :, :size] += slopes.by_landmark @ self.landmarks.dependence[rows]
        return noise + slopes.left + _spread(slopes.by_landmark, self.landmarks.covariance[rows]), by_state

    def _linearise(
        self,
        poses: np.ndarray,
        calibration: np.ndarray,
        covariance: np.ndarray,
        landmarks: np.ndarray,
        landmark_covariance: np.ndarray,
        host: np.ndarray,
        view: np.ndarray,
    ) -> _Slopes:
        """Linearises the views of landmarks (M, 4) of keyframes `host` (M,) by the poses `view` (M,)."""
        count, size = len(poses), len(covariance)
        if not len(landmarks):  # the graph takes no empty batch
            square = np.zeros((0, 3, 3))
            return _Slopes(square[:, 0], np.zeros((0, 3, size)), np.zeros((0, 3, 4)), square, np.zeros(0, bool))
        pairs, pair = np.unique(host * count + view, return_inverse=True)
        hosts, sights = pairs // count, pairs % count
        relative = se3_inverse(poses[sights]) @ poses[hosts]
        adjoint = se3_adjoint(se3_inverse(poses[sights]))
        chain = np.zeros((len(pairs), 9, size))
        for k, (from_, to) in enumerate(zip(hosts, sights, strict=True)):
            chain[k, :6, pose_slice(from_)] = adjoint[k]
            chain[k, :6, pose_slice(to)] -= adjoint[k]
        chain[:, 6:, CALIBRATION] = np.eye(3)
        floor = np.diag(np.r_[np.full(3, self.depth), np.ones(6)] * _LEAST_SPREAD) ** 2
        known = chain @ covariance @ chain.transpose(0, 2, 1) if self._unscented else np.zeros((len(pairs), 9, 9))
        spread = np.linalg.cholesky(_limited(0.5 * (known + known.transpose(0, 2, 1)), self.depth) + floor)
        own = landmark_covariance if self._unscented else np.zeros_like(landmark_covariance)
        landmark_spread = np.linalg.cholesky(own + _LEAST_SPREAD**2 * np.eye(LANDMARK_SIZE))
        mean, odd, left, in_front = self._transfer(
            {
                "relative": relative,
                "spread": spread,
                "pair": pair,
                "calibration": calibration,
                "intrinsics": self._intrinsics,
                "landmarks": landmarks,
                "landmark_spread": landmark_spread,
            }
        )
        by_state = odd[:, :, :9] @ (np.linalg.inv(spread) @ chain)[pair]
        by_landmark = odd[:, :, 9:] @ np.linalg.inv(landmark_spread)
        return _Slopes(mean, by_state, by_landmark, left, in_front > 0.5)


@dataclass(frozen=True, slots=True)
class _Elimination:
    """Landmarks given the state: rows (K,), covariance (K, 4, 4), dependence (K, 4, n); step (K, 4) if it stays."""

    rows: np.ndarray
    covariance: np.ndarray
    dependence: np.ndarray
    step: np.ndarray


def _condition(factor: np.ndarray, information: np.ndarray, vector: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of N(0, factor factor^T) times exp(-x^T information x / 2 + vector^T x); factor (n, k)."""
    whole = np.eye(factor.shape[1]) + factor.T @ information @ factor
    lower = np.linalg.cholesky(0.5 * (whole + whole.T))
    reduced = np.linalg.solve(lower, factor.T)
    return reduced.T @ (reduced @ vector), reduced.T @ reduced


def _root(covariance: np.ndarray) -> np.ndarray:
    """A with A A^T = covariance, which may be singular."""
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def _factor_with_frame(factor: np.ndarray, step_covariance: np.ndarray, anchor: int) -> np.ndarray:
    """Factor of the state with the frame's pose, which is that of a keyframe moved by an independent step."""
    size, columns = factor.shape
    grown = np.zeros((size + 6, columns + 6))
    grown[:size, :columns] = factor
    grown[size:, :columns] = factor[pose_slice(anchor)]
    grown[size:, columns:] = _root(step_covariance)
    return grown


def _limited(covariance: np.ndarray, depth: float) -> np.ndarray:
    """Covariances (k, 9, 9) of relative poses and calibration, shrunk where sigma points would leave the scene."""
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    worst = np.maximum(variance[:, :3].max(axis=1) / depth**2, variance[:, 3:6].max(axis=1))
    return covariance * np.minimum(1.0, _MOST_SPREAD**2 / np.maximum(worst, 1e-300))[:, None, None]


def _certain_frame(prior: np.ndarray, frame: slice) -> np.ndarray:
    """The prior with the frame's pose as certain as the last keyframe's, to draw sigma points about a good start."""
    spread = prior.copy()
    last = slice(frame.start - 6, frame.start)
    spread[frame, :], spread[:, frame] = spread[last, :], spread[:, last]
    spread[frame, frame] = spread[last, last]
    return spread


def _student_weight(squared: np.ndarray, components: np.ndarray) -> np.ndarray:
    """Weights (M,) that make least squares the fit of a Student-t, from squared lengths of whitened residuals.

    The weighted information of such a fit is more than the estimate's precision, (nu + p + 2) / (nu + p) times as much
    where errors are Student-t: the weights are that much smaller, which hardly moves the estimate.
    """
    whole = _STUDENT_FREEDOM + components
    return whole**2 / ((whole + 2.0) * (_STUDENT_FREEDOM + squared))


def _masked(residual: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (M, 3) without the disparities that are not there, and covariances to match."""
    missing = ~np.isfinite(residual[:, 2])
    residual = np.where(np.isfinite(residual), residual, 0.0)
    noise = noise.copy()
    noise[missing, 2, :] = 0.0
    noise[missing, :, 2] = 0.0
    noise[missing, 2, 2] = _UNKNOWN
    return residual, noise


def _squared(residual: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(M,) squared Mahalanobis lengths of residuals (M, 3)."""
    return np.einsum("mi,mi->m", residual, np.linalg.solve(covariance, residual[..., None])[..., 0])


def _spread(slope: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Covariance that slopes (M, 3, n) make of a covariance."""
    return np.asarray(slope @ covariance @ slope.transpose(0, 2, 1))


def _whiten(stacked: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Rows (3 M, k) of stacked (M, 3, k) in units of the noise (M, 3, 3)."""
    return np.asarray(np.linalg.solve(np.linalg.cholesky(noise), stacked).reshape(-1, stacked.shape[2]))

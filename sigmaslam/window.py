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

from dataclasses import replace

import numpy as np

from sigmaslam.camera import RectifiedStereo
from sigmaslam.chi_square import CHI_SQUARE_999, CHI_SQUARE_9999_OF_6
from sigmaslam.elimination import Elimination, eliminate_landmarks
from sigmaslam.frame_fit import FrameFit
from sigmaslam.gaussian import append_moved, condition, matrix_root, project_covariance, replace_part, weighted_update
from sigmaslam.linearise import Slopes, ViewLineariser
from sigmaslam.past import PastPoses, point_lever
from sigmaslam.residuals import UNKNOWN_VARIANCE, common_scale, mask_missing, squared_lengths, student_weight, whiten
from sigmaslam.rotation import nearest_rigid, se3_exp, se3_inverse, se3_log
from sigmaslam.tables import (
    CALIBRATION,
    CALIBRATION_SIZE,
    LANDMARK_SIZE,
    MODELLED,
    Landmarks,
    Observations,
    Views,
    pose_slice,
)

# Of the robust loss by which a frame's pose is first found: its scales in standard deviations.
_ROBUST_SCALES = (6.0, 4.0, 3.0)


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
        self._lineariser = ViewLineariser(camera, backend, linearisation == "unscented")
        self._iterations = iterations
        self.poses = np.zeros((0, 4, 4))
        self.calibration = np.zeros(CALIBRATION_SIZE)
        self.covariance = np.diag(calibration_sigma.astype(float) ** 2)
        self.landmarks = Landmarks.empty(CALIBRATION_SIZE)
        self.depth = 1.0
        self._observations = Observations()
        self._prior_poses = self.poses
        self._prior_calibration = self.calibration
        self._prior = self.covariance
        self.past = self._prior_past = PastPoses.empty()
        self._next_serial = 0

    def __len__(self) -> int:
        return len(self.poses)

    def restart(self) -> None:
        """Forgets all poses, past ones as well, and landmarks; what is known of the calibration stays."""
        self.poses = self._prior_poses = np.zeros((0, 4, 4))
        self._prior = self.covariance = self.covariance[CALIBRATION, CALIBRATION]
        self._prior_calibration = self.calibration
        self.landmarks = Landmarks.empty(CALIBRATION_SIZE)
        self._observations = Observations()
        self.past = self._prior_past = PastPoses.empty()

    def load_past(self, past: PastPoses) -> None:
        """Remembers poses of another run, before there is a keyframe."""
        self.past = self._prior_past = past

    def forget_past(self, index: int) -> None:
        """Forgets a pose that left the window."""
        self.past, self._prior_past = self.past.drop(index), self._prior_past.drop(index)

    def add_keyframe(
        self,
        pose: np.ndarray,
        step: np.ndarray,
        step_covariance: np.ndarray,
        walk: np.ndarray,
        origin: int | None = None,
    ) -> None:
        """Adds a keyframe to the end of the window.

        Args:
            pose: (4, 4) estimate of T_world_camera.
            step: (4, 4) T_last_new as it was expected without its images; of the first one T_world_camera.
            step_covariance: (6, 6) of that, perturbed from the left in the world.
            walk: (3,) variances by which the calibration may have moved since the last keyframe.
            origin: of the first one, the past pose relative to which `step_covariance` is; the world by default.
        """
        count = len(self.poses)
        expected = self._prior_poses[-1] @ step if count else step
        self._prior, self._prior_past = self._prior_past.grow(self._prior, step_covariance, walk, origin)
        self.covariance, self.past = self.past.grow(self.covariance, step_covariance, walk, origin)
        self._prior_poses = np.concatenate([self._prior_poses, nearest_rigid(expected)[None]])
        self.poses = np.concatenate([self.poses, nearest_rigid(pose)[None]])
        self.landmarks.dependence = np.pad(self.landmarks.dependence, ((0, 0), (0, 0), (0, 6)))

    def add_views(self, views: Views) -> None:
        """Remembers what the last keyframe sees of landmarks of earlier ones."""
        self._observations = self._observations.append(len(self.poses) - 1, views)

    def add_landmarks(
        self, feature: np.ndarray, measured: np.ndarray, variance: np.ndarray, relief: np.ndarray | None = None
    ) -> None:
        """Adds landmarks that the last keyframe sees first.

        Args:
            feature: (K,) index among the keyframe's features.
            measured: (K, 3) (u, v, disparity).
            variance: (K, 4) of these, and of what the disparities are off by in all views alike.
            relief: (K,) of the surfaces around them, pixels; none by default.
        """
        count = len(feature)
        size = len(self.covariance)
        variance = np.pad(variance, ((0, 0), (0, LANDMARK_SIZE - MODELLED)), constant_values=1.0)
        new = Landmarks(
            np.full(count, len(self.poses) - 1),
            feature,
            np.pad(measured, ((0, 0), (0, LANDMARK_SIZE - 3))),
            variance,
            np.pad(measured, ((0, 0), (0, LANDMARK_SIZE - 3))),
            np.eye(LANDMARK_SIZE) * variance[:, None, :],
            np.zeros((count, LANDMARK_SIZE, size)),
            np.ones(count, np.int64),
            np.zeros(count, np.int64),
            self._next_serial + np.arange(count),
            np.zeros(count) if relief is None else relief,
        )
        self._next_serial += count
        self.landmarks = self.landmarks.append(new)

    def solve(self, iterations: int = 2) -> None:
        """Posterior of poses, calibration and landmarks from the prior and all views: Gauss-Newton, then a gate."""
        factor = matrix_root(self._prior)
        for _ in range(iterations):
            information, vector, elimination = self._eliminate(self._observations)
            offset = self._from_prior()
            vector = vector + information @ offset
            state, self.covariance = condition(factor, information, vector)
            self._move(state - offset, elimination)
        self.past = self._prior_past.given(self._prior, information, vector)
        self._drop_outliers()

    def tie(self, index: int, T_past_last: np.ndarray, match: np.ndarray) -> bool:
        """Ties the last keyframe to a past pose that sees the same: a loop is closed, and the past corrected with it.

        Args:
            index: of the past pose.
            T_past_last: (4, 4) the last keyframe's pose relative to that one.
            match: (6, 6) its covariance, perturbed from the left in the world.
        Returns:
            False, and nothing is changed, where it contradicts what is known, or says less than is known already.
        """
        known = self.past.relative_to(self.covariance, index)
        apart = se3_log(self.past.poses[index] @ T_past_last @ se3_inverse(self.poses[-1]))
        # What the old keyframe was measured with is the same in all its matches: they must not be counted without end.
        lever = point_lever(self.poses[-1:, :3, 3])[0]
        if np.trace(lever @ known @ lever.T) < np.trace(lever @ match @ lever.T):
            return False
        if apart @ np.linalg.lstsq(known + match, apart, rcond=1e-12)[0] > CHI_SQUARE_9999_OF_6:
            return False
        apart = se3_log(self._prior_past.poses[index] @ T_past_last @ se3_inverse(self._prior_poses[-1]))
        step, self._prior, self._prior_past = self._prior_past.tie(self._prior, index, apart, match)
        self._prior_poses = nearest_rigid(se3_exp(step[CALIBRATION_SIZE:].reshape(-1, 6)) @ self._prior_poses)
        self._prior_calibration = self._prior_calibration + step[CALIBRATION]
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
        covariance = append_moved(matrix_root(self.covariance), pose_slice(anchor % len(self.poses)), step_covariance)
        covariance = covariance @ covariance.T
        moved, common = np.zeros((len(rows), LANDMARK_SIZE)), np.zeros((len(rows), 3, 2))
        slopes = self._linearise_frame(rows, pose, np.zeros(len(covariance)), covariance, moved, common)
        noise, by_state = self._frame_noise(rows, slopes, np.zeros((len(rows), 3, 3)))
        return slopes.mean, noise + project_covariance(by_state, covariance), slopes.in_front

    def expected_views(self, views: Views, pose: np.ndarray, step_covariance: np.ndarray) -> np.ndarray:
        """(M,) bool: which views agree with a predicted pose (99.9 %), the arguments as of `fit_frame`."""
        predicted, S, in_front = self.predict(views.rows, pose, step_covariance)
        residual, covariance = mask_missing(views.measurement - predicted, S + views.covariance)
        return np.asarray(in_front & (squared_lengths(residual, covariance) <= CHI_SQUARE_999[views.components]))

    def fit_frame(
        self,
        views: Views,
        pose: np.ndarray,
        step_covariance: np.ndarray,
        least: int,
        start: np.ndarray | None = None,
        scale: float = 1.0,
    ) -> FrameFit | None:
        """Posterior of a frame's pose; nothing is remembered.

        Args:
            views: what it sees.
            pose, step_covariance: as of `predict`: the prior.
            least: fewer inliers are no pose.
            start: (4, 4) pose to linearise at first, close to the truth; then the innovations are not gated against
                the prior but only their rest after the update.
            scale: how much smaller than claimed the variances are by which views are told to agree.
        Returns:
            None where too few views agree.
        """
        last, frame = pose_slice(len(self.poses) - 1), pose_slice(len(self.poses))
        factor = append_moved(matrix_root(self.covariance), last, step_covariance)
        prior = factor @ factor.T
        components = views.components
        offset = np.zeros(len(prior))
        spread = prior
        if start is not None:
            offset[frame] = se3_log(start @ se3_inverse(pose))
            # As certain as the last keyframe, to draw sigma points about a good start.
            spread = replace_part(prior, frame, last)
        # Landmarks are estimated along with the pose: measured places and depths in the role of known ones would
        # draw the pose towards no motion.
        moved = np.zeros((len(views.rows), LANDMARK_SIZE))
        step, kept, noise_scale = 0, None, 1.0
        while True:
            slopes = self._linearise_frame(views.rows, pose, offset, spread, moved, views.common)
            noise, by_state = self._frame_noise(views.rows, slopes, views.noise)
            expected = slopes.mean - (slopes.by_landmark @ moved[..., None])[..., 0]
            residual, noise = mask_missing(views.measurement - expected, noise_scale * noise)
            precision = np.linalg.inv(noise)
            squared = np.einsum("mi,mij,mj->m", residual, precision, residual)
            usable = slopes.in_front & (squared < UNKNOWN_VARIANCE)
            if step == self._iterations and kept is None:
                # Before the gate, which would hide how far they scatter.
                noise_scale = common_scale(squared[usable], components[usable])
                squared, precision, noise = squared / noise_scale, precision / noise_scale, noise * noise_scale
            if step >= self._iterations:
                agree = usable & (squared <= scale * CHI_SQUARE_999[components])
                if step == self._iterations + 2 or (kept is not None and (agree == kept).all()):
                    break
                kept = agree
            if usable.sum() < least or (kept is not None and kept.sum() < least):
                return None
            whitened = whiten(np.concatenate([by_state, residual[..., None]], axis=2), noise)
            if kept is not None:
                weight = kept * student_weight(squared, components)
                solution, posterior = weighted_update(factor, whitened, offset, weight)
            else:
                # A loss that narrows, first about what the prior expects.
                if step == 0 and start is None:
                    squared = squared_lengths(residual, noise + project_covariance(by_state, prior))
                for limit in _ROBUST_SCALES:
                    weight = usable / (1.0 + squared / (scale * limit**2)) ** 2
                    solution, posterior = weighted_update(factor, whitened, offset, weight)
                    left = residual - by_state @ (solution - offset)
                    squared = np.einsum("mi,mij,mj->m", left, precision, left)
            left = residual - by_state @ (solution - offset)
            own = self.landmarks.covariance[views.rows] @ slopes.by_landmark.transpose(0, 2, 1)
            moved = (own @ (precision @ left[..., None]))[..., 0]
            offset, spread = solution, posterior
            step += 1
        kept &= agree
        if kept.sum() < least:
            return None
        moved_by = np.linalg.lstsq(factor, offset, rcond=1e-12)[0]
        paid = float(moved_by @ moved_by)
        cross = posterior[frame, last]
        return FrameFit(
            nearest_rigid(se3_exp(offset[frame]) @ pose),
            posterior[frame, frame] + posterior[last, last] - cross - cross.T,
            posterior[frame, frame],
            self.calibration + offset[CALIBRATION],
            posterior[CALIBRATION, CALIBRATION],
            kept,
            paid + float(squared[kept].sum()),
            int(components[kept].sum()),
            noise_scale,
            paid,
        )

    def retire_oldest(self) -> np.ndarray:
        """Drops the oldest keyframe to the past; its landmarks' views become part of the prior.

        Returns:
            (L,) new row of each landmark, -1 for those that are gone.
        """
        leaving = self.landmarks.host == 0
        information, vector, _ = self._eliminate(self._observations.select(leaving[self._observations.landmark]))
        offset = self._from_prior()
        vector = vector + information @ offset
        past = self._prior_past.given(self._prior, information, vector)
        moved, covariance = condition(matrix_root(self._prior), information, vector)
        count = len(self.poses)
        prior_poses = nearest_rigid(se3_exp(moved[CALIBRATION_SIZE:].reshape(count, 6)) @ self._prior_poses)
        self._prior_poses = prior_poses[1:]
        self._prior_calibration = self._prior_calibration + moved[CALIBRATION]
        oldest = pose_slice(0)
        rest = np.r_[0:CALIBRATION_SIZE, CALIBRATION_SIZE + 6 : len(covariance)]
        past = past.append(prior_poses[0], covariance, oldest)
        self._prior_past = replace(past, cross=past.cross[:, rest])
        past = self.past.append(self.poses[0], self.covariance, oldest)
        self.past = replace(past, cross=past.cross[:, rest])
        self._prior = covariance[np.ix_(rest, rest)]
        self.covariance = self.covariance[np.ix_(rest, rest)]
        self.poses = self.poses[1:]
        number = np.where(leaving, -1, np.cumsum(~leaving) - 1)
        self._observations = self._observations.renumber(number)
        self._observations.clone = self._observations.clone - 1
        self.landmarks = self.landmarks.select(~leaving)
        self.landmarks.host = self.landmarks.host - 1
        self.landmarks.dependence = self.landmarks.dependence[:, :, rest]
        return number

    def true_disparity(self, measured: np.ndarray) -> np.ndarray:
        """(u, v, disparity) (K, 3) without what the calibration adds, and of landmarks (K, 6) their own errors."""
        x = (measured[:, 0] - measured[:, 2] - self.camera.cx) / self.camera.fx
        y = (measured[:, 1] - self.camera.cy) / self.camera.fy
        constant, yaw, pitch = self.calibration
        bias = measured[:, 3:MODELLED].sum(axis=1) + constant + yaw * x * x + pitch * x * y
        return np.column_stack([measured[:, :2], measured[:, 2] - bias])

    # ---- the equations

    def _from_prior(self) -> np.ndarray:
        """The estimate minus the prior's mean, in the state's coordinates."""
        poses = se3_log(self.poses @ se3_inverse(self._prior_poses)).ravel()
        return np.r_[self.calibration - self._prior_calibration, poses]

    def _eliminate(self, observations: Observations) -> tuple[np.ndarray, np.ndarray, Elimination]:
        """Information matrix and vector of the state at the estimate, every landmark's own equations solved for it."""
        slopes, residual, noise, components = self._linearise_observations(observations)
        noise = np.where(slopes.in_front[:, None, None], noise, UNKNOWN_VARIANCE * np.eye(3))
        return eliminate_landmarks(self.landmarks, observations.landmark, slopes, residual, noise, components)

    def _move(self, step: np.ndarray, elimination: Elimination) -> None:
        self.calibration = self.calibration + step[CALIBRATION]
        self.poses = nearest_rigid(se3_exp(step[CALIBRATION_SIZE:].reshape(-1, 6)) @ self.poses)
        seen = elimination.rows
        self.landmarks.estimate[seen] += elimination.step + elimination.dependence @ step
        self.landmarks.covariance[seen] = elimination.covariance
        self.landmarks.dependence[seen] = elimination.dependence

    def _drop_outliers(self) -> None:
        """Views that do not fit the solution are forgotten."""
        slopes, residual, noise, components = self._linearise_observations(self._observations)
        agree = slopes.in_front & (squared_lengths(residual, noise) <= CHI_SQUARE_999[components])
        if not agree.all():
            self._observations = self._observations.select(agree)

    def _linearise_observations(self, observations: Observations) -> tuple[Slopes, np.ndarray, np.ndarray, np.ndarray]:
        """Views by keyframes at the estimate: slopes, residuals (O, 3), their noise (O, 3, 3), components (O,)."""
        landmarks = self.landmarks
        slopes = self._lineariser.linearise(
            self.poses,
            self.calibration,
            self.covariance,
            landmarks.estimate[observations.landmark],
            landmarks.covariance[observations.landmark],
            landmarks.host[observations.landmark],
            observations.clone,
            observations.common,
            self.depth,
        )
        residual, noise = mask_missing(observations.measurement - slopes.mean, observations.noise + slopes.left)
        return slopes, residual, noise, np.isfinite(observations.measurement).sum(axis=1)

    def _linearise_frame(
        self,
        rows: np.ndarray,
        pose: np.ndarray,
        offset: np.ndarray,
        covariance: np.ndarray,
        moved: np.ndarray,
        common: np.ndarray,
    ) -> Slopes:
        """Views of landmarks by the frame, with the state moved by `offset` from the window's estimate and `pose`.

        The landmarks follow the state, and lie `moved` (M, 6) from there.
        """
        size = len(self.covariance)
        poses = np.concatenate([self.poses, pose[None]])
        poses = se3_exp(offset[CALIBRATION_SIZE:].reshape(-1, 6)) @ poses
        landmarks = self.landmarks
        return self._lineariser.linearise(
            poses,
            self.calibration + offset[CALIBRATION],
            covariance,
            landmarks.estimate[rows] + landmarks.dependence[rows] @ offset[:size] + moved,
            landmarks.covariance[rows],
            landmarks.host[rows],
            np.full(len(rows), len(self.poses)),
            common,
            self.depth,
        )

    def _frame_noise(self, rows: np.ndarray, slopes: Slopes, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Noise with that of the landmarks, and derivatives by the state with those through the landmarks."""
        size = len(self.covariance)
        by_state = slopes.by_state.copy()
        by_state[:, :, :size] += slopes.by_landmark @ self.landmarks.dependence[rows]
        return noise + slopes.left + project_covariance(slopes.by_landmark, self.landmarks.covariance[rows]), by_state

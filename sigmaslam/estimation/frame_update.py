"""The update of one frame's pose against a window of keyframes.

A frame that is no keyframe is estimated from the window's posterior and its own views alone, and then forgotten but for
the velocity: nothing of it can be counted twice. The equations are `sigmaslam_models.estimator.frame_update`, which
runs as graphs; here is what decides.
"""

import numpy as np

from sigmaslam.estimation.clustered_errors import clustering
from sigmaslam.estimation.frame_fit import FrameFit, FramePosterior
from sigmaslam.estimation.gaussian import append_moved, matrix_root, replace_part
from sigmaslam.estimation.keyframe_window import KeyframeWindow
from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.estimation.state_layout import CALIBRATION, LANDMARK_SIZE, pose_slice
from sigmaslam.estimation.window_state import WindowState
from sigmaslam.geometry.se3 import nearest_rigid, se3_exp, se3_inverse, se3_log
from sigmaslam.table import distinct

# Linearisations with a gate, which must agree twice or give way to the last.
_GATED = 3

# Where views are linearised: (n,) and (n, n) of the state, and (M, 6) how landmarks moved.
_POINT = "offset", "spread", "moved"
_Feed = dict[str, np.ndarray]


class FrameUpdate:
    """Predicts what a frame sees of a window's landmarks, and estimates its pose; changes nothing.

    Args:
        window: whose posterior is the prior.
        iterations: linearisations with a robust loss.
        moves_last: a frame's step is from where its own views have the last keyframe. A sensor of motion is surer of
            the velocity than a keyframe is of its place, and would take that error for speed frame by frame. A velocity
            by images is not, and gains nothing (docs/notebook, motion).
    """

    def __init__(self, window: KeyframeWindow, iterations: int, moves_last: bool = False) -> None:
        self._window = window
        self._iterations, self._moves_last = iterations, moves_last
        self._rooted: tuple[WindowState, np.ndarray] | None = None
        self._padded: tuple[WindowState, np.ndarray, np.ndarray] | None = None

    def predict(
        self, rows: np.ndarray, pose: np.ndarray, step_covariance: np.ndarray, reference: int = -1
    ) -> tuple[np.ndarray, ...]:
        """Where a frame should see landmarks.

        Args:
            rows: (K,) of the landmark table.
            pose: (4, 4) expected T_world_camera.
            step_covariance: (6, 6) of it relative to a keyframe, perturbed from the left in the world.
            reference: that keyframe; the last one by default.
        Returns:
            (u, v, disparity) (K, 3), its covariance without the measurement's noise (K, 3, 3), in front (K,) bool.
        """
        if not len(rows):  # the graph takes no empty batch
            return np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, bool)
        factor = self._prior_factor(step_covariance, reference)
        return tuple(self._window.graphs.predict_views(self._views(rows, np.zeros((len(rows), 3, 2)), pose, factor)))

    def fit(
        self,
        views: LandmarkViews,
        pose: np.ndarray,
        step_covariance: np.ndarray,
        min_inliers: int,
        start: np.ndarray | None = None,
        scale: float = 1.0,
    ) -> FrameFit | None:
        """Posterior of a frame's pose.

        Args:
            pose, step_covariance: as of `predict`: the prior.
            min_inliers: fewer are no pose.
            start: (4, 4) pose to linearise at first, close to the truth; then the innovations are not gated against
                the prior, but only the residuals after the update.
            scale: how much smaller than claimed the variances are by which views are told to agree.
        Returns:
            None where too few views agree.
        """
        if len(views) < min_inliers:
            return None
        posterior = self._window.posterior
        last, frame = pose_slice(len(posterior) - 1), pose_slice(len(posterior))
        factor = self._prior_factor(step_covariance, -1)
        spread = factor @ factor.T
        offset = np.zeros(len(spread))
        if start is not None:
            offset[frame] = se3_log(start @ se3_inverse(pose))
            # As certain as the last keyframe, to draw sigma points about a good start.
            spread = replace_part(spread, frame, last)
        # Landmarks are estimated along with the pose: measured places and depths in the role of true ones would
        # draw the pose towards no motion.
        at = {"offset": offset, "spread": spread, "moved": np.zeros((len(views), LANDMARK_SIZE))}
        known = {"measurement": views.measurement, "noise": views.noise, "scale": np.array(scale)}
        known |= self._views(views.landmark, views.common, pose, factor)
        robust = self._step_robustly(known, at, start is None, min_inliers)
        found = None if robust is None else self._step_gated(known, robust, min_inliers)
        if found is None:
            return None
        inliers, squared, noise_scale, (offset, spread, _, common, information, scores, score, prior_cost) = found
        size = self._window.camera.width, self._window.camera.height
        joint = FramePosterior(offset, spread, common, information, score)
        return FrameFit(
            nearest_rigid(se3_exp(offset[frame]) @ pose),
            se3_exp(self._moves_last * offset[last]) @ posterior.poses[-1],
            joint.relative,
            spread[frame, frame],
            posterior.calibration + offset[CALIBRATION],
            joint,
            inliers,
            float(prior_cost + squared[inliers].sum()),
            int(views.components[inliers].sum()),
            float(noise_scale),
            clustering(views.measurement[:, :2], size, scores, information[frame, frame]),
            scores,
        )

    def _step_robustly(self, known: _Feed, at: _Feed, gates_prior: bool, min_inliers: int) -> _Feed | None:
        """Where linearisations with a robust loss lead, the first one gated against the prior if told so."""
        for iteration in range(self._iterations):
            gated = np.array(float(iteration == 0 and gates_prior))
            *point, usable = self._window.graphs.robust_step({**known, **at, "gated": gated})
            if usable < min_inliers:
                return None
            at = dict(zip(_POINT, point, strict=True))
        return at

    def _step_gated(
        self, known: _Feed, at: _Feed, min_inliers: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]] | None:
        """The same with a gate: inliers (M,), squared residuals (M,), the scale of the noise, and the last solution."""
        common = self._window.posterior.common
        own = {"freedom": np.array(self._window.student_freedom), "prior": np.concatenate([common, common[-6:]])}
        inliers: np.ndarray | None = None
        noise_scale = np.array(0.0)  # the first step finds it: before the gate, which would hide how far they scatter
        for iteration in range(_GATED):
            feed = {**known, **own, **at, "noise_scale": noise_scale}
            if inliers is not None and self._window.graphs.is_compiled:
                feed["inliers"] = inliers
            agree, count, usable, squared, noise_scale, *step = self._window.graphs.gated_step(feed)
            if iteration == _GATED - 1 or (inliers is not None and (agree == inliers).all()):
                break
            inliers, solution = agree, step
            if usable < min_inliers or count < min_inliers:
                return None
            at = dict(zip(_POINT, solution, strict=False))
        assert inliers is not None
        inliers = inliers & agree
        return None if inliers.sum() < min_inliers else (inliers, squared, noise_scale, solution)

    def _prior_factor(self, step_covariance: np.ndarray, reference: int) -> np.ndarray:
        """Factor (n, k) of the covariance of window and frame, which moves on from a keyframe."""
        state = self._window.posterior
        if self._rooted is None or self._rooted[0] is not state:
            part = np.flatnonzero(np.r_[self._window.calibration.estimated, np.ones(6 * len(state), bool)])
            # Nothing but the part is not zero.
            root = np.zeros((len(state.covariance), len(part)))
            root[part] = matrix_root(state.covariance[np.ix_(part, part)])
            self._rooted = state, root
        return append_moved(self._rooted[1], pose_slice(reference % len(state)), step_covariance)

    def _views(
        self, rows: np.ndarray, common: np.ndarray, pose: np.ndarray, factor: np.ndarray
    ) -> dict[str, np.ndarray]:
        """The fields of `sigmaslam_models.estimator.frame_update.FrameViews` for landmarks (M,) by row."""
        window, state, landmarks = self._window, self._window.posterior, self._window.landmarks
        if self._padded is None or self._padded[0] is not state or self._padded[1] is not landmarks.dependence:
            # The frame's pose moves no landmark; a solution ends with another state.
            padded = np.pad(landmarks.dependence, ((0, 0), (0, 0), (0, 6)))
            self._padded = state, landmarks.dependence, padded
        anchors, pair = distinct(landmarks.anchor[rows])
        is_compiled, dependence = window.graphs.is_compiled, self._padded[2]
        return {
            **window.graphs.constants(window.depth),
            "anchors": anchors,
            "views": np.full(len(anchors), len(state)),
            "pair": pair,
            "common": common,
            "covariance": landmarks.covariance[rows],
            "estimate": landmarks.estimate[rows],
            "dependence": dependence if is_compiled else dependence[rows],
            "poses": np.concatenate([state.poses, pose[None]]),
            "calibration": state.calibration,
            "factor": factor,
            **({"rows": rows} if is_compiled else {}),
        }

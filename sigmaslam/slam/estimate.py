"""What the tracker says about one stereo pair."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sigmaslam.estimation.state_layout import CALIBRATION_SIZE
from sigmaslam.slam.doubt import Doubt
from sigmaslam.slam.inertial_estimate import InertialEstimate
from sigmaslam.slam.mapping import KeyframeTracks
from sigmaslam.slam.relative_poses import RelativePoses


@dataclass(frozen=True, slots=True)
class CalibrationEstimate:
    """What the images say about the stereo calibration.

    Attributes:
        disparity_offset: measured minus true disparity, pixels.
        disparity_offset_sigma: its standard deviation, pixels.
        errors: other errors that are estimated, and a baseline that made up for a large offset, by their
            names: value and standard deviation, in the units of `sigmaslam.estimation.calibration_errors.ERRORS`.
        causes: what is wrong by the evidence, by the names of `sigmaslam.estimation.calibration_evidence.HYPOTHESES`:
            its probability, above a half; its error and standard deviation, as shares of the focal length.
        worse: factor by which other errors but the scale's are larger than the calibration's sigmas say, as images
            show; covariances hold it. 1 where the sigmas suffice.
        raised: rows by which right images are raised since the rig was bumped.
    """

    disparity_offset: float
    disparity_offset_sigma: float
    errors: dict[str, tuple[float, float]] = field(default_factory=dict)
    causes: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    worse: float = 1.0
    raised: float = 0.0


@dataclass(frozen=True, slots=True)
class Estimate:
    """Result for one stereo pair.

    Attributes:
        timestamp: seconds.
        T_world_camera: (4, 4) pose of the left camera; the world is the left camera of the first frame with a pose, or
            the map's. NaN before that frame.
        covariance: (6, 6) of that pose in the camera's own frame, translation (metres) before rotation (radians). Zero
            in the frame that defines the world, infinite variances before it.
        matching_covariance: (6, 6) the part of the covariance that comes from matches and motion; the rest comes from
            errors of the calibration.
        by_calibration: (6, 15) how constant errors of the calibration, of variance one, enter the pose's error in the
            camera's own frame: what `covariance` has beyond `matching_covariance`.
        status: "starting"; "tracking"; "doubtful": tracked, but `doubts` speak against the pose, and the covariance
            holds what they may make of it; "ambiguous": likewise, and another pose explains the image about as well;
            "lost"; "inertial" or "odometry": lost by images, and predicted by that sensor; "skipped": one of the images
            has been delivered before, or is shifted, the pose is predicted; or "relocalised": found again among
            keyframes that had left the window, or in the map.
        belief: 1 - sqrt of the largest eigenvalue of the covariance of the pose relative to the keyframe (metres and
            radians together), clipped to [0, 1] (Tables 9.1, 9.2); 0 without a pose.
        matches, inliers: points matched to the keyframe, and those that passed the gate.
        nis, dof: normalised innovation squared and its degrees of freedom; 0 without an update.
        calibration: of the stereo pair.
        milliseconds: wall time by stage.
        frame_covariance: (6, 6) the part of the covariance that the frame's matches add to that of its keyframe; zero
            without them.
        tracks: what the frame saw, where it became a keyframe.
        relative_poses: relative to keyframes some way and some time back.
        doubts: what speaks against the pose.
        loop: time stamp of the keyframe of long ago that the frame, a keyframe, closes a loop with, seconds.
        inertial: which way is up, and the biases, where an inertial sensor says so.
    """

    timestamp: float
    T_world_camera: np.ndarray
    covariance: np.ndarray
    matching_covariance: np.ndarray
    status: str
    calibration: CalibrationEstimate
    belief: float = 0.0
    matches: int = 0
    inliers: int = 0
    nis: float = 0.0
    dof: int = 0
    milliseconds: dict[str, float] = field(default_factory=dict)
    frame_covariance: np.ndarray = field(default_factory=lambda: np.zeros((6, 6)))
    by_calibration: np.ndarray = field(default_factory=lambda: np.zeros((6, CALIBRATION_SIZE)))
    tracks: KeyframeTracks | None = None
    relative_poses: RelativePoses = field(default_factory=RelativePoses.empty)
    doubts: tuple[Doubt, ...] = ()
    loop: float | None = None
    inertial: InertialEstimate | None = None

    @property
    def has_pose(self) -> bool:
        """Whether the frame has a pose: tracking has started, in this frame or before it."""
        return bool(np.isfinite(self.T_world_camera).all())

    @property
    def camera(self) -> "Estimate":
        """The camera's estimate in its world: this one."""
        return self

    @property
    def pose(self) -> np.ndarray:
        """(4, 4) what is tracked: `T_world_camera`."""
        return self.T_world_camera

    @property
    def pose_covariance(self) -> np.ndarray:
        """(6, 6) of `pose` in its own frame."""
        return self.covariance

    @property
    def pose_matching_covariance(self) -> np.ndarray:
        """(6, 6) the part of `pose_covariance` that comes from matches and motion."""
        return self.matching_covariance

    def map_camera(self, change: "Callable[[Estimate], Estimate]") -> "Estimate":
        """The result with another camera estimate."""
        return change(self)

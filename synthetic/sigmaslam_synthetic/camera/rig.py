"""The stereo camera as it is and as its calibration says: the two differ by what real calibrations get wrong."""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.camera import CameraModel, StereoCamera
from sigmaslam.geometry.se3 import rigid_motion

# Standard deviations of a loose pair: of the angles between its axes, and of the relative differences in focal length,
# centre and distortion.
_LOOSE_DEGREES, _LOOSE_SHARE = 0.8, 0.01


@dataclass(frozen=True, slots=True)
class Miscalibration:
    """By how much the right camera differs from what the written calibration says.

    Attributes:
        disparity_offset: pixels by which disparities u_left - u_right exceed what the calibration says.
        row_offset: pixels by which points lie lower in the right image.
        rotation: rotation vector that turns the right camera away from its calibrated orientation, radians.
        focal: relative error of the right camera's focal length.
    """

    disparity_offset: float = 0.0
    row_offset: float = 0.0
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    focal: float = 0.0


@dataclass(frozen=True, slots=True)
class Rig:
    """A stereo camera.

    Attributes:
        left, right: the calibration as written.
        T_left_right: (4, 4) as nested rows, takes right camera points to the left camera, as written.
        errors: what makes the true right camera.
    """

    left: CameraModel
    right: CameraModel
    T_left_right: tuple[tuple[float, ...], ...]
    errors: Miscalibration = Miscalibration()

    @property
    def calibrated(self) -> StereoCamera:
        """What the written calibration says."""
        return StereoCamera(self.left, self.right, np.array(self.T_left_right))

    @property
    def true_right(self) -> CameraModel:
        """The right camera that takes the images."""
        scale = 1.0 + self.errors.focal
        return replace(
            self.right,
            fx=self.right.fx * scale,
            fy=self.right.fy * scale,
            cx=self.right.cx - self.errors.disparity_offset,
            cy=self.right.cy + self.errors.row_offset,
        )

    @property
    def true_right_pose(self) -> np.ndarray:
        """Where it stands, (4, 4)."""
        T = np.array(self.T_left_right)
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(self.errors.rotation).as_matrix()
        return T

    def to_json(self) -> dict[str, Any]:
        """The rig as JSON can hold it."""
        return asdict(self)

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> "Rig":
        """The rig that `to_json` wrote."""
        errors = {**content["errors"], "rotation": tuple(content["errors"]["rotation"])}
        return cls(
            CameraModel(**content["left"]),
            CameraModel(**content["right"]),
            tuple(tuple(row) for row in content["T_left_right"]),
            Miscalibration(**errors),
        )


def parallel_rig(camera: CameraModel, baseline: float, errors: Miscalibration = Miscalibration()) -> Rig:
    """Two equal cameras with parallel axes, the right one `baseline` metres along x of the left one."""
    return Rig(camera, camera, _rows(rigid_motion(np.eye(3), [baseline, 0.0, 0.0])), errors)


def loose_rig(
    camera: CameraModel, baseline: float, rng: np.random.Generator, errors: Miscalibration = Miscalibration()
) -> Rig:
    """A pair as it comes from the bench, to be rectified: axes, focal lengths and distortions differ a little.

    Args:
        camera: the left camera.
        baseline: metres.
        rng: source of the differences.
    """
    R = Rotation.from_rotvec(np.deg2rad(_LOOSE_DEGREES) * rng.standard_normal(3)).as_matrix()
    T = rigid_motion(R, baseline * np.array([1.0, *(_LOOSE_SHARE * rng.standard_normal(2))]))
    # Python's own numbers: they go to JSON and YAML.
    focal, *distortion = (1.0 + _LOOSE_SHARE * rng.standard_normal(1 + len(camera.distortion))).tolist()
    aside, down = (_LOOSE_SHARE * camera.width * rng.standard_normal(2)).tolist()
    right = replace(
        camera,
        fx=camera.fx * focal,
        fy=camera.fy * focal,
        cx=camera.cx + aside,
        cy=camera.cy + down,
        distortion=tuple(k * f for k, f in zip(camera.distortion, distortion, strict=True)),
    )
    return Rig(camera, right, _rows(T), errors)


def _rows(T: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(float(value) for value in row) for row in T)

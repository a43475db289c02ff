"""What errors of a stereo calibration do to the measurements of a rectified pair.

The disparity offset is estimated. The others are consider parameters (Schmidt 1966; Tapley, Schutz and Born 2004,
chapter 6): images hardly tell them from motion, so they are not moved, and poses are estimated as if they were zero;
but what they do to every pose and map point is carried along, and is part of their covariance. With the gains of
Schmidt's filter, which trusts views less for them, every window makes up a calibration of its own.
"""

from dataclasses import asdict, dataclass, replace
from typing import Self

import numpy as np

from sigmaslam.estimation.state_layout import VIEW_TURNS
from sigmaslam.geometry.calibration_covariance import CalibrationCovariance
from sigmaslam.geometry.calibration_sigmas import CalibrationSigmas
from sigmaslam.geometry.camera import RectifiedStereo

ERRORS = (
    "offset",  # disparity, everywhere
    "yaw",  # of the right camera: disparity, with x^2
    "pitch",  # of the right camera: disparity, with x y
    "roll",  # of the right camera: disparity, with y
    "zoom",  # of the right camera against the left one: disparity, with x
    "bend",  # of the right lens, which sits aside: disparity, with y^2
    "lenses",  # of the right lens against the left one: disparity, with x r^2
    "focal",  # of both: places along their rays, and disparity, relative
    "centre_u",  # principal point of both: places
    "centre_v",
    "lens",  # of both: places, with r^3 along their rays, and disparity
    "baseline",  # disparity, relative
    "view_pitch",  # all images turned against those where their landmarks were seen first
    "view_yaw",
    "view_roll",
)
"""In the order of the state. `focal` and `baseline` are relative, the others pixels at unit normalised coordinates.

What is the right camera's alone depends on the place in the right image.
"""
OF_PAIR = ERRORS[:-VIEW_TURNS]
"""What is wrong with the pair; the others are of views."""
SHOWN = tuple(name for name in OF_PAIR if name not in ("offset", "focal", "baseline"))
"""What images show of a pair, beside the offset, which is estimated; hardly anything of its scale."""
TURNS = ("yaw", "pitch", "roll")
"""Of the right camera."""

# Errors of following are alike all over an image, a little, and keep their sign from keyframe to keyframe. Pixels: of
# rendered streets, whose turns they add up to.
_VIEW_TURN = 0.01
# Others look like those of a pair, however well it is calibrated: this share of usual ones (streets and rooms, too).
_LEAST_SHARE = 0.07


@dataclass(frozen=True, slots=True)
class CalibrationPrior:
    """What is known of the errors of a calibration before any image; their mean is zero.

    Attributes:
        covariance: (15, 15), in the units and order of `ERRORS`; zero between errors that are estimated and others.
        estimated: (15,) bool, those that images may move; the others are considered.
    """

    covariance: np.ndarray
    estimated: np.ndarray

    def __post_init__(self) -> None:
        same = self.estimated[:, None] == self.estimated
        object.__setattr__(self, "covariance", np.where(same, self.covariance, 0.0))

    @property
    def sigma(self) -> np.ndarray:
        """(15,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    def widened(self, sigma: np.ndarray) -> Self:
        """The same with independent errors more, of standard deviations (15,)."""
        return replace(self, covariance=self.covariance + np.diag(sigma**2))

    @property
    def estimated_covariance(self) -> np.ndarray:
        """(15, 15) of those that are estimated, zero for the others."""
        return np.where(np.outer(self.estimated, self.estimated), self.covariance, 0.0)

    @property
    def considered_factor(self) -> np.ndarray:
        """(15, 15) factor of the covariance of those that are considered, zero for the others."""
        sigma = self.sigma
        scale = np.where(sigma > 0.0, sigma, 1.0)
        considered = np.where(np.outer(self.estimated, self.estimated), 0.0, self.covariance)
        values, vectors = np.linalg.eigh(considered / np.outer(scale, scale))
        # The symmetric root has a column of its own for each error, zero for those that are estimated.
        return np.asarray(scale[:, None] * (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T)

    @classmethod
    def of(
        cls,
        camera: RectifiedStereo,
        sigmas: CalibrationSigmas,
        offset_sigma: float,
        estimate: tuple[str, ...] = (),
        covariance: CalibrationCovariance | None = None,
    ) -> Self:
        """Of a rectified pair.

        Args:
            sigmas: of its calibration; none counts as smaller than a share of the usual one, 0.07.
            offset_sigma: of the disparity offset, which is estimated, pixels.
            estimate: names of other errors to estimate.
            covariance: of the calibration, in place of `sigmas` for what it names.
        """
        usual = asdict(CalibrationSigmas())
        sigmas = CalibrationSigmas(**{k: max(v, _LEAST_SHARE * usual[k]) for k, v in asdict(sigmas).items()})
        turn, lens = camera.fx * sigmas.rotation, camera.fx * sigmas.distortion
        centre = camera.fx * sigmas.principal_point
        in_disparity = (offset_sigma, turn, turn, turn, lens, lens, lens)
        in_places = (sigmas.focal, centre, centre, lens)
        sigma = np.array([*in_disparity, *in_places, sigmas.baseline, *[_VIEW_TURN] * VIEW_TURNS])
        prior = cls.independent(sigma, "offset", *estimate)
        if covariance is None:
            return prior
        rows = [ERRORS.index(name) for name in covariance.names]
        units = np.array([1.0 if name in ("focal", "baseline") else camera.fx for name in covariance.names])
        joint = prior.covariance.copy()
        joint[np.ix_(rows, rows)] = covariance.matrix * np.outer(units, units)
        return cls(joint, prior.estimated)

    @classmethod
    def independent(cls, sigma: np.ndarray, *estimated: str) -> Self:
        """Independent errors with standard deviations of the first of `ERRORS`, in which `estimated` are names."""
        return cls(np.diag(np.pad(np.square(sigma), (0, len(ERRORS) - len(sigma)))), np.isin(ERRORS, estimated))


def measured_errors(camera: RectifiedStereo, uvd: np.ndarray) -> np.ndarray:
    """(M, 3, 15) by how much each error, of size one, changes (u, v, disparity) (M, 3), to first order."""
    u, v, disparity = uvd.T
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    x_right = x - disparity / camera.fx
    squared, squared_right = x * x + y * y, x_right * x_right + y * y
    errors = np.zeros((len(uvd), 3, len(ERRORS)))
    in_disparity = (np.ones_like(x), x_right * x_right, x_right * y, y, x_right, y * y, x_right * squared_right)
    errors[:, 2, : len(in_disparity)] = np.stack(in_disparity, axis=1)
    errors[:, 0, 7], errors[:, 1, 7], errors[:, 2, 7] = camera.fx * x, camera.fy * y, disparity
    errors[:, 0, 8] = errors[:, 1, 9] = 1.0
    errors[:, 0, 10], errors[:, 1, 10] = x * squared, camera.fy / camera.fx * y * squared
    errors[:, 2, 10] = x * squared - x_right * squared_right
    errors[:, 2, 11] = disparity
    return errors

"""The covariance of the errors of a stereo calibration, where a calibration has measured it."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from sigmaslam.errors import CalibrationError
from sigmaslam.geometry.checked_yaml import CalibrationYaml

ERROR_NAMES = ("yaw", "pitch", "roll", "zoom", "bend", "lenses", "focal", "centre_u", "centre_v", "lens", "baseline")
"""Errors of a calibration that a board measures: those of `sigmaslam track --estimate`."""
_KNOWN = ("offset", *ERROR_NAMES)

# Eigenvalues may be so much below zero, relative to the largest correlation, as files have few digits.
_ROUNDING = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationCovariance:
    """What is wrong with a calibration, jointly; what it does not name is as `CalibrationSigmas` say.

    Attributes:
        names: (n,) of `ERROR_NAMES`, and `offset` of disparities, which `track --save-calibration` learns.
        matrix: (n, n) float64, read-only. `focal` and `baseline` are shares of them, all others shares of the focal
            length of the rectified pair, at unit normalised coordinates.

    Raises:
        CalibrationError: a name is unknown or there twice, or the matrix is no covariance.
    """

    names: tuple[str, ...]
    matrix: np.ndarray

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, np.float64)
        unknown = [name for name in self.names if name not in _KNOWN]
        if unknown:
            raise CalibrationError(f"covariance names {', '.join(unknown)}; known are {', '.join(_KNOWN)}")
        if len(set(self.names)) < len(self.names):
            raise CalibrationError(f"covariance names an error twice: {', '.join(self.names)}")
        if matrix.shape != (len(self.names), len(self.names)):
            raise CalibrationError(
                f"covariance has {len(self.names)} names and a matrix of {'x'.join(map(str, matrix.shape))}"
            )
        variances = np.diag(matrix)
        sigmas = np.sqrt(np.where(variances > 0.0, variances, 1.0))
        correlations = matrix / np.outer(sigmas, sigmas)
        if not np.all(np.isfinite(matrix)) or np.abs(correlations - correlations.T).max(initial=0.0) > _ROUNDING:
            raise CalibrationError("the matrix of covariance is not symmetric and finite: write it again")
        if np.any(variances < 0.0) or np.linalg.eigvalsh(correlations).min(initial=0.0) < -_ROUNDING:
            raise CalibrationError("the matrix of covariance has a negative eigenvalue: write it with more digits")
        matrix = 0.5 * (matrix + matrix.T)
        matrix.setflags(write=False)
        object.__setattr__(self, "matrix", matrix)

    @classmethod
    def from_yaml(cls, content: CalibrationYaml) -> Self | None:
        """What `covariance` of a calibration file says: `names` and `matrix`; None where it has no such key.

        Raises:
            CalibrationError: a key is missing or wrong.
        """
        if "covariance" not in content.entries:
            return None
        section = content.section("covariance")
        section.reject_unknown(("names", "matrix"))
        names = section.entries.get("names")
        if not isinstance(names, list):
            raise section.error(f"names must be a list of {', '.join(_KNOWN)}, got {names}")
        matrix = section.numbers("matrix", (None, None))
        try:
            return cls(tuple(map(str, names)), matrix)
        except CalibrationError as error:
            raise content.error(str(error)) from None

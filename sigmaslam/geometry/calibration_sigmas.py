"""How well a stereo calibration is known."""

from dataclasses import asdict, dataclass, fields
from typing import Self

from sigmaslam.geometry.checked_yaml import CalibrationYaml


@dataclass(frozen=True, slots=True)
class CalibrationSigmas:
    """Standard deviations of what is wrong with a calibration; relative, or angles in radians.

    The defaults are what calibrations of one rig differ by: KITTI's five days by 0.3 % in focal length and 0.2 px (0.3
    mrad) in rows; its lengths are 0.5 to 1 % off (Cvisic et al. 2021): a baseline is as uncertain as a focal length.

    Attributes:
        focal: focal length of both cameras, as a share of it.
        principal_point: of both cameras, as a share of the focal length.
        baseline: as a share of it.
        rotation: of the right camera about each axis, radians.
        distortion: what the lens models leave at 45 degrees from the optical axis, in both eyes alike and between
            them, as a share of the focal length.
    """

    focal: float = 0.003
    principal_point: float = 0.002
    baseline: float = 0.003
    rotation: float = 0.0003
    distortion: float = 0.0005

    @classmethod
    def none(cls) -> Self:
        """Of a calibration without errors."""
        return cls(**dict.fromkeys((field.name for field in fields(cls)), 0.0))

    @classmethod
    def from_yaml(cls, content: CalibrationYaml) -> Self:
        """What `sigmas` of a calibration file says: `0`, or a mapping; what it does not name is as by default.

        Raises:
            CalibrationError: a name is unknown, or a value is no number of zero or more.
        """
        if "sigmas" not in content.entries:
            return cls()
        if not isinstance(content.entries["sigmas"], dict):
            value = content.number("sigmas")
            if value != 0.0:
                raise content.error(
                    f"sigmas is {value:g}: give 0, or a mapping such as {{focal: 0.003, baseline: 0.003}}"
                )
            return cls.none()
        section, default = content.section("sigmas"), asdict(cls())
        section.reject_unknown(tuple(default))
        values = {name: section.number(name, value) for name, value in default.items()}
        for name, value in values.items():
            if value < 0.0:
                raise section.error(f"{name} is {value:g}: a standard deviation is zero or more")
        return cls(**values)

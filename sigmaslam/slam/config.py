"""Settings of the tracker."""

from dataclasses import Field, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from sigmaslam.bounded_files import CALIBRATION_BYTES, read_text, shorten
from sigmaslam.errors import InputError
from sigmaslam.estimation.calibration_errors import OF_PAIR
from sigmaslam.geometry.restricted_yaml import parse_yaml

LINEARISATIONS = ("unscented", "extended")
# More is a slip of the keyboard: it takes memory or time without end, or the filter's numbers overflow.
_MOST = {
    "max_keypoints": 100_000,
    "iterations": 100,
    "window": 100,
    "max_points": 1_000_000_000,
    "max_keyframes": 10_000,
    "min_inliers": 100_000,
    "keyframe_ratio": 1.0,
    # Nothing would be a view's own.
    "shared_disparity": 0.99,
    "shared_place": 0.99,
}
# Of all others, in their units.
_MOST_ELSE = 1_000_000
# Not zero: the filter divides by it.
_POSITIVE = ("keyframe_sigma",)


@dataclass(frozen=True, slots=True)
class TrackerConfig:
    """Settings; the defaults serve driving, indoor flight and endoscopy alike, because lengths scale with scene depth.

    Attributes:
        max_keypoints: per image.
        constant_sigma: standard deviations of every matched place per axis and of every disparity, pixels, in place of
            the matches' own; for comparison.
        keyframe_sigma: of a keypoint of the keyframe itself, pixels. The current place is measured relative to its
            patch: it stands for what lenses move one place by and not the other.
        acceleration: square root of the power spectral density of the linear acceleration, in median scene depths
            per s^1.5.
        angular_acceleration: the same for rotation, rad / s^1.5.
        start_speed: prior standard deviation of the velocity, median scene depths per second.
        start_turn: of the angular velocity, rad/s.
        offset_sigma: prior of the disparity offset, pixels.
        offset_walk: its random walk, pixels per root second.
        estimate: errors of the calibration that images may move beside the disparity offset, names of
            `sigmaslam.estimation.calibration_errors.ERRORS`. The others are only considered.
        linearisation: "unscented" or "extended".
        iterations: linearisations in a frame's update.
        window: keyframes that are estimated jointly.
        spacing: landmarks are at least so far apart in images of 640 x 480 pixels and larger ones, pixels; in smaller
            ones less, down to two thirds. What lies closer has the same errors (patches overlap).
        shared_disparity: share of the variance of a landmark's disparities that is the same in all views.
        shared_place: share of the variance of its places, relative to the keyframe's, that is the same in all views.
        max_points: of the map; when there are twice as many, the least confirmed half goes.
        max_keyframes: keyframes that are kept to find the way back to; poses of sixty are corrected by loops, the
            others move with these.
        max_misses: after so many frames in a row in which it was not found a landmark is no longer looked for.
        min_inliers: fewer is no pose; without a prediction and a fair share of the matches, fewer than three times as
            many.
        keyframe_ratio: a new keyframe is taken when the inliers fall below this share of the landmarks in the last one.
        search_limit: with a predicted place less certain than this (pixels, one sigma) the search is not guided.
        lost_seconds: after this long without a pose, tracking starts anew from the current view.
    Raises:
        InputError: a value is of the wrong kind, no finite number, or out of range; names the setting.
    """

    max_keypoints: int = 1500
    constant_sigma: tuple[float, float] | None = None
    keyframe_sigma: float = 0.17
    acceleration: float = 0.1
    angular_acceleration: float = 0.5
    start_speed: float = 1.0
    start_turn: float = 1.0
    offset_sigma: float = 0.5
    offset_walk: float = 0.02
    estimate: tuple[str, ...] = ()
    linearisation: str = "unscented"
    iterations: int = 2
    window: int = 6
    spacing: float = 12.0
    shared_disparity: float = 0.8
    shared_place: float = 0.6
    max_points: int = 100_000
    max_keyframes: int = 2400
    max_misses: int = 3
    min_inliers: int = 15
    keyframe_ratio: float = 0.75
    search_limit: float = 40.0
    lost_seconds: float = 0.5

    def __post_init__(self) -> None:
        for each in fields(self):
            value = getattr(self, each.name)
            if value is not each.default:
                object.__setattr__(self, each.name, _checked("TrackerConfig", each, value))

    def densities(self, depth: float) -> np.ndarray:
        """(2,) power spectral densities of accelerations in a scene of that depth (metres): m^2/s^3 and rad^2/s^3."""
        return np.array([(self.acceleration * depth) ** 2, self.angular_acceleration**2])

    def initial_twist_sigma(self, depth: float) -> np.ndarray:
        """(6,) standard deviations of a velocity that nothing is known of, m/s and rad/s."""
        return np.repeat([self.start_speed * depth, self.start_turn], 3)


def read_config(path: Path, base: TrackerConfig | None = None) -> TrackerConfig:
    """Settings of a YAML file, `name: value` line by line; those that it does not name stay as in `base`.

    Raises:
        InputError: the file cannot be read, names no setting, or gives a value of the wrong kind.
    """
    base = base or TrackerConfig()
    entries = parse_yaml(read_text(path, CALIBRATION_BYTES, "the settings"), path)
    if not isinstance(entries, dict):
        raise InputError(f"{path}: expected lines like `keyframe_ratio: 0.75`, found {type(entries).__name__}")
    known = {each.name: each for each in fields(base)}
    for name, value in entries.items():
        if name not in known:
            raise InputError(f"{path}: there is no setting '{shorten(name)}': choose among {', '.join(known)}")
        entries[name] = _checked(str(path), known[name], value)
    return replace(base, **entries)


def check_estimated(place: str, names: list[str]) -> tuple[str, ...]:
    """Names of errors of the calibration that are to be estimated.

    Raises:
        InputError: there is no such error; the message begins with `place`.
    """
    for name in names:
        if not isinstance(name, str) or name not in OF_PAIR:
            raise InputError(
                f"{place}: a calibration has no error {shorten(repr(name))}: choose among {', '.join(OF_PAIR)}"
            )
    return tuple(names)


def _checked(source: str, setting: Field[Any], value: Any) -> Any:
    """The value of a setting in the kind of its default; numbers of NumPy become Python's."""
    place, default = f"{source}: {setting.name}", setting.default
    value = value.item() if isinstance(value, np.generic) else value
    if default is None:
        if isinstance(value, list | tuple) and len(value) == 2 and all(_is_positive(each) for each in value):
            return _at_most(place, _MOST_ELSE, float(value[0])), _at_most(place, _MOST_ELSE, float(value[1]))
        raise InputError(f"{place}: expected two positive numbers in a list, found {shorten(repr(value))}")
    if isinstance(default, tuple):
        return check_estimated(place, list(value) if isinstance(value, list | tuple) else [value])
    if isinstance(default, str):
        if isinstance(value, str) and value in LINEARISATIONS:
            return value
        raise InputError(f"{place}: expected one of {', '.join(LINEARISATIONS)}, found {shorten(repr(value))}")
    most = _MOST.get(setting.name, _MOST_ELSE)
    if isinstance(default, int) and isinstance(value, int) and _is_positive(value):
        return _at_most(place, most, value)
    zero = setting.name not in _POSITIVE
    if isinstance(default, float) and (_is_positive(value) or (zero and type(value) in (int, float) and value == 0)):
        return float(_at_most(place, most, value))
    above = "a number, zero or more" if zero else "a number above zero"
    kind = "a whole number above zero" if isinstance(default, int) else above
    raise InputError(f"{place}: expected {kind}, found {shorten(repr(value))}")


def _is_positive(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value < float("inf")


def _at_most(place: str, most: float, value: float) -> float:
    if value > most:
        raise InputError(f"{place}: expected at most {most:g}, found {shorten(repr(value))}")
    return value

"""What matches between the eyes say about the rig: order of the eyes, rows, rotation, scale and synchronisation."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from sigmaslam.checks.eye_matches import EyeMatches
from sigmaslam.checks.finding import Finding, Severity
from sigmaslam.checks.hypotheses import exchange_eyes, leave_unrectified, stand_upright
from sigmaslam.checks.levelled_eyes import WARN_ROWS, LevelledEyes, level_eyes
from sigmaslam.checks.row_fit import MIN_MATCHES, SIGNIFICANT, RowFit, fit_rows, follows_motion
from sigmaslam.frontend.row_search import ROW_TOLERANCE
from sigmaslam.geometry.camera import RectifiedStereo, StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.slam.argument_checks import MAX_DELAY
from sigmaslam.two_view.epipolar import estimate_epipolar_pose

# The tracker takes a pair for swapped where more than this share of the disparities is below -1 px: cx is moved, from
# the third share on where the least lie no further below, pixels: wrong matches of a fence have a long tail.
_MAX_BEHIND, _WARN_BEHIND, _MOVED_BEHIND, _TAIL = 0.1, 0.02, 0.05, 3.0
# A rig is explained by a hypothesis that this share of the matches follows, if it is so many times the share of
# those that follow the calibration.
_EXPLAINED, _BETTER = 0.5, 2.0
# A delay that moves the median place by less than this is within the noise of a match, pixels.
_WARN_LAG = 0.5
# Many matches share it: far places, which are most, hide what near ones show.
_LEAST_LAG = 0.05
# And one that explains a smaller share of the variance of rows than this may stand for something else; the lesser one
# suffices where nothing but the motion looks like it, for more of a frame than what other faults of a rig look like.
_LAG_SHARE, _LESSER_SHARE, _LEAST_FRAMES = 1 / 3, 1 / 5, 0.03
# Rows in the stored images agree within this if these are rectified already, pixels.
_RECTIFIED_ROWS = 0.5
_SYNCHRONISATION = "synchronisation"
_CORRECTED = "poses are corrected for it, depth that is measured elsewhere is not"
# Lenses bend rows as a yaw does, by so much in a tenth of the places: in KITTI's calibrations twice that, pixels.
_LENS_ROWS = 0.5
_NAMES = ("eyes", "rig", "distortion", _SYNCHRONISATION, "rows", "rotation", "scale", "infinity")
TOO_FEW = "too few matches between the eyes to tell"


def unknown_rig(reason: str, names: Sequence[str] = _NAMES, but: str = "") -> list[Finding]:
    """The findings of those names, all but one, where the images do not show the rig."""
    return [Finding(name, "unknown", reason) for name in names if name != but]


def check_rig(
    matches: EyeMatches, rectifier: StereoRectifier, frame_interval: float | None
) -> tuple[list[Finding], StereoCamera]:
    """Findings from the matches of all pairs together, and the camera without what is wrong with its rows.

    Args:
        matches: of pairs of one rig, rectified by `rectifier`.
        frame_interval: seconds from one frame to the next; None: unknown.
    """
    if len(matches) < MIN_MATCHES:
        return unknown_rig(TOO_FEW), rectifier.camera
    view = rectifier.rectified
    given = fit_rows(matches, view)
    share = given.agreement(ROW_TOLERANCE)
    exchanged = exchange_eyes(matches, rectifier)
    swapped = _agreement(exchanged, view)
    # Lenses that are undistorted for the other eye may look like a shift and a zoom: what needs neither is right.
    plainly = _follows(exchanged) > max(_EXPLAINED, _BETTER * _follows(matches)) and swapped >= share
    better = plainly or swapped > max(_EXPLAINED, _BETTER * share)
    usable = better and _share_behind(fit_rows(exchanged, view)) <= _MAX_BEHIND
    findings = [_check_eyes(matches, share, swapped, usable)]
    if findings[0].severity == "error":
        # The other checks judge the rig as it is once the eyes are exchanged.
        given = fit_rows(exchanged, view)
        level = LevelledEyes(rectifier, exchanged, given)
    else:
        level = level_eyes(matches, rectifier)
    findings += [_check_position(level.fit, level.rectifier), _check_distortion(level, rectifier)]
    if findings[1].severity == "error":
        return findings + unknown_rig("the matches do not follow the calibrated rig", _NAMES[3:]), rectifier.camera
    findings.append(_check_synchronisation(level.fit, frame_interval))
    camera, view = level.rectifier.camera, level.rectifier.rectified
    rows = _check_rows(given, level, rectifier.rectified.fx)
    if findings[-1].severity not in ("ok", "unknown"):
        *others, infinity = unknown_rig("the eyes are not synchronised", _NAMES[4:])
        if level.causes and findings[-1].severity == "warning":
            return [*findings, *rows, infinity], camera
        return [*findings, *others, infinity], rectifier.camera
    infinity = _check_infinity(level.fit)
    if max(level.fit.most("roll"), level.fit.most("yaw")) > WARN_ROWS and infinity.severity != "error":
        infinity = Finding("infinity", "unknown", "the right camera is turned, which changes disparities, too")
    if infinity.severity == "error" and infinity.pixels is not None and findings[0].severity == "ok":
        right = camera.right
        camera = replace(camera, right=replace(right, cx=right.cx + infinity.pixels / view.fx * right.fx))
    return [*findings, *rows, infinity], camera


def find_exchanged(matches: EyeMatches, rectifier: StereoRectifier) -> np.ndarray:
    """Numbers of the pairs whose matches follow the calibration once the eyes are exchanged, and hardly as given."""
    exchanged = exchange_eyes(matches, rectifier)
    numbers = np.unique(matches.pair)
    follow = [[_follows(each.select(each.pair == number)) for number in numbers] for each in (matches, exchanged)]
    given, swapped = np.array(follow).reshape(2, -1)
    return np.asarray(numbers[swapped > np.maximum(_EXPLAINED, _BETTER * given)])


def _check_eyes(matches: EyeMatches, given: float, swapped: float, exchanged: bool) -> Finding:
    if exchanged:
        message = (
            f"left and right are exchanged: {100 * swapped:.0f} % of {len(matches)} matches fit the calibration with "
            f"the eyes exchanged, {100 * given:.0f} % as given: swap the two (or do not mirror both)"
        )
        return Finding("eyes", "error", message, swapped)
    return Finding("eyes", "ok", f"left is left: {100 * given:.0f} % of the matches have the right order", given)


def _check_position(given: RowFit, rectifier: StereoRectifier) -> Finding:
    """Where the right camera is, if rows do not follow the calibration, nearly."""
    share = float((np.abs(given.residual) <= ROW_TOLERANCE).mean())
    matches = given.matches
    upright = fit_rows(stand_upright(matches), rectifier.rectified)
    columns = upright.agreement(ROW_TOLERANCE)
    shifted = abs(float(np.median(matches.row_difference))) > ROW_TOLERANCE
    if shifted and columns > _EXPLAINED and _BETTER * _mad(upright.residual) < _mad(given.residual):
        message = (
            f"the cameras stand one above the other: {100 * columns:.0f} % of the matches lie in one column: turn "
            "images and calibration by 90 degrees"
        )
        return Finding("rig", "error", message, columns)
    if share >= _EXPLAINED:
        return Finding("rig", "ok", f"{100 * share:.0f} % of the matches follow the calibrated rig", share)
    pose = estimate_epipolar_pose(
        rectifier.rectified.matrix, matches.left, matches.right, matches.probability, matches.covariance
    )
    if pose is not None and pose.inliers.mean() > _EXPLAINED:
        x, y, z = -pose.R.T @ pose.direction
        angle = np.degrees(np.arccos(np.clip(0.5 * (np.trace(pose.R) - 1.0), -1.0, 1.0)))
        where = f"in the direction ({x:.2f}, {y:.2f}, {z:.2f}), turned by {angle:.1f} degrees"
    else:
        where = "where the pairs do not agree on"
    message = (
        f"{100 * share:.0f} % of the matches follow the calibration: the images have the right camera {where}, not "
        "(1.00, 0.00, 0.00): give the calibration of this rig, and images taken at the same time"
    )
    return Finding("rig", "error", message, share)


def _check_distortion(level: LevelledEyes, rectifier: StereoRectifier) -> Finding:
    """Whether images that the calibration, which `rectifier` is of, undistorts are rectified already.

    A rectification that is right leaves smaller row differences than there were, whatever else is wrong.
    """
    if rectifier.camera.is_rectified:
        return Finding("distortion", "ok", "the calibration is of rectified images")
    stored = leave_unrectified(level.matches, level.rectifier)
    if len(stored) < MIN_MATCHES:
        return Finding("distortion", "unknown", TOO_FEW)
    before, after = (_mad(fit_rows(each, rectifier.rectified).residual) for each in (stored, level.matches))
    rows = float(np.median(np.abs(stored.row_difference)))
    # A median of absolute values is known to about one part in the root of their number.
    if rows < _RECTIFIED_ROWS and after > before * (1.0 + SIGNIFICANT / np.sqrt(len(stored))):
        message = (
            f"the images look rectified already: rows scatter by {before:.2f} px as they are stored, by {after:.2f} px "
            "after the rectification: give the calibration of the rectified images (no distortion)"
        )
        return Finding("distortion", "warning", message, after / before)
    message = f"rectification takes the scatter of rows from {before:.2f} to {after:.2f} px"
    return Finding("distortion", "ok", message, after / before)


def _check_synchronisation(fit: RowFit, frame_interval: float | None) -> Finding:
    if not np.isfinite(fit.lag):
        return Finding(
            _SYNCHRONISATION, "unknown", "the camera does not move up, down or ahead in these frames: no delay is seen"
        )
    sigma = float(fit.sigmas[4])
    figure = f"{abs(fit.lag):.2f} ± {sigma:.2f} of a frame{_milliseconds(fit.lag, frame_interval)}"
    explained = 1.0 - _mad(fit.residual) ** 2 / max(_mad(fit.residual + fit.by_lag[:, 1]) ** 2, 1e-12)
    is_late = explained > _LAG_SHARE or (
        explained > _LESSER_SHARE and abs(fit.lag) > _LEAST_FRAMES and follows_motion(fit)
    )
    if fit.lag_shift < _LEAST_LAG or not is_late:
        return Finding(_SYNCHRONISATION, "ok", f"the eyes are {figure} apart", fit.lag)
    message = (
        f"the right images are {figure} {_when(fit.lag)} than the left ones, which moves them by {fit.lag_shift:.1f} "
        "px in the median: trigger both cameras together"
    )
    severity: Severity = "error" if float(np.median(np.abs(fit.by_lag[:, 1]))) > ROW_TOLERANCE else "warning"
    delay = fit.lag * (frame_interval or 0.0)
    delay *= abs(delay) < MAX_DELAY
    return Finding(_SYNCHRONISATION, severity, message, fit.lag, fit.lag_shift, delay)


def suspect_pairing(matches: EyeMatches, rectifier: StereoRectifier) -> bool:
    """Whether rows go with the motion, scatter or follow no rig, as if the right images were of other frames."""
    if len(matches) < MIN_MATCHES:
        return False
    fit = fit_rows(matches, rectifier.rectified)
    if fit.agreement(ROW_TOLERANCE) >= _EXPLAINED:
        return max(fit.lag_shift, _mad(fit.residual)) >= _WARN_LAG
    return _agreement(exchange_eyes(matches, rectifier), rectifier.rectified) < _EXPLAINED


def check_pairing(
    matches: EyeMatches, shifted: dict[int, EyeMatches], rectifier: StereoRectifier, frame_interval: float | None
) -> Finding | None:
    """The finding that the right images belong to left ones of other frames; None if they do not.

    Args:
        matches: as given.
        shifted: of each left image with the right one so many frames later.
        rectifier, frame_interval: as of `check_rig`.
    """
    view = rectifier.rectified
    scatter = {
        frames: _mad(fit_rows(each.unfollowed(), view).residual)
        for frames, each in {0: matches, **shifted}.items()
        if len(each) >= MIN_MATCHES
    }
    best = min(scatter, key=lambda frames: scatter[frames], default=0)
    if not best or _BETTER * scatter[best] > scatter.get(0, np.inf):
        return None
    lag = -best
    how_many = "one frame" if scatter[best] < _WARN_LAG else "a frame or more"
    message = (
        f"the right images are {how_many}{_milliseconds(lag, frame_interval)} {_when(lag)} than the left ones: rows of "
        f"matches scatter by {scatter[best]:.1f} px with the right image one {'after' if best > 0 else 'before'}, by "
        f"{scatter[0]:.1f} px as given: pair them so, or trigger both cameras together"
    )
    followed = matches.flow[np.isfinite(matches.flow).all(axis=1)]
    flow = float(np.median(np.linalg.norm(followed, axis=1))) if len(followed) else 0.0
    return Finding(_SYNCHRONISATION, "error", message, lag, abs(lag) * flow)


def _milliseconds(lag: float, frame_interval: float | None) -> str:
    return "" if frame_interval is None else f" ({1e3 * abs(lag) * frame_interval:.0f} ms)"


def _when(lag: float) -> str:
    return "later" if lag > 0 else "earlier"


def _check_rows(given: RowFit, level: LevelledEyes, focal: float) -> list[Finding]:
    """What moves rows: all alike, as a turn does, or as another size of the image; and whether that is corrected."""
    sizes: dict[str, Any] = {**level.causes}
    given = replace(given, **sizes)
    roll, yaw = (float(np.degrees(np.arctan(abs(each) / focal))) for each in (given.roll, given.yaw))
    shift = f"right rows are {given.shift:+.2f} px from the left ones"
    turn = f"the right camera is turned by {roll:.2f} degrees about its axis, {yaw:.2f} about the vertical"
    size = f"the right image is {100.0 * given.zoom / focal:+.2f} % taller"
    kinds = (
        ("rows", ("shift",), shift, "crop both images alike, correct cy of one eye"),
        ("rotation", ("roll", "yaw"), turn, "correct the rotation of the right camera"),
        ("scale", ("zoom",), size, "correct fy of one eye, use the same zoom and size in both"),
    )
    findings = []
    for name, causes, what, cure in kinds:
        most, corrected = given.most(*causes), {*causes} & level.causes.keys()
        pixels = _LENS_ROWS * abs(given.yaw) / given.most("yaw") if "yaw" in corrected else most * (not corrected)
        what = what if name == "rows" else f"{what}: rows move by {most:.2f} px in a tenth of the places"
        severity: Severity = "ok"
        # Lenses bend rows as a yaw: beside a small roll these are no fault yet.
        if corrected or most > ROW_TOLERANCE or max(given.most(each) for each in causes) > WARN_ROWS:
            severity = "error" if most > ROW_TOLERANCE and not corrected else "warning"
            what = f"{what}: {cure}, or calibrate again" + f"; {_CORRECTED}" * bool(corrected)
        findings.append(Finding(name, severity, what, given.shift if name == "rows" else most, pixels))
    return findings


def _check_infinity(fit: RowFit) -> Finding:
    behind = _share_behind(fit)
    lowest = float(np.percentile(_disparity_in_rows(fit), 5))
    if behind <= _WARN_BEHIND:
        return Finding("infinity", "ok", f"{100 * behind:.0f} % of the matches lie behind infinity", behind)
    message = (
        f"{100 * behind:.0f} % of the matches lie behind infinity, with disparities from {lowest:.1f} px: cx of one "
        "eye or the yaw of the right camera is wrong: calibrate again"
    )
    if behind <= _MOVED_BEHIND or (behind <= _MAX_BEHIND and lowest < -_TAIL):
        return Finding("infinity", "warning", message, behind)
    return Finding("infinity", "error", f"{message}; until then the least is taken for 0", behind, -lowest)


def _agreement(matches: EyeMatches, view: RectifiedStereo) -> float:
    """Share of the matches that follow a rig which is nearly that of `view`; zero with few matches."""
    return fit_rows(matches, view).agreement(ROW_TOLERANCE) if len(matches) >= MIN_MATCHES else 0.0


def _disparity_in_rows(fit: RowFit) -> np.ndarray:
    """Disparities of the matches whose rows agree, without what a lag adds to them, pixels."""
    return np.asarray((fit.matches.disparity + fit.by_lag[:, 0])[np.abs(fit.residual) <= ROW_TOLERANCE])


def _share_behind(fit: RowFit) -> float:
    """Share of these that lie behind infinity by more than a pixel; zero without any."""
    disparity = _disparity_in_rows(fit)
    return float((disparity < -1.0).mean()) if len(disparity) else 0.0


def _follows(matches: EyeMatches) -> float:
    """Share of the matches that follow the calibration as it is."""
    level = np.abs(matches.row_difference) <= ROW_TOLERANCE
    return float((level & (matches.disparity > -1.0)).mean()) if len(matches) else 0.0


def _mad(values: np.ndarray) -> float:
    """Median absolute deviation."""
    return float(np.median(np.abs(values - np.median(values))))

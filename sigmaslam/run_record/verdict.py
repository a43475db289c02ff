"""What a run says about the calibration and about what moves, and why it has failed, in words."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sigmaslam.checks.finding import Finding, explain, wrong
from sigmaslam.checks.time_stamps import jitter_words
from sigmaslam.slam.doubt import Doubt
from sigmaslam.slam.estimate import CalibrationEstimate

MIN_FRAMES, MIN_POINTS = 10, 45
"""With fewer tracked frames or map points nothing is said: one false match may move the offset then."""
# A disparity offset is told from other errors and from the scene when it is known this well, pixels.
_MAX_SIGMA = 0.2
# A smaller offset makes no difference to the tracker, pixels.
_MIN_OFFSET = 0.1
# Share of the tracked frames that most matches may contradict without a word.
_MAX_CONTRADICTED = 0.1
# What evidence finds, as shares of the focal length: words, the factor of the figure, and its unit.
_CAUSES = {
    "yaw": ("the right camera is turned about the vertical, by", 180.0 / np.pi, "degrees"),
    "zoom": ("the focal length of one camera is wrong, by", 100.0, "%"),
    "lenses": ("the distortion of one lens is wrong, at 45 degrees by", 100.0, "% of the focal length"),
    "lens": ("the distortion of both lenses is wrong, at 45 degrees by", 100.0, "% of the focal length"),
}
# Findings about the rig, which the disparity offset has its share of.
_RIG = frozenset({"eyes", "mirrored", "rig", "distortion", "rows", "rotation", "scale", "infinity"})


def expected_offset(calibration: dict[str, Any]) -> float:
    """Standard deviation of the disparity offset between calibrations of one rig, pixels.

    The right camera's yaw moves all disparities, and is not known better than the calibration says.

    Args:
        calibration: as `sigmaslam.run_record.run_folder.describe_camera` gives it.
    """
    return float(calibration["left"]["fx"] * calibration["sigmas"]["rotation"])


def contradiction_verdict(summary: dict[str, Any]) -> str | None:
    """That most matches contradict many poses, in words; None where they do not.

    Args:
        summary: of run.json: counts of frames that were tracked, and of those that fewer than half of their matches
            agree with.
    """
    contradicted, tracked = summary.get("contradicted", 0), summary.get("tracked", summary.get("tracking", 0))
    if contradicted <= _MAX_CONTRADICTED * tracked:
        return None
    return (
        f"In {contradicted} of {tracked} tracked frames fewer than half of the matches agree with the pose: something "
        "large moves in the images, and the poses may follow it instead of the scene."
    )


def doubts_verdict(summary: dict[str, Any]) -> list[str]:
    """What spoke against poses, a sentence for each reason.

    Args:
        summary: of run.json: by reason in how many frames, and when first, in seconds.
    """
    words = {
        Doubt.INPUT: "a check of the input, or what images show in motion, found that the eyes do not fit",
        Doubt.OFFSET: "disparities are off by more than calibrations are. Poses are corrected; their scale lies "
        "between a right baseline and one that made up for it within arm's reach, as boards are held: calibrate again",
        Doubt.TIME: "the image shows another moment than its stamp says, as if the driver exchanged frames",
        Doubt.MOTIONS: "two motions explain the image about as well: a torn image, or something large that moves",
        Doubt.START: "the camera was shaken when tracking began, and what moves is hardly told from what rests",
    }
    # Of these the covariances say nothing, or not all.
    alone = {
        Doubt.RIG: "The rig changed at {first:.1f} s: the right camera was bumped or turned. Its calibration was "
        "learned anew from there: calibrate again.",
        Doubt.FIXED: "From {first:.1f} s on landmarks stay in the image while others move, and draw poses along: dots "
        "of a projector (switch it off), a reflection, dirt, or the vehicle (--mask).",
        Doubt.APART: "From {first:.1f} s on, in {frames} frames, one eye is a frame behind: it has rows that the "
        "other one had. Trigger both cameras together, or pair the images anew: depth and poses are wrong.",
        Doubt.EYES: "From {first:.1f} s on, in {frames} frames, the left image is of the right eye: they have no pose. "
        "Does the driver number the cameras anew?",
    }
    usual = "From {first:.1f} s on, in {frames} frames: {words}. The covariances of these poses are widened by what "
    usual += "that may make of them."
    return [
        alone.get(reason, usual).format(**found, words=words.get(reason, reason))
        for reason, found in summary.get("doubts", {}).items()
    ]


def times_verdict(summary: dict[str, Any]) -> str | None:
    """What drivers did to stamps and images, in words; None where nothing can be seen.

    Args:
        summary: of run.json: the noise of stamps, seconds, and how many frames are missing or showed an image again.
    """
    noise, repeated, missing = (summary.get(name, 0) for name in ("stamp_noise", "repeated", "missing"))
    missing -= summary.get("real_time", {}).get("dropped", 0)
    words = [f"Time {jitter_words(noise)}."] if noise > 0.0 else []
    if missing > 0:
        words.append(
            f"By their time stamps {missing} frames are missing, the longest interval is "
            f"{summary['longest_interval']:.2g} s: does the driver drop frames, or was its clock set?"
        )
    if repeated:
        words.append(
            f"{repeated} frames show an image of a frame before, or an eighth of one or more, to the byte, or a "
            "shifted one: they were skipped, and poses are predicted. Does the driver freeze, tear or shift images?"
        )
    return " ".join(words) or None


def calibration_verdict(
    calibration: CalibrationEstimate, frames: int, points: int, expected: float, findings: Sequence[Finding] = ()
) -> str:
    """The estimated disparity offset, what a check found about the rig, and how much worse it is than given, in words.

    One sequence gets the same verdict at any length, or that it is too early to say: an offset counts as wrong where it
    is more than three standard deviations of calibrations of one rig, as it wanders by about one within a drive.

    Args:
        calibration: as it is estimated in the last frame.
        frames: that were tracked.
        points: in the map.
        expected: as of `expected_offset`.
        findings: of a check of the input.
    """
    words = _main_verdict(calibration, frames, points, expected, findings)
    if calibration.worse > 1.0:
        words += f" Lenses and turns seem about {calibration.worse:.1f} times as far off as the "
        words += "calibration's sigmas say: the covariances are widened by that."
    return words


def _main_verdict(
    calibration: CalibrationEstimate, frames: int, points: int, expected: float, findings: Sequence[Finding]
) -> str:
    """`calibration_verdict`, but for the size of errors that are not estimated."""
    faults = wrong(findings)
    delays = [each.message for each in faults if each.name == "synchronisation"]
    if delays:
        return (
            f"Nothing can be said about the calibration, as the eyes are not synchronised: {delays[0]}. Depth is wrong "
            "while the camera moves; poses are corrected for a delay of a part of a frame alone."
        )
    causes = [each.message for each in faults if each.name in _RIG]
    causes += [_describe_cause(name, *each) for name, each in calibration.causes.items() if name in _CAUSES]
    if causes:
        return "The images do not fit the calibration: " + "; ".join(causes) + "."
    offset, sigma = calibration.disparity_offset, calibration.disparity_offset_sigma
    known = float(np.hypot(sigma, expected))
    figure = f"{offset:+.2f} ± {known:.2f} px"
    is_wrong = abs(offset) > max(3.0 * known, _MIN_OFFSET)
    if frames < MIN_FRAMES or points < MIN_POINTS or (sigma > _MAX_SIGMA and not is_wrong):
        return (
            f"It is too early to say whether the rectification is right (disparity offset {figure} from {frames} "
            f"tracked frames and {points} map points): more frames, or things nearer and farther, would tell."
        )
    if is_wrong:
        return (
            f"The rectification is off by {figure} of disparity. The poses are corrected for it; depth measured with "
            "this calibration elsewhere is not: calibrate again."
        )
    seen = "nothing wrong with the rectification can be seen" if calibration.worse == 1.0 else "none can be told"
    return f"The disparity offset is {figure}: {seen}."


def _describe_cause(name: str, probability: float, value: float, sigma: float) -> str:
    """What evidence says of one thing that is wrong."""
    words, factor, unit = _CAUSES[name]
    figure = f"{factor * value:+.2g} ± {factor * sigma:.1g} {unit}".rstrip()
    return (
        f"{words} {figure} (probability {min(100 * probability, 99):.0f} %): poses are corrected for it, depth that is "
        "measured elsewhere is not: calibrate again"
    )


def explain_failure(summary: dict[str, Any], in_map: bool, started: bool, findings: Sequence[Finding]) -> str | None:
    """Why so little of a run, of which less than half of the frames were tracked without two answers; else None.

    Args:
        summary: counts of frames by status, under the names of the statuses, and of all under `frames`.
        in_map: poses were to be in the world of a map.
        started: a frame was good enough to define the world.
        findings: of a check of the input: where it found a fault, that is the reason.
    """
    frames, skipped = summary["frames"], summary["skipped"]
    # Of an ambiguous pose nobody knows whether it is right.
    tracked, ambiguous = summary["tracked"], summary["ambiguous"]
    if frames and 2 * (tracked - ambiguous) >= frames:
        return None
    if frames == skipped:
        return f"None of the {frames} frames could be read." if frames else "There was no frame."
    reasons = "; ".join(explain(findings).splitlines()).replace("?; ", "? ")
    if tracked:
        unsure = f"{ambiguous} are ambiguous, " if ambiguous else ""
        counts = (
            f"Less than half of the frames were tracked{' with one answer' if ambiguous else ''}: "
            f"of {frames}, {unsure}{summary['lost']} are lost, "
            f"{summary['starting']} were before or at the start, {skipped} could not be read or show an image again."
        )
        return f"{counts} {reasons}".rstrip()
    if reasons:
        return f"Nothing was tracked: {reasons}"
    if in_map:
        return "The place was not found in the map: is it a map of this place, seen from where the camera is now?"
    if frames - skipped == 1:
        return "A single frame shows no motion: give two or more."
    if started:
        return (
            "Tracking started, but no later frame was recognised: do the frames follow each other, and does the "
            "calibration fit the camera?"
        )
    return (
        "Tracking never started: no frame has enough points that both cameras see. Are the left and right images "
        "swapped, dark or blurred, or is the calibration of another camera?"
    )

"""All checks of a stereo sequence from a few of its frames."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import cv2
import numpy as np

from sigmaslam.checks.calibration import check_calibration
from sigmaslam.checks.eye_matches import EyeMatcher, EyeMatches
from sigmaslam.checks.finding import Finding, has_errors, tracker_arguments, wrong
from sigmaslam.checks.images import check_images, check_light, check_overlay, describe_frames, light_ratio
from sigmaslam.checks.inertial import check_inertial, check_times
from sigmaslam.checks.rig import TOO_FEW, check_pairing, check_rig, find_exchanged, suspect_pairing, unknown_rig
from sigmaslam.checks.row_fit import MIN_INLIERS, MIN_MATCHES
from sigmaslam.checks.time_stamps import check_time_stamps
from sigmaslam.errors import InputError
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.geometry.rectification import StereoRectifier
from sigmaslam.readers.images import ListedPairs
from sigmaslam.readers.stereo_sequence import SAMPLED_EVERY, FrameStep, StereoSequence

SAMPLES = 8
"""Pairs that `sigmaslam check` looks at."""
SAMPLES_BEFORE_TRACKING = 4
"""Pairs that are looked at before tracking: under two seconds."""
PAIRS_BEFORE_TRACKING = SAMPLED_EVERY * (SAMPLES_BEFORE_TRACKING - 1) + 2
"""Pairs in a row that they are taken from."""
_NO_PAIR = f"pairs: give some (left, right, seconds) in a row, at best {PAIRS_BEFORE_TRACKING}, with images as arrays"
# An image that was turned or mirrored gives so many times the matches once that is undone.
_BETTER = 3.0
_INTRINSICS = {"principal point", "focal length"}
# Of `cv2.flip`.
_TURNS = {"mirrored left to right": 1, "mirrored top to bottom": 0, "turned by 180 degrees": -1}


@dataclass(frozen=True, slots=True)
class Check:
    """What was found, and what it was found in.

    Attributes:
        findings: of all checks, in their order.
        steps: the frames that were looked at.
        rectified: left and right (H, W) uint8 of the first frame of each.
        matches: between these.
        camera: without what is wrong with its rows, to track by.
    """

    findings: list[Finding]
    steps: list[FrameStep]
    rectified: list[tuple[np.ndarray, np.ndarray]]
    matches: EyeMatches
    camera: StereoCamera

    @property
    def tracker_arguments(self) -> dict[str, Any]:
        """Of `StereoTracker`: the camera, and what else of the findings its poses depend on."""
        return {"camera": self.camera, **tracker_arguments(self.findings)}


def check_pairs(camera: StereoCamera, pairs: Iterable[tuple[np.ndarray, np.ndarray, float]], threads: int = 2) -> Check:
    """Checks the first pairs of a camera, as `sigmaslam track` does, for a tracker without what is wrong with rows.

    Example:
        tracker = StereoTracker(**check_pairs(camera, pairs).tracker_arguments)

    Args:
        pairs: left and right (H, W) images as they come from the cameras, and seconds; the first
            `PAIRS_BEFORE_TRACKING` are looked at, those of another size than the calibration's not.
    Raises:
        CalibrationError: all images have another size than the calibration.
        InputError: these are no pairs, or not one, or an image cannot be used.
    """
    listed = [_as_pair(each) for each in islice(pairs, PAIRS_BEFORE_TRACKING)]
    sizes = [(model.height, model.width) for model in (camera.left, camera.right)]
    listed = [each for each in listed if [image.shape[:2] for image in each[:2]] == sizes] or listed
    if not listed:
        raise InputError(_NO_PAIR)
    sequence = StereoSequence(ListedPairs(listed), camera, ListedPairs.source, "memory")
    return check_sequence(sequence, SAMPLES_BEFORE_TRACKING, threads)


def _as_pair(given: Any) -> tuple[np.ndarray, np.ndarray, float]:
    """A pair of images and seconds; InputError where it is none."""
    try:
        (left, right), seconds = map(np.asarray, given[:2]), float(given[2])
    except (TypeError, ValueError, IndexError):
        raise InputError(_NO_PAIR) from None
    if {left.ndim, right.ndim} <= {2, 3}:
        return left, right, seconds
    raise InputError(_NO_PAIR)


def check_sequence(
    sequence: StereoSequence, samples: int = SAMPLES, threads: int = 2, track_imu: bool = False
) -> Check:
    """Checks a sequence; of live cameras it takes the next frames.

    Args:
        sequence: opened by `sigmaslam.readers.open_sequence` or `open_cameras`, and not yet read.
        samples: pairs to look at.
        track_imu: where there is an inertial sensor, also track some seconds and judge it by how the cameras move.
    Raises:
        InputError: a file cannot be read.
    """
    steps = sequence.sample(samples)
    if sequence.timestamps is not None:
        intervals = np.diff(sequence.timestamps)
    else:
        intervals = np.array([after.timestamp - frame.timestamp for frame, after in steps if after is not None])
    rectifier = StereoRectifier(sequence.camera)
    matcher = EyeMatcher(rectifier, threads)
    calibration = check_calibration(sequence.camera)
    findings = [check_time_stamps(intervals.tolist()), *calibration]
    if sequence.imu is not None:
        findings.append(check_inertial(sequence.imu, sequence.timestamps))
    if sequence.odometry is not None:
        findings.append(check_times(sequence.odometry, sequence.timestamps))
    if not steps:
        return Check(findings, [], [], EyeMatches.empty(), sequence.camera)
    images = check_images([(frame.left, frame.right) for frame, _ in steps])
    frames = [frame for frame, _ in steps]
    times, light = [frame.timestamp for frame in frames], np.array([light_ratio(frame) for frame in frames])
    findings += [*images, check_light(times, light), check_overlay(frames)]
    matches, camera = EyeMatches.empty(), sequence.camera
    if has_errors(images):
        # Features of such images would tell nothing, or the same once more.
        findings += unknown_rig("the images allow no matches")
    else:
        matches = matcher.match(steps)
        overlap = _check_overlap(matches, steps, matcher)
        findings.append(overlap)
        interval = float(np.median(intervals)) if len(intervals) else None
        if overlap.severity == "error":
            findings += unknown_rig(TOO_FEW)
        else:
            rig, camera = _check_rig(matches, steps, matcher, interval, {each.name for each in wrong(calibration)})
            findings += rig
            if track_imu and sequence.imu is not None:
                from sigmaslam.checks.inertial_agreement import check_motion  # loads what calibrates

                findings += check_motion(sequence, camera, threads)
    rectified = [rectifier.rectify(frame.left, frame.right) for frame, _ in steps]
    return Check(findings, steps, rectified, matches, camera)


def _check_rig(
    matches: EyeMatches,
    steps: Sequence[FrameStep],
    matcher: EyeMatcher,
    interval: float | None,
    wrong_calibration: set[str],
) -> tuple[list[Finding], StereoCamera]:
    rectifier = matcher.rectifier
    if wrong_calibration & _INTRINSICS:
        # Lenses that are undistorted wrongly move rows as a delay does.
        return check_rig(matches.unfollowed(), rectifier, interval)
    exchanged = find_exchanged(matches, rectifier)
    if 0 < len(exchanged) < len(np.unique(matches.pair)):
        when = describe_frames([frame.timestamp for frame, _ in steps], exchanged)
        message = f"left and right are exchanged in {when}, and not in the others: what wrote them mixes up the cameras"
        rest = matches.select(~np.isin(matches.pair, exchanged))
        findings, camera = _check_rig(rest, steps, matcher, interval, wrong_calibration)
        swap = Finding("eyes", "error", message, len(exchanged) / len(steps))
        return [swap, *(each for each in findings if each.name != swap.name)], camera
    pairing = None
    if suspect_pairing(matches, rectifier):
        pairing = check_pairing(matches, _shift_frames(steps, matcher), rectifier, interval)
    if pairing is None:
        return check_rig(matches, rectifier, interval)
    return [pairing, *unknown_rig("the eyes are not synchronised", but=pairing.name)], rectifier.camera


def _shift_frames(steps: Sequence[FrameStep], matcher: EyeMatcher) -> dict[int, EyeMatches]:
    """Matches of left images with right ones of the frame after (1) and before (-1)."""
    couples = [(frame, after) for frame, after in steps if after is not None]
    shifted = {
        1: [(replace(frame, right=after.right), None) for frame, after in couples],
        -1: [(replace(after, right=frame.right), None) for frame, after in couples],
    }
    return {frames: matcher.match(each) for frames, each in shifted.items() if each}


def _check_overlap(matches: EyeMatches, steps: Sequence[FrameStep], matcher: EyeMatcher) -> Finding:
    counts = np.bincount(matches.pair, minlength=len(steps))
    count = int(np.median(counts))
    if count >= MIN_MATCHES:
        return Finding("overlap", "ok", f"{count} matches between the eyes in the median pair", count)
    # The pair with the median count stands for all.
    frame, _ = steps[int(np.argsort(counts)[len(counts) // 2])]
    undone = {what: replace(frame, right=cv2.flip(frame.right, turn)) for what, turn in _TURNS.items()}
    turned = {what: len(matcher.match([(each, None)])) for what, each in undone.items()}
    what = max(turned, key=lambda each: turned[each])
    if turned[what] >= max(MIN_MATCHES, _BETTER * count):
        message = (
            f"one eye is {what}: {count} matches between the eyes as given, {turned[what]} once the right image is "
            "turned back: undo it in the one of the two that is wrong"
        )
        return Finding("mirrored", "error", message, turned[what])
    keypoints = matcher.count_keypoints(frame)
    cure = (
        "do both cameras see the same, and are the images of one time?"
        if keypoints >= 2 * MIN_MATCHES
        else "point the cameras at something with more texture"
    )
    message = f"{count} matches between the eyes in the median pair of {keypoints} keypoints: {cure}"
    return Finding("overlap", "error" if count < MIN_INLIERS else "warning", message, count)

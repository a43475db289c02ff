"""What a run says about the calibration."""

import pytest

from sigmaslam.checks.finding import Finding
from sigmaslam.run_record.verdict import (
    calibration_verdict,
    contradiction_verdict,
    doubts_verdict,
    expected_offset,
    times_verdict,
)
from sigmaslam.slam.doubt import Doubt
from sigmaslam.slam.tracker import CalibrationEstimate

EXPECTED = 0.1


def verdict(offset: float, sigma: float, *findings: Finding, frames: int = 100, points: int = 1000) -> str:
    return calibration_verdict(CalibrationEstimate(offset, sigma), frames, points, EXPECTED, findings)


@pytest.mark.parametrize(
    ("offset", "sigma", "words"),
    [
        (0.01, 0.03, "nothing wrong"),
        (0.45, 0.04, "off by +0.45 ± 0.11 px"),
        (-0.45, 0.04, "off by -0.45 ± 0.11 px"),
        (0.27, 0.01, "nothing wrong"),  # certain, but no more than calibrations of one rig differ by
        (0.3, 0.25, "too early to say"),
    ],
)
def test_the_verdict_is_in_words(offset: float, sigma: float, words: str):
    assert words in verdict(offset, sigma)


@pytest.mark.parametrize(
    ("contradicted", "tracked", "told"), [(0, 29, False), (2, 29, False), (3, 29, True), (1, 1, True)]
)
def test_frames_that_most_matches_contradict_are_told_of(contradicted: int, tracked: int, told: bool):
    words = contradiction_verdict({"contradicted": contradicted, "tracked": tracked})
    assert (words is not None) == told
    assert words is None or f"{contradicted} of {tracked} tracked frames" in words


def test_a_calibration_without_errors_leaves_the_estimate_alone():
    exact = {"left": {"fx": 500.0}, "sigmas": {"rotation": 0.0}}
    assert expected_offset(exact) == 0.0
    assert "off by +0.12 ± 0.01" in calibration_verdict(CalibrationEstimate(0.12, 0.01), 100, 1000, 0.0)
    # Too small to matter, however well known.
    assert "nothing wrong" in calibration_verdict(CalibrationEstimate(0.09, 0.01), 100, 1000, 0.0)


def test_a_calibration_that_is_worse_than_its_sigmas_is_told_of():
    good, bad = (calibration_verdict(CalibrationEstimate(0.0, 0.03, worse=worse), 100, 1000, 0.1) for worse in (1, 2.8))
    assert "nothing wrong" in good
    assert "times as far off" not in good
    # Not both in one breath.
    assert "nothing wrong" not in bad
    assert "offset is +0.00 ± 0.10 px: none can be told. Lenses and turns seem about 2.8 times as far off" in bad


def test_a_large_offset_is_named_however_uncertain_its_scale_makes_it():
    assert "off by +3.40 ± 0.4" in verdict(3.4, 0.4)
    assert (
        "scale lies between a right baseline and one that made up for it within arm's reach"
        in doubts_verdict({"doubts": {Doubt.OFFSET: {"frames": 3, "first": 1.0}}})[0]
    )


@pytest.mark.parametrize(("doubt", "cure"), [(Doubt.FIXED, "--mask"), (Doubt.APART, "Trigger both cameras together")])
def test_what_stays_in_the_image_and_an_eye_that_is_late_have_a_cure(doubt: Doubt, cure: str):
    assert cure in doubts_verdict({"doubts": {doubt: {"frames": 3, "first": 1.0}}})[0]


@pytest.mark.parametrize("doubt", [Doubt.INPUT, Doubt.OFFSET, Doubt.TIME, Doubt.MOTIONS])
def test_doubts_are_sentences_that_promise_no_cover(doubt: Doubt):
    """A wrong lens was not covered: NEES 9.8 where 1 is due."""
    said = doubts_verdict({"doubts": {doubt: {"frames": 3, "first": 1.0}}})[0]
    assert said.endswith(". The covariances of these poses are widened by what that may make of them.")
    assert "?." not in said


@pytest.mark.parametrize(("frames", "points"), [(3, 1000), (100, 22)])
def test_few_frames_or_points_say_nothing(frames: int, points: int):
    assert "too early" in verdict(0.9, 0.04, frames=frames, points=points)


def test_one_drive_gets_one_verdict_at_any_length():
    """Offsets of KITTI's drive 39 after 20, 60, 100 and 186 frames, in two versions of the tracker."""
    expected = expected_offset({"left": {"fx": 721.5}, "sigmas": {"rotation": 0.0003}})
    for offsets in (
        ((-0.158, 0.024), (0.088, 0.014), (0.036, 0.016), (0.129, 0.012)),
        ((-0.044, 0.244), (0.074, 0.033), (0.060, 0.036), (0.104, 0.039)),
    ):
        words = [calibration_verdict(CalibrationEstimate(*each), 20, 1000, expected) for each in offsets]
        assert all("nothing wrong" in each or "too early" in each for each in words)


LATE = Finding("synchronisation", "warning", "the right images are 100 ms later: trigger both", 1.0)
ROWS = Finding("rows", "error", "right rows are +3.00 px from the left ones: crop both images alike", 3.0)
GOOD = Finding("eyes", "ok", "left is left", 1.0)


def test_unsynchronised_eyes_are_not_blamed_on_the_calibration():
    said = verdict(0.44, 0.08, ROWS, LATE, GOOD)
    assert "calibrate" not in said
    assert LATE.message in said


def test_what_the_images_show_comes_before_the_offset():
    said = verdict(0.0, 0.03, GOOD, ROWS)
    assert "do not fit the calibration" in said
    assert ROWS.message in said
    assert "left is left" not in said


def test_stamps_that_jitter_and_images_that_repeat_are_said():
    assert times_verdict({"stamp_noise": 0.0, "repeated": 0}) is None
    assert "jitter by 31 ms" in times_verdict({"stamp_noise": 0.031, "repeated": 0})
    assert "10 frames" in times_verdict({"stamp_noise": 0.0, "repeated": 10})
    said = times_verdict({"missing": 12, "longest_interval": 0.55})
    assert "12 frames are missing, the longest interval is 0.55 s" in said
    # Those that we dropped ourselves are no fault of the driver.
    dropped = {"real_time": {"dropped": 12}}
    assert times_verdict({"missing": 12, "longest_interval": 0.55, **dropped}) is None


def test_a_cause_that_evidence_names_is_said_in_place_of_the_offset():
    said = calibration_verdict(
        CalibrationEstimate(-3.8, 0.1, {}, {"yaw": (0.9999, -0.005236, 0.0002)}), 100, 1000, EXPECTED
    )
    assert "turned about the vertical, by -0.3 ± 0.01 degrees (probability 99 %)" in said
    assert "of disparity" not in said

"""Each mistake of a user is named, by its own check, and a sequence without mistakes by none."""

from itertools import islice
from pathlib import Path

import pytest

from sigmaslam.checks import check_sequence, explain
from sigmaslam.checks.finding import wrong
from sigmaslam.readers import open_sequence
from tests.support.estimates import Demo
from tests.support.injected_faults import FAULTS, RECTIFIED_FAULTS, WIDE_FAULTS, Fault, Frames, sequence_of

SAMPLES = 2
# The samples are taken from so many frames; a delay shortens them by one. The demo moves fast enough there.
FRAMES = 12
FAST = slice(14, 14 + FRAMES)


def assert_named(fault: Fault, frames: Frames, camera) -> None:
    findings = check_sequence(fault.inject(frames, camera), SAMPLES).findings
    named = {each.name: each.message for each in wrong(findings)}
    assert fault.word in named.get(fault.finding, ""), named
    # The reason of a failed run has it, too, and before all that follows from it; unless it is corrected.
    is_corrected = any(each.name == fault.finding and each.pixels == 0.0 for each in findings)
    assert (named[fault.finding] in explain(findings).splitlines()) != is_corrected
    assert all("\n" not in message for message in named.values())


@pytest.mark.long
@pytest.mark.parametrize("name", [*FAULTS, *RECTIFIED_FAULTS])
def test_a_fault_in_the_demo_is_named(name: str, demo: Demo):
    camera, frames, _ = demo
    assert_named({**FAULTS, **RECTIFIED_FAULTS}[name], frames[FAST], camera)


def test_nothing_is_wrong_with_the_demo(demo: Demo):
    camera, frames, _ = demo
    findings = check_sequence(sequence_of(frames, camera), 4).findings
    assert {each.severity for each in findings} == {"ok"}
    assert explain(findings) == ""


def test_exchanged_eyes_hide_no_other_fault(demo: Demo):
    camera, frames, _ = demo
    exchanged = FAULTS["eyes exchanged"].frames(FAULTS["rows off by 3"].frames(frames[FAST], camera), camera)
    findings = wrong(check_sequence(sequence_of(exchanged, camera), SAMPLES).findings)
    assert [each.name for each in findings] == ["eyes", "rows"]
    assert findings[1].figure == pytest.approx(3.0, abs=0.2)


def test_a_single_pair_is_judged(demo: Demo):
    camera, frames, _ = demo
    findings = {each.name: each for each in check_sequence(sequence_of(frames[:1], camera)).findings}
    assert findings["eyes"].severity == "ok"
    assert findings["synchronisation"].severity == findings["time stamps"].severity == "unknown"


KITTI, EUROC = "kitti_raw_0926_0039_a", "euroc_mh01_f000_099"


@pytest.fixture(scope="module")
def real_frames(real_data: Path):
    """The camera and the first frames of real sequences: one with a car, one with a drone in the hand."""
    sequences = {name: open_sequence(real_data / name) for name in (KITTI, EUROC)}
    return {name: (sequence.camera, list(islice(sequence.frames(), FRAMES))) for name, sequence in sequences.items()}


# Both eyes mirrored before they are undistorted are called turned: no rectification fits them.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("data", "name"),
    [
        *((KITTI, name) for name in [*FAULTS, *WIDE_FAULTS, *RECTIFIED_FAULTS]),
        *((EUROC, name) for name in [*FAULTS, *WIDE_FAULTS] if name != "both eyes mirrored"),
    ],
)
def test_a_fault_in_a_real_sequence_is_named(data: str, name: str, real_frames):
    camera, frames = real_frames[data]
    assert_named({**FAULTS, **WIDE_FAULTS, **RECTIFIED_FAULTS}[name], frames, camera)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        KITTI,
        "kitti_odometry_01_f000_050",
        EUROC,
        "euroc_v1_01_static",
        "euroc_v1_01_keyframes_a",
        "lunar_sand_rover_f000_224",
        "liver_phantom_stage_translation",
    ],
)
def test_real_sequences_are_not_blamed(name: str, real_data: Path):
    """KITTI's lenses bend rows as half a degree of yaw: "Recalibrating the KITTI Dataset Camera Setup", ECMR 2021."""
    findings = check_sequence(open_sequence(real_data / name)).findings
    assert wrong(findings) == [], explain(findings)

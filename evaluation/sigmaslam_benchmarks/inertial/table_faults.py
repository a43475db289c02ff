"""Faults of an inertial sensor's table that a check before tracking is to name: units, axes, signs and clocks."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sigmaslam.geometry.inertial_sensor import STANDARD_GRAVITY, InertialSamples
from sigmaslam.readers.inertial import InertialRecording
from sigmaslam_benchmarks.live.driven_runs import track_ours
from sigmaslam_benchmarks.live.recordings import GoodFrames

# Frames that are tracked with a faulty table: two seconds at 20 Hz, of which the tracker compares turns over one.
_FRAMES = 40
# Seconds by which clocks differ, evenly in the logarithm.
_OFFSETS = (0.01, 0.2)

Spoil = Callable[[InertialSamples, np.random.Generator], tuple[InertialSamples, str]]
"""Spoils samples, and says how."""


@dataclass(frozen=True, slots=True)
class TableFault:
    """A fault that is drawn with a seed; of kind `""`: none."""

    kind: str
    seed: int

    @property
    def name(self) -> str:
        """Of its result."""
        return f"table-{(self.kind or 'good').replace('/', '_')}-{self.seed}"


@dataclass(frozen=True, slots=True)
class FaultResult:
    """What is said of a faulty table.

    Attributes:
        kind: one of `TABLE_FAULTS`, or empty for a good table.
        words: what was done.
        named: a sentence about the sensor has a word for it.
        said: all sentences about the sensor.
    """

    kind: str
    words: str
    named: bool
    said: list[str]


def rate_in_degrees(samples: InertialSamples, rng: np.random.Generator) -> tuple[InertialSamples, str]:
    """Angular rates in deg/s."""
    return replace(samples, gyro=np.degrees(samples.gyro)), "rates in deg/s"


def force_in_g(samples: InertialSamples, rng: np.random.Generator) -> tuple[InertialSamples, str]:
    """Specific forces in g."""
    return replace(samples, accel=samples.accel / STANDARD_GRAVITY), "forces in g"


def turn_axes(samples: InertialSamples, rng: np.random.Generator) -> tuple[InertialSamples, str]:
    """The sensor sits otherwise than its T_cam_imu says: one of the 23 turns that map axes to axes."""
    turns = Rotation.create_group("O").as_matrix().round()
    turns = turns[[not np.allclose(turn, np.eye(3)) for turn in turns]]
    turn = turns[rng.integers(len(turns))]
    axes = ", ".join("xyz"[int(np.argmax(np.abs(row)))] if row.sum() > 0 else f"-{'xyz'[int(np.argmax(np.abs(row)))]}"
                     for row in turn)  # fmt: skip
    return replace(samples, gyro=samples.gyro @ turn.T, accel=samples.accel @ turn.T), f"axes are {axes}"


def swap_sign(samples: InertialSamples, rng: np.random.Generator) -> tuple[InertialSamples, str]:
    """One column of the six has the wrong sign."""
    column = int(rng.integers(6))
    signs = np.ones(6)
    signs[column] = -1.0
    name = f"{'rate' if column < 3 else 'force'} {'xyz'[column % 3]}"
    return replace(samples, gyro=samples.gyro * signs[:3], accel=samples.accel * signs[3:]), f"sign of {name}"


def shift_clock(samples: InertialSamples, rng: np.random.Generator) -> tuple[InertialSamples, str]:
    """The clock is off by 10 to 200 ms."""
    offset = float(rng.choice([-1.0, 1.0]) * np.exp(rng.uniform(*np.log(_OFFSETS))))
    return replace(samples, timestamp=samples.timestamp + offset), f"clock off by {1e3 * offset:+.0f} ms"


TABLE_FAULTS: dict[str, tuple[Spoil, tuple[str, ...]]] = {
    "deg/s": (rate_in_degrees, ("deg/s", "rad/s")),
    "g": (force_in_g, ("in g:",)),
    "axes": (turn_axes, ("axes", "axis", "T_cam_imu")),
    "sign": (swap_sign, ("sign",)),
    "clock": (shift_clock, ("clock", "offset", "delay")),
}
"""How to make a fault, and words of which one names it."""


def judge_table(good: GoodFrames, kind: str, seed: int) -> FaultResult:
    """What check and tracker say of a good or faulty table in the first seconds of a recording.

    Args:
        good: with an inertial sensor.
        kind: of the fault; empty: none.
        seed: of the fault.
    """
    assert good.imu is not None
    samples, words = good.imu.samples, "good"
    sought: tuple[str, ...] = ("",)
    if kind:
        spoil, sought = TABLE_FAULTS[kind]
        samples, words = spoil(samples, np.random.default_rng(seed))
    imu: InertialRecording = replace(good.imu, samples=samples)
    with tempfile.TemporaryDirectory() as scratch:
        run = track_ours(good.frames[:_FRAMES], good.camera, Path(scratch) / "run", imu)
    # Sentences about the table begin with it; the tracker calls the sensor by its name.
    said = [line for line in [*run.said, run.refused] if line.startswith(str(imu.source)) or "inertial sensor" in line]
    return FaultResult(kind, words, any(word in line for line in said for word in sought), said)

"""A vehicle by an IMU at irregular times, GPS with outliers, a wheel and a compass: compiled, smoothed, exported.

Every reading is an event: a motion since the event before, by the IMU's acceleration and turn rate, then a sensor. The
IMU's rate is between 12 and 50 Hz, and one GPS fix in twenty is 20 m off. `late` is for fixes that come half a second
late: the filter goes back to the belief before them. `python examples/filters/fuse_vehicle.py FOLDER` writes a C++
header for each sensor; call them in the order of the events.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

import torch
from torch import Tensor

from sigmaslam_filters import (
    SO2,
    Diagonal,
    Euclidean,
    Event,
    Gaussian,
    MeasurementModel,
    MotionModel,
    Product,
    StepExample,
    UnscentedKalmanFilter,
    compile_filter,
    export_step,
    interleaved,
    stack,
    wrap_angle,
)

DOUBLE = torch.float64
# x, y (m), speed (m/s), bias of the turn rate (rad/s), heading (rad).
SPACE = Product(Euclidean(4), SO2())
FILTER = UnscentedKalmanFilter(SPACE, iterations=1)


def drive(state: Tensor, imu: Tensor, seconds: Tensor) -> Tensor:
    """(..., 5) after a time (..., 1) with forward acceleration and turn rate (..., 2)."""
    x, y, speed, bias, heading = (state[..., k] for k in range(5))
    dt, middle = seconds[..., 0], heading + 0.5 * seconds[..., 0] * (imu[..., 1] - bias)
    way = dt * (speed + 0.5 * dt * imu[..., 0])
    return stack([
        x + way * torch.cos(middle), y + way * torch.sin(middle), speed + dt * imu[..., 0], bias,
        wrap_angle(heading + dt * (imu[..., 1] - bias)),
    ])  # fmt: skip


def variances(*deviations: float) -> Diagonal:
    """Of standard deviations."""
    return Diagonal(torch.tensor(deviations, dtype=DOUBLE) ** 2)


DEVIATIONS = torch.tensor([0.005, 0.005, 0.05, 1e-4, 0.003], dtype=DOUBLE)  # of a step, in the tangent's order
MOTION = MotionModel(drive, Diagonal(DEVIATIONS**2))
GPS = MeasurementModel(lambda state: state[..., :2], variances(1.0, 1.0))
WHEEL = MeasurementModel(lambda state: state[..., 2:3], variances(0.1))
COMPASS = MeasurementModel(
    lambda state: state[..., 4:5], variances(0.05), residual=lambda measured, seen: wrap_angle(measured - seen)
)
SENSORS = {"gps": (GPS, 1.0), "wheel": (WHEEL, 0.1), "compass": (COMPASS, 0.05)}


def simulate(events: int, seed: int = 0) -> tuple[list[Event], Tensor, Tensor]:
    """Readings by sensors, the order (events,) in which they come, and the true states (events, 5)."""
    generator = torch.Generator().manual_seed(seed)
    normal = torch.randn(events, 7, generator=generator, dtype=DOUBLE)
    uniform = torch.rand(events, 2, generator=generator, dtype=DOUBLE)
    seconds, k = 0.02 + 0.06 * uniform[:, :1], torch.arange(events)
    imu = torch.stack([0.5 * torch.sin(k / 180.0), 0.2 * torch.sin(k / 140.0)], dim=-1).to(DOUBLE)
    state, states = torch.tensor([0.0, 0.0, 8.0, 0.01, 0.0], dtype=DOUBLE), []
    process = DEVIATIONS * normal[:, :5]
    for at in range(events):
        state = SPACE.retract(drive(state, imu[at], seconds[at]), process[at])
        states.append(state)
    truth = torch.stack(states)
    order = torch.where(k % 20 == 0, 0, 1 + k % 2)
    streams = []
    for number, (sensor, deviation) in enumerate(SENSORS.values()):
        mine = (order == number).nonzero()[:, 0]
        size = 2 if sensor is GPS else 1
        value = sensor.function(truth[mine]) + deviation * normal[mine, 5 : 5 + size]
        if sensor is GPS:
            value = value + 20.0 * (uniform[mine, 1:] < 0.05)
        gate = 0.999 if sensor is GPS else None
        streams.append(Event(MOTION, sensor, value, {"imu": imu[mine], "seconds": seconds[mine]}, gate=gate))
    return streams, order, truth


def start() -> Gaussian:
    """What is known before the first event."""
    mean = torch.tensor([0.0, 0.0, 8.0, 0.0, 0.0], dtype=DOUBLE)
    return Gaussian(mean, variances(1.0, 1.0, 0.5, 0.02, 0.1).covariance())


def late(events: list[Event], delay: int = 10) -> list[Gaussian]:
    """The beliefs at the end of each `delay` events where fixes come so many events late, and the last.

    Each time the filter goes back to the belief before the fixes that came, and filters again with them in place.
    """
    fast, before = compile_filter(FILTER), start()
    known = [Event(event.motion, motion_inputs=event.motion_inputs) if event.gate else event for event in events]
    beliefs = []
    for first in range(0, len(events), delay):
        whole = fast.filter_events(before, known[first : first + delay])
        beliefs.append(whole.filtered[-1])
        before = fast.filter_events(before, events[first : first + delay]).filtered[-1]
    return [*beliefs, before]


def export(folder: Path) -> dict[str, float]:
    """Writes a header a sensor, `predict` in each; the largest difference of each from torch."""
    inputs = {"imu": torch.tensor([0.1, 0.2], dtype=DOUBLE), "seconds": torch.tensor([0.05], dtype=DOUBLE)}
    belief, differences = start(), {}
    for name, (sensor, _) in SENSORS.items():
        example = StepExample(belief, sensor.evaluate(belief.mean[None])[0], inputs)
        gate = 0.999 if name == "gps" else None
        differences[name] = export_step(FILTER, MOTION, sensor, example, folder / f"{name}.hpp", gate=gate)
    return differences


def main(folder: Path, events: int = 20_000) -> None:
    """Filters, smooths, times and exports."""
    fast = compile_filter(FILTER)
    streams, order, truth = simulate(events)
    fast.filter_streams(start(), streams, order)  # compiles
    begun = time.process_time()
    track = fast.filter_streams(start(), streams, order)
    rate = events / (time.process_time() - begun)
    first = interleaved(streams, order)[:300]
    eager = FILTER.filter_events(start(), first)
    off = (track.filtered.mean[:300] - eager.filtered.mean).abs().max() / eager.filtered.mean.abs().max()
    print(f"{rate:.0f} events a second, {rms(track.filtered.mean - truth):.3f} m; off from torch by {float(off):.1e}")
    smoothed = FILTER.smooth(fast.filter_events(start(), first))
    print(f"of the first 300: {rms(eager.filtered.mean - truth[:300]):.3f} m, smoothed "
          f"{rms(smoothed.mean - truth[:300]):.3f} m")  # fmt: skip
    print("headers, off from torch by", {name: f"{off:.1e}" for name, off in export(folder).items()})


def rms(errors: Tensor) -> float:
    """Of positions (..., 5), metres."""
    return float(errors[..., :2].square().sum(dim=-1).mean().sqrt())


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))

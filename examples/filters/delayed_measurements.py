"""Delayed measurements: go back to the belief before, and filter again.

Run it with `python examples/filters/delayed_measurements.py`. A position comes 0.4 s after it was measured; the speed
comes at once. Kept are the beliefs and events since then.
"""

from typing import Any

import torch

from sigmaslam_filters import Event, Gaussian, KalmanFilter, LinearMeasurement, LinearMotion

DOUBLE, STEP, DELAY = torch.float64, 0.1, 4
MOTION = LinearMotion(
    torch.tensor([[1.0, STEP], [0.0, 1.0]], dtype=DOUBLE),
    0.5 * torch.tensor([[STEP**3 / 3, STEP**2 / 2], [STEP**2 / 2, STEP]], dtype=DOUBLE),
)
POSITION = LinearMeasurement(torch.tensor([[1.0, 0.0]], dtype=DOUBLE), torch.tensor([[0.01]], dtype=DOUBLE))
SPEED = LinearMeasurement(torch.tensor([[0.0, 1.0]], dtype=DOUBLE), torch.tensor([[0.25]], dtype=DOUBLE))


def run(axes: Any = None) -> dict[str, float]:
    """Error of what is known on the way: late fixes put in their place, left out, or taken for new."""
    generator = torch.Generator().manual_seed(3)
    k = torch.arange(150, dtype=DOUBLE)
    truth = torch.stack([torch.sin(k * STEP), torch.cos(k * STEP)], dim=-1)
    normal = torch.randn(150, 2, generator=generator, dtype=DOUBLE)
    speeds = [Event(MOTION, SPEED, truth[at, 1:] + 0.5 * normal[at, 1:]) for at in range(150)]
    fixes = {at: truth[at, :1] + 0.1 * normal[at, :1] for at in range(0, 150, 5)}
    kf, known = KalmanFilter(), {}
    for way in ("in their place", "left out", "taken for new"):
        beliefs, events = (
            [Gaussian(torch.zeros(2, dtype=DOUBLE), torch.eye(2, dtype=DOUBLE))],
            [[each] for each in speeds],
        )
        for at in range(150):
            first, late = at, fixes.get(at - DELAY)
            if late is not None and way != "left out":
                first = at - DELAY if way == "in their place" else at
                events[first].append(Event(None, POSITION, late))
            # Beliefs before the late event stay; those after it are made again.
            del beliefs[first + 1 :]
            for each in events[first : at + 1]:
                beliefs.append(kf.filter_events(beliefs[-1], each).filtered[-1])
            known[way, at] = beliefs[-1].mean[0] - truth[at, 0]
    if axes is not None:
        for way in ("in their place", "taken for new"):
            axes.plot(k * STEP, [float(known[way, at]) for at in range(150)], label=way)
        axes.legend()
    return {
        f"rms, {way} [m]": float(torch.stack([known[way, at] for at in range(20, 150)]).square().mean().sqrt())
        for way in ("in their place", "left out", "taken for new")
    }


if __name__ == "__main__":
    print(run())

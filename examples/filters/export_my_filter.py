"""A filter on a manifold of one's own, with a motion and a sensor of one's own, as an ONNX graph.

A dial turns at a rate that drifts; a camera sees the cosine and the sine of its angle. Run it with
`python examples/filters/export_my_filter.py dial.onnx`; the second half needs numpy and onnxruntime only.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from sigmaslam_filters import (
    Diagonal,
    Gaussian,
    MeasurementModel,
    MotionModel,
    StepExample,
    UnscentedKalmanFilter,
    export_step,
    stack,
    wrap_angle,
)


class Dial:
    """Angle in (-pi, pi] and its rate: points and tangents (..., 2)."""

    point_size = tangent_size = 2

    def retract(self, point: Tensor, tangent: Tensor) -> Tensor:
        """point [+] tangent."""
        return stack([wrap_angle(point[..., 0] + tangent[..., 0]), point[..., 1] + tangent[..., 1]])

    def local(self, point: Tensor, other: Tensor) -> Tensor:
        """other [-] point."""
        return stack([wrap_angle(other[..., 0] - point[..., 0]), other[..., 1] - point[..., 1]])


def turn(state: Tensor, seconds: Tensor) -> Tensor:
    """(..., 2) after a time (..., 1)."""
    return stack([wrap_angle(state[..., 0] + seconds[..., 0] * state[..., 1]), state[..., 1]])


def see(state: Tensor) -> Tensor:
    """Cosine and sine of the angle, (..., 2)."""
    return stack([torch.cos(state[..., 0]), torch.sin(state[..., 0])])


def export(path: Path) -> float:
    """Writes the graph; returns its largest difference from torch."""
    double = torch.float64
    motion = MotionModel(turn, Diagonal(torch.tensor([1e-5, 1e-3], dtype=double)))
    camera = MeasurementModel(see, Diagonal(torch.tensor([0.01, 0.01], dtype=double)))
    example = StepExample(
        Gaussian(torch.tensor([3.0, 0.5], dtype=double), 0.1 * torch.eye(2, dtype=double)),
        value=torch.tensor([-1.0, 0.1], dtype=double),
        motion_inputs={"seconds": torch.tensor([0.1], dtype=double)},
    )
    return export_step(UnscentedKalmanFilter(Dial(), iterations=1), motion, camera, example, path)


def run(path: Path, steps: int = 60) -> float:
    """Follows a dial that turns across the cut by the graph alone; returns the error of its angle, radians."""
    session = onnxruntime.InferenceSession(path)
    rng = np.random.default_rng(0)
    mean, covariance = np.zeros((1, 2)), np.diag([4.0, 1.0])[None]
    angle, rate, seconds = 2.0, 0.7, 0.1
    for _ in range(steps):
        angle += rate * seconds
        value = np.array([[np.cos(angle), np.sin(angle)]]) + 0.1 * rng.standard_normal((1, 2))
        feed = {"mean": mean, "covariance": covariance, "seconds": np.array([[seconds]]), "value": value}
        mean, covariance, *_ = session.run(None, feed)
    return float(np.angle(np.exp(1j * (mean[0, 0] - angle))))


if __name__ == "__main__":
    written = Path(sys.argv[1] if len(sys.argv) > 1 else "dial.onnx")
    print(f"largest difference from torch {export(written):.1e}; angle off by {run(written):.3f} rad")

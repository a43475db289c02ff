"""Inputs by which the graphs of the tracker's estimator are traced and checked, their names and free axes."""

from functools import partial
from typing import Any

import torch
from torch import Tensor

from sigmaslam.estimation.state_layout import CALIBRATION_SIZE, LANDMARK_SIZE
from sigmaslam_filters.manifolds.se3_matrices import exp_se3
from sigmaslam_models.estimator.frame_update import FrameViews
from sigmaslam_models.estimator.window_solution import WindowViews

ROBUST_INPUTS = ("measurement", "noise", "offset", "spread", "moved", "gated", "scale")
GATED_INPUTS = ("measurement", "noise", "offset", "spread", "moved", "noise_scale", "scale", "freedom", "prior")
ROBUST_OUTPUTS = ("offset_after", "spread_after", "moved_after", "usable")
GATED_OUTPUTS = (
    *("agree", "count", "usable", "squared", "noise_scale_found", "offset_after", "spread_after", "moved_after"),
    *("common_after", "information", "scores", "score", "prior_cost"),
)
WINDOW_INPUTS = ("measured", "variance", "freedom")
WINDOW_OUTPUTS = ("information", "vector", "covariance_after", "dependence", "step")
PREDICTED = ("mean", "views_covariance", "in_front")


def frame_axes(*inputs: str) -> tuple[dict[int, Any], ...]:
    """Free axes of such inputs: of views, pairs of poses, poses, and columns of the prior's factor."""
    views = torch.export.Dim("views", min=1, max=1_000_000)
    pairs = torch.export.Dim("pairs", min=1, max=1000)
    poses = torch.export.Dim("poses", min=2, max=1000)
    columns = torch.export.Dim("columns", min=1, max=10_000)
    state = 6 * poses + CALIBRATION_SIZE
    names = ("pair", "common", "covariance", "estimate", "measurement", "noise", "moved")
    axes: dict[str, dict[int, Any]] = {name: {0: views} for name in names}
    axes |= {name: {0: pairs} for name in ("anchors", "views")}
    axes |= {"dependence": {0: views, 2: state}, "poses": {0: poses}, "factor": {0: state, 1: columns}}
    axes |= {"offset": {0: state}, "spread": {0: state, 1: state}, "prior": {0: state}}
    return tuple(axes.get(name, {}) for name in inputs)


def window_axes(*inputs: str) -> tuple[dict[int, Any], ...]:
    """Free axes of such inputs: of views, pairs of poses, landmarks, and poses."""
    observations = torch.export.Dim("observations", min=1, max=1_000_000)
    landmarks = torch.export.Dim("landmarks", min=1, max=1_000_000)
    pairs = torch.export.Dim("pairs", min=1, max=10_000)
    poses = torch.export.Dim("poses", min=2, max=1000)
    state = 6 * poses + CALIBRATION_SIZE
    names = ("pair", "common", "owner", "measurement", "noise")
    axes: dict[str, dict[int, Any]] = {name: {0: observations} for name in names}
    axes |= {name: {0: landmarks} for name in ("estimate", "covariance", "measured", "variance")}
    axes |= {name: {0: pairs} for name in ("anchors", "views")}
    axes |= {"poses": {0: poses}, "spread": {0: state, 1: state}}
    return tuple(axes.get(name, {}) for name in inputs)


def window_example(seed: int, keyframes: int, count: int, *inputs: str) -> tuple[Tensor, ...]:
    """Such inputs of a window whose keyframes each see the landmarks of all earlier ones.

    Args:
        seed: of the draw.
        keyframes, count: how many there are, and how many landmarks.
        inputs: names, those of `WindowViews` among them.
    """
    names = ("intrinsics", "depth", "unscented", "covariance", "estimate", "poses", "calibration", "spread", "noise")
    drawn = frame_example(seed, keyframes - 1, count, *names, "common", "freedom")
    values = dict(zip((*names, "common", "freedom"), drawn, strict=True))
    generator = torch.Generator().manual_seed(seed + 100)
    anchor = torch.arange(count) % (keyframes - 1)
    view, owner = torch.nonzero(torch.arange(keyframes)[:, None] > anchor, as_tuple=True)
    pairs, pair = torch.unique(anchor[owner] * keyframes + view, return_inverse=True)
    values |= {"anchors": pairs // keyframes, "views": pairs % keyframes, "pair": pair, "owner": owner}
    values |= {"common": values["common"][owner], "noise": values["noise"][owner]}
    values |= {"measured": values["estimate"].clone(), "variance": torch.full((count, LANDMARK_SIZE), 0.1).double()}
    values["estimate"] = values["estimate"] + 0.1 * torch.randn(count, LANDMARK_SIZE, generator=generator).double()
    values["measurement"] = torch.zeros(len(owner), 3, dtype=torch.float64)
    with torch.no_grad():
        _, residual, _, _ = WindowViews(*(values[name] for name in WindowViews._fields)).linearise()
    values["measurement"] = 0.5 * torch.randn(len(owner), 3, generator=generator).double() - residual
    values["measurement"][:2, 2] = float("nan")
    return tuple(values[name] for name in inputs)


def frame_example(seed: int, keyframes: int, count: int, *inputs: str) -> tuple[Tensor, ...]:
    """Such inputs of a frame that sees landmarks of each of the keyframes, drawn from a prior.

    Args:
        seed: of the draw.
        keyframes, count: how many there are, and how many landmarks the frame sees.
        inputs: names, those of `FrameViews` among them.
    """
    generator = torch.Generator().manual_seed(seed)
    normal = partial(torch.randn, generator=generator, dtype=torch.float64)
    uniform = partial(torch.rand, generator=generator, dtype=torch.float64)
    size = CALIBRATION_SIZE + 6 * (keyframes + 1)
    sigma = torch.cat(
        [torch.tensor([0.3]), torch.zeros(CALIBRATION_SIZE - 1), torch.full((size - CALIBRATION_SIZE,), 0.003)]
    )
    factor = torch.diag(sigma.double())
    for k in range(CALIBRATION_SIZE + 6, size):  # a pose is known relative to the one before
        factor[k] += factor[k - 6]
    numbers = torch.arange(keyframes + 1, dtype=torch.float64)[:, None]
    poses = exp_se3(numbers * torch.tensor([0.05, 0.02, 0.2, 0.01, 0.03, 0.01], dtype=torch.float64))
    landmarks = (
        torch.tensor([80.0, 60.0, 4.0]).double() + uniform(count, 3) * torch.tensor([480.0, 360.0, 30.0]).double()
    )
    root = 0.2 * normal(count, LANDMARK_SIZE, LANDMARK_SIZE).tril()
    dependence = torch.nn.functional.pad(0.1 * normal(count, LANDMARK_SIZE, size - 6), (0, 6))
    view_root = 0.3 * normal(count, 3, 3)
    identity = torch.eye(3, dtype=torch.float64)
    values = {
        "intrinsics": torch.tensor([400.0, 410.0, 320.0, 240.0, 80.0], dtype=torch.float64),
        "depth": torch.tensor(5.0, dtype=torch.float64),
        "unscented": torch.tensor(1.0, dtype=torch.float64),
        "anchors": torch.arange(keyframes),
        "views": torch.full((keyframes,), keyframes),
        "pair": torch.arange(count) % keyframes,
        "common": 0.1 * normal(count, 3, 2),
        "covariance": root @ root.mT + 1e-4 * torch.eye(LANDMARK_SIZE, dtype=torch.float64),
        "estimate": torch.nn.functional.pad(landmarks, (0, 3)) + 0.1 * normal(count, LANDMARK_SIZE),
        "dependence": dependence,
        "poses": poses,
        "calibration": torch.nn.functional.pad(0.1 * normal(3), (0, CALIBRATION_SIZE - 3)),
        "factor": factor[:, sigma > 0.0],
    }
    # What is seen from about there: the exact place does not matter, but some views must agree.
    predicted = _predicted(values)
    measurement = predicted + 0.3 * normal(count, 3) + 30.0 * normal(count, 3) * (uniform(count, 1) < 0.2)
    measurement[:: min(count, 4), 2] = float("nan")
    values |= {
        "measurement": measurement,
        "noise": view_root @ view_root.mT + 0.1 * identity,
        "offset": values["factor"] @ (0.3 * normal(values["factor"].shape[1])),
        "spread": values["factor"] @ values["factor"].mT,
        "moved": 0.1 * normal(count, LANDMARK_SIZE),
        "gated": torch.tensor(float(seed % 2), dtype=torch.float64),
        "noise_scale": torch.tensor(1.5 * (seed % 2), dtype=torch.float64),
        "scale": torch.tensor(1.0, dtype=torch.float64),
        "freedom": torch.tensor(2.0, dtype=torch.float64),
        "prior": 0.01 * normal(size, CALIBRATION_SIZE),
    }
    return tuple(values[name] for name in inputs)


def condition_example(seed: int, size: int, columns: int) -> tuple[Tensor, ...]:
    """Inputs of `Condition`: a state of that size, and so many columns of its prior's factor."""
    generator = torch.Generator().manual_seed(seed)
    shapes = ((size, columns), (size, size), (size,), (size, CALIBRATION_SIZE))
    factor, root, vector, common = (torch.randn(*shape, generator=generator, dtype=torch.float64) for shape in shapes)
    return factor, root @ root.mT, vector, common


def _predicted(values: dict[str, Tensor]) -> Tensor:
    """(M, 3) expected views at the prior's mean."""
    frame = FrameViews(*(values[name] for name in FrameViews._fields))
    zero = torch.zeros_like(frame.factor[:, 0])
    with torch.no_grad():
        return frame.linearise(zero, frame.factor @ frame.factor.mT, torch.zeros_like(frame.estimate)).mean

"""A body with a stereo camera among known points: localised, scored and written."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from sigmaslam.errors import InputError
from sigmaslam.files import save_png
from sigmaslam.plot_style import BLUE, GREY, has_matplotlib
from sigmaslam_filters import SO3, Gaussian, degree_of_belief
from sigmaslam_localisation.localisation_page import draw_axes
from sigmaslam_localisation.localise import FilterName, Localisation, localise, make_filter
from sigmaslam_localisation.output import write_run
from sigmaslam_localisation.starry import StereoRecording
from sigmaslam_localisation.steps import DELAYS, Steps
from sigmaslam_localisation.stereo_points import BODY, CONSTANTS, SPACE, StereoBody

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True, eq=False)
class BodyEstimate:
    """Where a body was.

    Attributes:
        name: of the recording.
        seconds: (K + 1,).
        pose: (K + 1, 7) translation in metres and quaternion x, y, z, w of the body in the world.
        covariance: (K + 1, 6, 6) of twists in the body's frame, translation before rotation.
        belief: (K + 1,) degree of belief in the position, in metres.
        seen: (K + 1,) points that were seen.
        nis: (K, L) of each point, of four degrees of freedom; NaN for none.
        weight: (K, L) by robust weights.
        scale: (4,) standard deviation of the pixels over the nominal one, at the end.
        delay: seconds by which the gyroscopes follow the body.
        truth: (K + 1, 7), or None.
        smoothed, lagged: the same given what was seen later: all of it, or with a fixed lag; None if not asked for.
    """

    name: str
    seconds: np.ndarray
    pose: np.ndarray
    covariance: np.ndarray
    belief: np.ndarray
    seen: np.ndarray
    nis: np.ndarray
    weight: np.ndarray
    scale: np.ndarray
    delay: float
    truth: np.ndarray | None
    smoothed: "BodyEstimate | None" = None
    lagged: "BodyEstimate | None" = None


def localise_body(
    recording: StereoRecording,
    filter_name: FilterName = "ukf",
    tell: Callable[[str], None] = lambda _: None,
    lag: float | None = None,
) -> tuple[BodyEstimate, BodyEstimate]:
    """The body's poses, in two passes as those of `localise_robots`: delay and constants are the first's.

    With a lag in seconds the second pass is smoothed as well.

    Raises:
        InputError: there is no true pose to start from.
    """
    if recording.truth is None:
        raise InputError(f"{recording.name}: has no true pose to start from: add theta_vk_i and r_i_vk_i")
    body, bayes = StereoBody(recording.rig), make_filter(filter_name, SPACE)
    prior = body.prior(torch.from_numpy(recording.truth[:1]))
    steps = recording.steps(DELAYS)
    repeated = Gaussian(prior.mean.repeat(len(DELAYS), 1), prior.covariance.repeat(len(DELAYS), 1, 1))
    first = localise(bayes, body, repeated, steps, tell=lambda done: tell(f"first pass: {done:.0%}"))
    best = int(first.log_likelihood.argmax())
    delay = DELAYS[best]
    at_first = _estimate(recording, body, delay, steps, first, best)
    mean, covariance_of_prior = prior.mean.clone(), prior.covariance.clone()
    # A point has one number more than its tangent.
    mean[0, CONSTANTS.start + 1 :] = first.final.mean[best, CONSTANTS.start + 1 :]
    covariance_of_prior[0, CONSTANTS, CONSTANTS] = first.final.covariance[best, CONSTANTS, CONSTANTS]
    prior = Gaussian(mean, covariance_of_prior)
    scale, steps = torch.from_numpy(first.scale[-1, best : best + 1]), recording.steps([delay])
    result = localise(
        bayes, body, prior, steps, scale, lambda done: tell(f"second pass: {done:.0%}"), smoothing=lag is not None
    )
    estimate = _estimate(recording, body, delay, steps, result, 0)
    if lag is not None:
        tell("smoothing")
        (smoother,) = result.smoothers
        whole, lagged = (
            _with_poses(estimate, body, *smoothed)
            for smoothed in (smoother.smooth(), smoother.smooth(estimate.seconds, lag))
        )
        estimate = replace(estimate, smoothed=whole, lagged=lagged)
    return at_first, estimate


def _with_poses(estimate: BodyEstimate, body: StereoBody, mean: np.ndarray, covariance: np.ndarray) -> BodyEstimate:
    """The estimate with the poses of states (K + 1, 17), whose covariance (K + 1, 16, 16) knows no mounting."""
    spread = covariance[:, :6, :6] + np.diag(np.repeat(np.square(body.noise.mounting), 3))
    belief = degree_of_belief(torch.from_numpy(np.ascontiguousarray(spread[:, :3, :3]))).numpy()
    return replace(estimate, pose=mean[:, :7], covariance=spread, belief=belief)


def _estimate(
    recording: StereoRecording, body: StereoBody, delay: float, steps: Steps, result: Localisation, index: int
) -> BodyEstimate:
    """Of the member of the batch with that index."""
    nis, nothing = result.nis[:, index], np.empty(0)
    estimate = BodyEstimate(
        recording.name,
        steps.seconds[:, index],
        nothing,
        nothing,
        nothing,
        np.append(0, np.isfinite(nis).sum(axis=1)),
        nis,
        result.weight[:, index],
        np.sqrt(result.scale[-1, index]),
        delay,
        recording.truth,
    )
    return _with_poses(estimate, body, result.mean[:, index], result.covariance[:, index])


def score_body(estimate: BodyEstimate) -> dict[str, float]:
    """Root mean square errors over all steps, NEES of six degrees of freedom, NIS of the points."""
    there = np.isfinite(estimate.nis)
    scores = {
        "delay": estimate.delay,
        "points_seen": int(there.sum()),
        "nis_per_dof": float(estimate.nis[there].mean() / 4),
        "nis_per_dof_median": float(np.median(estimate.nis[there]) / 4),
        "outliers": float(np.mean(estimate.weight[there] < 0.5)),
        **{f"noise_scale_{index}": float(value) for index, value in enumerate(estimate.scale)},
    }
    if estimate.truth is None:
        return scores
    found, true = torch.from_numpy(estimate.pose), torch.from_numpy(estimate.truth)
    twist = BODY.local(found, true).numpy()
    rotation = SO3().local(found[:, 3:], true[:, 3:]).numpy()
    nees = np.einsum("ni,ni->n", twist, np.linalg.solve(estimate.covariance, twist[..., None])[..., 0])
    return {
        "position_rmse": float(np.sqrt(np.mean(np.sum((estimate.pose - estimate.truth)[:, :3] ** 2, axis=1)))),
        "rotation_rmse": float(np.sqrt(np.mean(np.sum(rotation**2, axis=1)))),
        "nees_median": float(np.median(nees)),
        "nees_mean": float(np.mean(nees)),
        **scores,
    }


def write_body(
    folder: Path, recording: StereoRecording, first: BodyEstimate, estimate: BodyEstimate, settings: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Write all files of a body into a folder that is there; returns as `write_run`."""
    figures = _draw(recording, estimate, folder / "map.png")
    return write_run(folder, recording.name, settings, [first], [estimate], _trajectory, score_body, figures)


def _trajectory(estimates: Sequence[BodyEstimate]) -> Iterable[str]:
    """Poses, the upper triangle of the covariance row by row, belief and count of points."""
    rows, columns = np.triu_indices(6)
    cells = ",".join(f"cov_{row}{column}" for row, column in zip(rows, columns, strict=True))
    yield f"robot,time,x,y,z,qx,qy,qz,qw,{cells},belief,sightings"
    for estimate in estimates:
        table = np.column_stack([estimate.pose, estimate.covariance[:, rows, columns], estimate.belief])
        for second, numbers, seen in zip(estimate.seconds, table, estimate.seen, strict=True):
            yield f"{estimate.name},{second:.6f},{','.join(f'{number:.9g}' for number in numbers)},{seen}"


def _draw(recording: StereoRecording, estimate: BodyEstimate, png: Path) -> "list[tuple[str, str, Figure]]":
    if not has_matplotlib():
        return []
    figure, axes = draw_axes(6, "x [m]", "y [m]")
    if estimate.truth is not None:
        axes.plot(*estimate.truth[:, :2].T, color=GREY, lw=0.6)
    axes.plot(*estimate.pose[:, :2].T, color=BLUE, lw=1.0)
    axes.plot(*recording.points[:, :2].T, "x", ms=6, color=GREY)
    axes.set_aspect("equal", adjustable="datalim")
    save_png(figure, png)
    drawn = [("Map", "From above; points are crosses, the truth is thin and grey.", figure)]
    figure, axes = draw_axes(2.6, "time [s]", "sigma [m]")
    deviation = np.sqrt(np.diagonal(estimate.covariance, axis1=1, axis2=2))
    seconds = estimate.seconds - estimate.seconds[0]
    for index, label in enumerate(("x", "y", "z")):
        axes.plot(seconds, deviation[:, index], lw=1.0, label=label)
    axes.set_yscale("log")
    axes.legend(fontsize=8)
    drawn.append(("Claimed uncertainty", "Standard deviations along the axes of the body.", figure))
    return drawn

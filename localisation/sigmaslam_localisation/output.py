"""Files that a localisation leaves: trajectories, innovations, a summary, a map and a report."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from sigmaslam.files import atomic_path, atomic_write_json
from sigmaslam_localisation.localisation_page import draw_robots, write_page
from sigmaslam_localisation.recording import Recording
from sigmaslam_localisation.robots import RobotEstimate
from sigmaslam_localisation.scores import innovation_statistics, score, score_map

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sigmaslam_localisation.body import BodyEstimate

ERRORS = ("position_rmse", "heading_rmse", "rotation_rmse", "nees_median", "nees_mean")
"""Scores that need a truth."""
Estimate = TypeVar("Estimate", RobotEstimate, "BodyEstimate")


def write_run(
    folder: Path,
    name: str,
    settings: Mapping[str, Any],
    first: Sequence[Estimate],
    second: Sequence[Estimate],
    trajectory: Callable[[Sequence[Estimate]], Iterable[str]],
    score: Callable[[Estimate], dict[str, Any]],
    figures: Sequence[tuple[str, str, "Figure"]],
) -> dict[str, dict[str, Any]]:
    """Write the trajectories of two passes and of smoothers, run.json and report.html into a folder that is there.

    Returns:
        The summary of the second pass by name, as in run.json, with the errors of the smoothers.
    """
    write_lines(folder / "trajectory.csv", trajectory(second))
    write_lines(folder / "trajectory_first_pass.csv", trajectory(first))
    summaries, at_first = ({each.name: score(each) for each in estimates} for estimates in (second, first))
    later: dict[str, dict[str, dict[str, Any]]] = {}
    for kind in ("smoothed", "lagged"):
        estimates = [found for each in second if (found := getattr(each, kind)) is not None]
        if estimates:
            write_lines(folder / f"trajectory_{kind}.csv", trajectory(estimates))
            scores = {each.name: score(each) for each in estimates}
            later[kind] = {each: {k: found[k] for k in ERRORS if k in found} for each, found in scores.items()}
    run = {**settings, "robots": summaries, "first_pass": at_first, **later}
    atomic_write_json(folder / "run.json", run)
    for kind, errors in later.items():
        for each, found in errors.items():
            summaries[each] |= {f"{kind}_{label}": value for label, value in found.items()}
    write_page(folder / "report.html", name, summaries, figures)
    return summaries


def write_robots(
    folder: Path,
    name: str,
    first: Sequence[RobotEstimate],
    second: Sequence[RobotEstimate],
    recordings: Sequence[Recording],
    settings: Mapping[str, Any],
) -> dict[str, dict[str, Any]]:
    """Write all files of robots into a folder that is there; returns as `write_run`."""
    write_lines(folder / "innovations.csv", _innovations(second))
    if any(estimate.map is not None for estimate in second):
        names = max((each.landmark_names for each in recordings), key=len)
        write_lines(folder / "landmarks.csv", _maps(second, names))
    figures = draw_robots(second, recordings[0].landmarks, folder / "map.png")
    return write_run(folder, name, settings, first, second, _trajectory, summarise, figures)


def summarise(estimate: RobotEstimate) -> dict[str, Any]:
    """Scores if there is a truth, statistics of the innovations, and what was found of the robot."""
    constants = {
        f"{name.replace(' ', '_')}{suffix}": value
        for name, pair in estimate.constants.items()
        for suffix, value in zip(("", "_sigma"), pair, strict=True)
    }
    scale = {f"noise_scale_{index}": float(value) for index, value in enumerate(estimate.scale)}
    of_map = {} if estimate.map is None else score_map(estimate.map)
    return {
        **score(estimate),
        **of_map,
        **innovation_statistics(estimate),
        "delay": estimate.delay,
        **scale,
        **constants,
    }


def _trajectory(estimates: Sequence[RobotEstimate]) -> Iterable[str]:
    """Poses in metres and radians, the covariance of x, y and heading in the world, and the belief in the position."""
    rows, columns = np.triu_indices(3)
    yield "robot,time,x,y,heading,cov_xx,cov_xy,cov_xh,cov_yy,cov_yh,cov_hh,belief,sightings"
    for estimate in estimates:
        heading = np.arctan2(np.sin(estimate.pose[:, 2]), np.cos(estimate.pose[:, 2]))
        table = np.column_stack([estimate.pose[:, :2], heading, estimate.covariance[:, rows, columns], estimate.belief])
        count = (estimate.seen >= 0).sum(axis=1)
        for second, numbers, seen in zip(estimate.seconds, table, count, strict=True):
            yield f"{estimate.name},{second:.6f},{','.join(f'{number:.9g}' for number in numbers)},{seen}"


def _innovations(estimates: Sequence[RobotEstimate]) -> Iterable[str]:
    """Each sighting: the index of the landmark, the innovation's components, its NIS and its robust weight."""
    components = estimates[0].innovation.shape[-1]
    yield f"robot,time,landmark,{','.join(f'innovation_{i}' for i in range(components))},nis,weight"
    for estimate in estimates:
        for row, slot in zip(*np.nonzero(np.isfinite(estimate.nis)), strict=True):
            numbers = [*estimate.innovation[row, slot], estimate.nis[row, slot], estimate.weight[row, slot]]
            cells = ",".join(f"{number:.6g}" for number in numbers)
            yield f"{estimate.name},{estimate.seconds[row]:.6f},{estimate.seen[row, slot]},{cells}"


def _maps(estimates: Sequence[RobotEstimate], names: Sequence[str]) -> Iterable[str]:
    """Places that the robots found, metres, and their covariances."""
    yield "robot,landmark,x,y,cov_xx,cov_xy,cov_yy"
    for estimate in estimates:
        found = estimate.map
        assert found is not None
        for row, (landmark, (x, y)) in enumerate(zip(found.landmark, found.place, strict=True)):
            (xx, xy), (_, yy) = found.covariance[2 * row : 2 * row + 2, 2 * row : 2 * row + 2]
            yield f"{estimate.name},{names[landmark]},{','.join(f'{each:.9g}' for each in (x, y, xx, xy, yy))}"


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write lines of text, whole or not at all."""
    with atomic_path(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(f"{line}\n" for line in lines)

"""Five robots among known landmarks (MRCLAM), all as one batch; what gates and robust weights are worth.

Run it with `python examples/filters/localise_robot.py MRCLAM_Dataset6`. The noise is a first guess.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from sigmaslam_filters import Diagonal, Gaussian, UnscentedKalmanFilter, several, wrap_angle
from sigmaslam_filters.systems import differential_drive, range_and_bearing

STEP = 0.1  # seconds; commands are averaged over a step, sightings are taken at its end


def read(folder: Path, robot: int, landmarks: dict[float, int], duration: float) -> tuple[np.ndarray, ...]:
    """Controls (T, 2), sightings (T, L, 2), NaN where a landmark is not seen, and the true poses (T, 3)."""
    odometry, seen, truth = (
        np.loadtxt(folder / f"Robot{robot}_{name}.dat.gz") for name in ("Odometry", "Measurement", "Groundtruth")
    )
    seconds = odometry[0, 0] + STEP * np.arange(duration / STEP)
    path = np.cumsum(odometry[:-1, 1:] * np.diff(odometry[:, :1], axis=0), axis=0)
    moved = np.stack([np.interp(seconds, odometry[1:, 0], column) for column in path.T], axis=1)
    sightings = np.full((len(seconds), len(landmarks), 2), np.nan)
    for time, barcode, *sighting in seen:
        k = np.searchsorted(seconds, time)
        if barcode in landmarks and k < len(seconds):
            sightings[k, landmarks[barcode]] = sighting
    truth[:, 3] = np.unwrap(truth[:, 3])
    poses = np.stack([np.interp(seconds, truth[:, 0], column) for column in truth[:, 1:].T], axis=1)
    before = np.searchsorted(truth[:, 0], seconds).clip(1, len(truth) - 1)
    poses[(truth[before, 0] - truth[before - 1, 0] > 0.2) | (seconds > truth[-1, 0])] = np.nan
    return np.diff(moved, axis=0, append=moved[-1:]) / STEP, sightings, poses


def localise(folder: Path, duration: float, **options: Any) -> tuple[np.ndarray, ...]:
    """RMSE of each robot's position, metres, and heading, radians."""
    barcode_of = dict(np.loadtxt(folder / "Barcodes.dat"))
    subjects, *places = np.loadtxt(folder / "Landmark_Groundtruth.dat").T[:3]
    landmarks = {barcode_of[subject]: k for k, subject in enumerate(subjects)}
    robots = [read(folder, robot, landmarks, duration) for robot in range(1, 6)]
    controls, seen, poses = (torch.tensor(np.stack(part, axis=1)) for part in zip(*robots, strict=True))
    motion = differential_drive(Diagonal(torch.tensor([0.05, 0.15], dtype=torch.double) ** 2 / STEP))
    see = several(range_and_bearing(Diagonal(torch.tensor([0.15, 0.02], dtype=torch.double) ** 2)), len(landmarks))
    prior = Gaussian(poses[0], torch.diag(torch.tensor([0.1, 0.1, 0.1], dtype=torch.double) ** 2))
    where = torch.tensor(np.stack(places, axis=1)).expand(len(poses), -1, -1)
    inputs = [controls[:-1], torch.full((len(poses) - 1, 1), STEP, dtype=torch.double)]
    track = UnscentedKalmanFilter(iterations=1).filter(prior, motion, see, seen.flatten(-2), inputs, [where], **options)
    error = track.filtered.mean - poses
    error = torch.stack([error[..., :2].norm(dim=-1), wrap_angle(error[..., 2])])
    return tuple(error.square().nanmean(dim=1).sqrt().numpy())


if __name__ == "__main__":
    for options in ({}, {"gate": 0.999}, {"robust": "huber"}, {"robust": "student_t"}):
        position, heading = localise(Path(sys.argv[1]), 900.0, **options)
        print(options, "position", position.round(3), "m, heading", heading.round(3), "rad")

"""Errors of an estimate against the truth, and whether its covariance fits them."""

import numpy as np

from sigmaslam_localisation.robots import LandmarkMap, RobotEstimate

RATE = 10.0
"""The latest pose is compared so often a second, with the truth at its own time."""


def score(estimate: RobotEstimate) -> dict[str, float]:
    """Root mean square errors in metres and radians, and NEES of three degrees of freedom; empty without a truth."""
    if estimate.truth is None:
        return {}
    seconds = np.arange(estimate.seconds[0], estimate.seconds[-1], 1 / RATE)
    latest = np.searchsorted(estimate.seconds, seconds, side="right") - 1
    true = estimate.truth.at(estimate.seconds[latest])
    usable = np.isfinite(true).all(axis=1)
    if not usable.any():
        return {}
    error = (true - estimate.pose[latest])[usable]
    error[:, 2] = np.arctan2(np.sin(error[:, 2]), np.cos(error[:, 2]))
    covariance = estimate.covariance[latest][usable]
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    return {
        "position_rmse": float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))),
        "heading_rmse": float(np.sqrt(np.mean(error[:, 2] ** 2))),
        "nees_median": float(np.median(nees)),
        "nees_mean": float(np.mean(nees)),
    }


def score_map(landmarks: LandmarkMap) -> dict[str, float]:
    """Root mean square errors of landmarks, metres, and their NEES; empty without a truth.

    `landmark_rmse` is in the frame of the first pose, `landmark_rmse_aligned` after the rotation and translation that
    fit best. `landmark_nees` is the mean over landmarks, of two degrees of freedom; `map_nees_per_dof` is of all at
    once, with their correlations.
    """
    there = np.isfinite(landmarks.true).all(axis=1)
    if not there.any():
        return {}
    rows = there.repeat(2)
    place, true, covariance = landmarks.place[there], landmarks.true[there], landmarks.covariance[np.ix_(rows, rows)]
    error = true - place
    blocks = covariance.reshape(len(place), 2, len(place), 2)[np.arange(len(place)), :, np.arange(len(place))]
    nees = np.einsum("ni,ni->n", error, np.linalg.solve(blocks, error[..., None])[..., 0])
    flat = error.ravel()
    # As complex numbers, a rotation is a factor of modulus one.
    a, b = ((each - each.mean(axis=0)) @ [1.0, 1.0j] for each in (place, true))
    turn = np.exp(1j * np.angle(np.sum(b * a.conj())))
    return {
        "landmarks": len(place),
        "landmark_rmse": float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        "landmark_rmse_aligned": float(np.sqrt(np.mean(np.abs(b - turn * a) ** 2))),
        "landmark_nees": float(nees.mean()),
        "map_nees_per_dof": float(flat @ np.linalg.solve(covariance, flat) / len(flat)),
    }


def innovation_statistics(estimate: RobotEstimate) -> dict[str, float]:
    """Count of sightings, mean NIS for each degree of freedom, share of outliers, and correlation of innovations.

    The correlation is of the first component of a landmark's innovations with the one before, where that is less than a
    second ago: of white innovations it is zero.
    """
    there = np.isfinite(estimate.nis)
    count, components = int(there.sum()), estimate.innovation.shape[-1]
    if not count:
        return {"sightings": 0}
    row, slot = np.nonzero(there)
    landmark, value = estimate.seen[row, slot], estimate.innovation[row, slot, 0]
    order = np.argsort(landmark, kind="stable")
    same = (np.diff(landmark[order]) == 0) & (np.diff(estimate.seconds[row][order]) < 1.0)
    before, after = value[order][:-1][same], value[order][1:][same]
    power = np.sqrt(np.sum(before**2) * np.sum(after**2))
    return {
        "sightings": count,
        "nis_per_dof": float(estimate.nis[there].mean() / components),
        "nis_per_dof_median": float(np.median(estimate.nis[there]) / components),
        "outliers": float(np.mean(estimate.weight[there] < 0.5)),
        "correlation": float(np.sum(before * after) / power) if power > 0 else float("nan"),
    }

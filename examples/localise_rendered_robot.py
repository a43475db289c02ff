"""A robot with four wheels and a stereo camera in a rendered room: localised among landmarks at known places.

    sigmaslam train render room --motion planar --frames 160 --width 320 --height 240 --seed 3 --out room
    python examples/localise_rendered_robot.py room

Once a second an image is a survey: its keypoints are landmarks, whose places come from the render's exact depth and
pose. In between, four times a second, they are matched in both images of a pair, `sigmaslam images match`; (9.34) makes
of that where they stand before the robot, (9.35) how exactly, and the unscented filter of (9.43)-(9.45) where the robot
is. Wheel odometry is simulated: the true motion, with errors that are drawn from `RobotNoise`.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.ndimage import map_coordinates

from sigmaslam import match_images
from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam.geometry.uncertainty import propagate
from sigmaslam_filters import SE2, BlockDiagonal, Gaussian, UnscentedKalmanFilter, several
from sigmaslam_localisation.sighting_noise import repetition
from sigmaslam_localisation.wheeled_robot import SPACE, WheeledRobot

SURVEY, STEP = 20, 5  # frames from one survey to the next, and from one update to the next
FLATTEST = 0.05  # relative change of depth around a keypoint, above which it is at an edge and no landmark
NEAREST = 0.1  # metres; what is expected nearer or behind was matched wrongly
# Correlation of the errors of two landmarks of a view, on a render of seed 3: n of them tell as much as
# n / (1 + (n - 1) SHARED) that err apart, and each stands for its share.
SHARED = 0.05
ROWS = 3.0  # sigmas that both rows of a landmark may differ by


@dataclass(frozen=True, slots=True)
class Render:
    """A folder of `sigmaslam train render`.

    Attributes:
        folder: of the files.
        camera: the rectified pair.
        seconds: (K,) of the frames.
        poses: (K, 3) true x, y, heading, from the first pose.
        T_world_camera: (K, 4, 4) true poses of the left camera in the first.
    """

    folder: Path
    camera: RectifiedStereo
    seconds: np.ndarray
    poses: np.ndarray
    T_world_camera: np.ndarray

    @classmethod
    def of(cls, folder: Path) -> Render:
        """Reads calibration, times and true poses."""
        lines = (folder / "calib.txt").read_text().splitlines()
        left, right = (np.array(line.split()[1:], float).reshape(3, 4) for line in lines[:2])
        camera = RectifiedStereo(left[0, 0], left[1, 1], left[0, 2], left[1, 2], -right[0, 3] / left[0, 0], 0, 0)
        T = np.tile(np.eye(4), (len(np.loadtxt(folder / "poses.txt")), 1, 1))
        T[:, :3] = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
        # The camera looks along z with x to the right: the robot's x is ahead, its y to the left.
        poses = np.column_stack([on_floor(T[:, :3, 3]), np.unwrap(np.arctan2(-T[:, 0, 2], T[:, 2, 2]))])
        return cls(folder, camera, np.loadtxt(folder / "times.txt"), poses, T)

    def image(self, eye: int, frame: int) -> np.ndarray:
        """(H, W) uint8."""
        return cv2.imread(str(self.folder / f"image_{eye}" / f"{frame:06d}.png"), cv2.IMREAD_GRAYSCALE)

    def places(self, frame: int, keypoints: np.ndarray) -> np.ndarray:
        """Places (M, 2) on the floor plan of keypoints (M, 2) of a left image; NaN at edges."""
        depth = np.load(self.folder / "truth" / f"{frame:06d}.npz")["depth"]
        u, v = keypoints.T.astype(float)
        inverse = map_coordinates(1.0 / depth, [v, u], order=1, mode="nearest")
        near, far = (
            map_coordinates(method(depth, np.ones((5, 5), np.uint8)), [v, u], order=0, mode="nearest")
            for method in (cv2.erode, cv2.dilate)
        )
        points = self.camera.rays(keypoints.astype(float)) / inverse[:, None]
        T = self.T_world_camera[frame]
        places = on_floor(points @ T[:3, :3].T + T[:3, 3])
        places[~(far < (1.0 + FLATTEST) * near)] = np.nan
        return places


def on_floor(points: np.ndarray) -> np.ndarray:
    """Ahead and to the left (..., 2) of points (..., 3) with x to the right, y down, z ahead."""
    return np.stack([points[..., 2], -points[..., 0]], axis=-1)


def sight(render: Render, survey: int, frame: int) -> tuple[np.ndarray, ...]:
    """Landmarks of a survey, seen again: indices (M,), known places (M, 2), (u, v, disparity) with covariances."""
    surveyed = render.image(0, survey)
    left, right = (match_images(surveyed, render.image(eye, frame)) for eye in (0, 1))
    _, i, j = np.intersect1d(left.index0, right.index0, return_indices=True)
    left, right = left.select(i), right.select(j)
    places = render.places(survey, left.keypoints0)
    (u, v), (u_right, v_right) = left.keypoints1.T.astype(float), right.keypoints1.T.astype(float)
    sigma = np.sqrt(left.covariance[:, 1, 1] + right.covariance[:, 1, 1])
    good = np.isfinite(places).all(axis=1) & (np.abs(v - v_right) < ROWS * sigma) & (u > u_right)
    # Columns of the left and the right image are matched apart from each other; the left one is also in the disparity.
    covariance = np.zeros((len(u), 3, 3))
    covariance[:, :2, :2] = left.covariance
    covariance[:, 2, :2], covariance[:, :2, 2] = left.covariance[:, 0], left.covariance[:, :, 0]
    covariance[:, 2, 2] = left.covariance[:, 0, 0] + right.covariance[:, 0, 0]
    return left.index0[good], places[good], np.column_stack([u, v, u - u_right])[good], covariance[good]


def reproject(
    camera: RectifiedStereo, measured: np.ndarray, covariance: np.ndarray, expected: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ahead and to the left (M, 2), (9.34), and covariances (M, 2, 2), (9.35), of pixels (M, 3) and theirs (M, 3, 3).

    Derivatives are taken where a landmark is expected (M, 2), not where it was measured: a disparity that came out too
    large makes a depth that is too small and looks too exact, and all depths together would be too small. What second
    derivatives add to the mean, (9.36), is taken off.
    """
    ahead, left = expected.T
    u, disparity = camera.cx - camera.fx * left / ahead, camera.focal_baseline / ahead
    there = np.column_stack([u, measured[:, 1], disparity])

    def place(uvd: np.ndarray) -> np.ndarray:
        return on_floor(camera.triangulate(uvd))

    mean, _ = propagate(place, there, covariance, order=2)
    return place(measured) - (mean - place(there)), propagate(place, there, covariance)[1]


def odometry(render: Render, frames: np.ndarray, robot: WheeledRobot, rng: np.random.Generator) -> np.ndarray:
    """Metres driven and radians turned (K - 1, 2) between frames, as wheels with errors measure them."""
    steps = np.diff(render.poses, axis=0)
    driven = np.add.reduceat(np.hypot(steps[:, 0], steps[:, 1]), frames[:-1])[: len(frames) - 1]
    true, duration = np.column_stack([driven, np.diff(render.poses[frames, 2])]), np.diff(render.seconds[frames])
    scale, offset = (rng.normal(0.0, robot.noise.constants[k : k + 2]) for k in (0, 2))
    rates = np.array([robot.noise.drive, robot.noise.turn])
    spread = np.sqrt(rates[:, 0] ** 2 * duration[:, None] + rates[:, 1] ** 2 * np.abs(true))
    return (true - offset * duration[:, None] + spread * rng.normal(size=true.shape)) / (1.0 + scale)


def localise(folder: Path, seed: int = 0) -> dict[str, float]:
    """Errors and consistency of a robot in a rendered room; the seed is that of its wheels."""
    render, robot, bayes = Render.of(folder), WheeledRobot("cartesian", 0.0), UnscentedKalmanFilter(SPACE)
    count = len(render.seconds)
    # The first pose is known; an image is either a survey or one to localise with.
    frames = np.array([0, *(k for k in range(STEP, count, STEP) if k % SURVEY)])
    surveys = np.arange(0, count, SURVEY)
    paths = torch.from_numpy(odometry(render, frames, robot, np.random.default_rng(seed)))
    belief = robot.prior(torch.zeros(3, dtype=torch.float64))
    last: dict[tuple[int, int], float] = {}
    beliefs, number = [belief], 0
    for k, frame in enumerate(frames[1:]):
        seconds = render.seconds[frame]
        duration = torch.tensor(seconds - render.seconds[frames[k]])
        belief = bayes.predict(belief, robot.motion(paths[k], duration), paths[k], duration[None]).belief
        off = render.poses[surveys] - belief.mean[:3].numpy()
        survey = int(surveys[np.argmin(np.sum(off**2, axis=1))])
        landmark, places, measured, pixels = sight(render, survey, int(frame))
        expected = robot.measurement().function(belief.mean, torch.from_numpy(places)).numpy()
        ahead = expected[:, 0] > NEAREST
        landmark, places = landmark[ahead], places[ahead]
        if len(landmark):
            seen, spread = reproject(render.camera, measured[ahead], pixels[ahead], expected[ahead])
            names = [(survey, int(index)) for index in landmark]
            since = torch.tensor([seconds - last.get(name, -np.inf) for name in names], dtype=torch.float64)
            last.update(dict.fromkeys(names, float(seconds)))
            growth = repetition(since) * (1.0 + (len(names) - 1) * SHARED)
            noise = BlockDiagonal(torch.from_numpy(spread) * growth[:, None, None])
            see = replace(several(robot.measurement(), len(names)), noise=noise)
            value = torch.from_numpy(seen).flatten()
            belief = bayes.update(belief, see, value, torch.from_numpy(places), robust="student_t").belief
            number += len(names)
        beliefs.append(belief)
    return scored(beliefs, render.poses[frames]) | {"sightings": number}


def scored(beliefs: list[Gaussian], truth: np.ndarray) -> dict[str, float]:
    """Root mean square errors and the mean NEES, of three degrees of freedom, after the start."""
    found = torch.stack([belief.mean[:3] for belief in beliefs[1:]])
    covariance = torch.stack([belief.covariance[:3, :3] for belief in beliefs[1:]])
    twist = SE2("right").local(found, torch.from_numpy(truth[1:]))
    nees = (twist * torch.linalg.solve(covariance, twist)).sum(dim=-1)
    position = np.hypot(*(found.numpy() - truth[1:])[:, :2].T)
    return {
        "position_rmse": float(np.sqrt(np.mean(position**2))),
        "heading_rmse": float(twist[:, 2].square().mean().sqrt()),
        "nees_mean": float(nees.mean()),
        "nees_median": float(nees.median()),
    }


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    for name in sys.argv[1:]:
        scores = localise(Path(name))
        print(name, ", ".join(f"{label} {value:.3g}" for label, value in scores.items()))

"""Run folders as `track` writes them, without tracking."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from sigmaslam.estimation.landmark_table import LandmarkViews
from sigmaslam.geometry.se3 import rotation_exp
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.live.frame_sink import TrackedFrame
from sigmaslam.readers.trajectory_files import write_tum
from sigmaslam.run_record.frame_pictures import PICTURES_NAME, PictureRecorder
from sigmaslam.slam.estimate import CalibrationEstimate, Estimate
from sigmaslam.slam.guided_matching import GuidedMatches
from sigmaslam.slam.mapping import KeyframeTracks
from sigmaslam.slam.matched_frame import MatchedFrame

STAGES = ("read", "features", "match", "filter", "map")
HEADER = (
    "timestamp,status,matches,inliers,nis,dof,belief,disparity_offset,disparity_offset_sigma,keyframe,loop,"
    "ms_read,ms_features,ms_match,ms_filter,ms_map"
)
START, INTERVAL = 1403715273.26, 0.1


def make_run(folder: Path, count: int = 200, points: int = 20000, pictures: bool = False) -> None:
    """A run with lost, relocalised and skipped frames, keyframes and a loop."""
    generator = np.random.default_rng(0)
    timestamps = START + INTERVAL * np.arange(count)
    angle = np.linspace(0, 5, count)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = rotation_exp(angle[:, None] * np.array([0.0, 1.0, 0.0]))
    poses[:, :3, 3] = 40 * np.column_stack([np.sin(angle), 0.02 * angle, 1 - np.cos(angle)])
    status = np.array(["tracking"] * count, dtype="<U12")
    status[0], status[count // 2 : count // 2 + 5], status[count // 2 + 5] = "starting", "lost", "relocalised"
    status[count // 4] = "skipped"
    rows, recorder = [HEADER], PictureRecorder(count)
    for k in range(count):
        if status[k] == "skipped":
            rows.append(f"{timestamps[k]:.9f},skipped" + "," * (HEADER.count(",") - 1))
            continue
        dof = int(generator.integers(200, 400))
        nis = generator.chisquare(dof)
        numbers = [dof, dof // 2, nis, dof, 1 - 0.1 * generator.random()]
        numbers += [-0.3 * (1 - np.exp(-k / 30)), 0.2 / (1 + k / 10)]
        loop = f"{timestamps[1]:.9f}" if k == count - 1 else ""
        milliseconds = generator.gamma(9, (0.3, 3, 1.2, 0.6, 0.5))
        figures = [*(f"{number:.5g}" for number in numbers), str(int(k % 10 == 0)), loop]
        figures += [f"{number:.5g}" for number in milliseconds]
        rows.append(f"{timestamps[k]:.9f},{status[k]}," + ",".join(figures))
        if pictures:
            lost = status[k] == "lost"
            recorder.add(
                some_estimate(timestamps[k], status[k], 0.0 if lost else nis, 0 if lost else dof),
                some_frame(generator, 0 if lost else 30),
            )
    folder.mkdir(exist_ok=True)
    (folder / "frames.csv").write_text("\n".join(rows) + "\n")
    if pictures:
        recorder.write(folder / PICTURES_NAME)
    kept = status != "skipped"
    write_tum(folder / "trajectory.tum", Trajectory(timestamps[kept], poses[kept]))
    root = generator.normal(size=(kept.sum(), 6, 6)) * np.repeat([0.02, 0.001], 3)[:, None]
    np.save(folder / "covariance.npy", root @ root.transpose(0, 2, 1))
    cloud = poses[generator.integers(0, count, points), :3, 3] + generator.normal(0, 8, (points, 3))
    np.savez(
        folder / "map.npz",
        points=cloud,
        covariances=np.tile(np.eye(3), (points, 1, 1)),
        observations=np.ones(points, dtype=np.int64),
        intensity=generator.integers(0, 256, points).astype(np.float32),
    )
    summary = {"calibration_verdict": "disparity is 0.30 px <too small>; depth reads 1 % long", "failure": None}
    entries = {
        "versions": {"sigmaslam": "0.1.0"},
        "ended": "complete",
        "command": "sigmaslam track x",
        "summary": summary,
    }
    (folder / "run.json").write_text(json.dumps(entries))


def some_estimate(timestamp: float, status: str, nis: float, dof: int, keyframe: bool = False) -> Estimate:
    """An estimate at the origin."""
    return Estimate(
        timestamp=timestamp,
        T_world_camera=np.eye(4),
        covariance=np.eye(6),
        matching_covariance=np.eye(6),
        status=status,
        belief=1.0,
        matches=dof,
        inliers=dof,
        nis=nis,
        dof=dof,
        calibration=CalibrationEstimate(0.0, 0.1),
        tracks=KeyframeTracks(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3))) if keyframe else None,
    )


def some_frame(generator: np.random.Generator, count: int, first: int = 0) -> MatchedFrame:
    """A frame of noise in which the landmarks from `first` on are matched; without any it has no pose."""
    left, right = generator.integers(0, 256, (2, 60, 100)).astype(np.uint8)
    places = np.column_stack([generator.uniform(5, 95, count), generator.uniform(5, 55, count), np.full(count, 3.0)])
    noise, rows = np.tile(0.04 * np.eye(3), (count, 1, 1)), np.arange(count)
    views = LandmarkViews(rows, places, noise, np.zeros((count, 3, 2)))
    matches = GuidedMatches(views, generator.uniform(0.5, 1, count), rows)
    return MatchedFrame(left, right, rows + first, matches, np.arange(count) % 5 != 0 if count else None)


def frame_at(number: int, pose: np.ndarray, status: str = "tracking") -> TrackedFrame:
    """A frame of noise with thirty matches."""
    estimate = replace(some_estimate(0.1 * number, status, 30.0, 30), T_world_camera=pose, covariance=1e-4 * np.eye(6))
    return TrackedFrame(number, estimate, some_frame(np.random.default_rng(number), 30))

"""A robot that drives a known way among landmarks, and the files that it records."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sigmaslam_localisation.recording import PlanarTruth, Recording

LANDMARKS = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0], [2.0, 5.5]])


@dataclass(frozen=True)
class World:
    """What is wrong with the robot.

    Attributes:
        seconds: of the drive.
        kind: of its sightings.
        delay: by which it follows its controls.
        late: seconds by which its sightings are stamped late, beside controls that are odometry.
        drift: direction of driving, seen from the heading.
        speed_scale: metres driven for each that the controls say, less 1.
        left: metres by which the sensor stands to the left of the middle, which nobody says.
        outliers: share of the sightings that are wrong by metres and radians.
        seed: of the noise.
    """

    seconds: float = 60.0
    kind: str = "range-bearing"
    delay: float = 0.0
    late: float = 0.0
    drift: float = 0.0
    speed_scale: float = 0.0
    left: float = 0.0
    outliers: float = 0.0
    seed: int = 0


def drive(world: World) -> Recording:
    """The recording, with its truth."""
    generator = np.random.default_rng(world.seed)
    step = 0.02
    times = np.arange(0.0, world.seconds, step)
    controls = np.column_stack([0.3 + 0.1 * np.sin(0.5 * times), 0.2 + 0.3 * np.sin(0.3 * times)])
    obeyed = np.where(
        times[:, None] >= world.delay, controls[np.searchsorted(times, times - world.delay + 1e-9) - 1], 0
    )
    poses = np.zeros((len(times) + 1, 3))
    poses[0] = [2.0, 1.0, 0.0]
    for k, (speed, turn) in enumerate(obeyed):
        noise = np.array([0.01, 0.02]) * np.sqrt(step) * generator.normal(size=2)
        heading = poses[k, 2] + world.drift + 0.5 * turn * step
        distance = speed * step * (1 + world.speed_scale) + noise[0]
        poses[k + 1] = poses[k] + [distance * np.cos(heading), distance * np.sin(heading), turn * step + noise[1]]
    seen = np.arange(25, len(times), 25)
    seconds, landmark = np.repeat(times[seen], 2), generator.integers(0, len(LANDMARKS), 2 * len(seen))
    landmark[1::2] = (landmark[::2] + 1) % len(LANDMARKS)
    pose = poses[np.repeat(seen, 2)]
    sideways = np.column_stack([-np.sin(pose[:, 2]), np.cos(pose[:, 2])])
    offset = LANDMARKS[landmark] - pose[:, :2] - world.left * sideways
    distance = np.hypot(*offset.T)
    bearing = np.arctan2(offset[:, 1], offset[:, 0]) - pose[:, 2]
    distance = distance * (1 + 0.03 * generator.normal(size=len(distance)))
    bearing = bearing + 0.02 * generator.normal(size=len(bearing))
    wrong = generator.random(len(distance)) < world.outliers
    distance = np.where(wrong, generator.uniform(0.2, 8.0, len(distance)), distance)
    bearing = np.where(wrong, generator.uniform(-3.0, 3.0, len(distance)), bearing)
    bearing = np.arctan2(np.sin(bearing), np.cos(bearing))
    sightings = np.column_stack([distance, bearing])
    if world.kind == "cartesian":
        sightings = np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing)])
    truth = PlanarTruth(np.append(times, world.seconds), poses, 1.0)
    stamps, odometry = seconds + world.late, world.late > 0
    return Recording(
        "robot", times, controls, stamps, landmark, sightings, world.kind, LANDMARKS, truth=truth, odometry=odometry
    )


def started_wrong(recording: Recording, shift: float) -> Recording:
    """The recording, with a first true pose that is wrong; a filter starts there."""
    assert recording.truth is not None
    poses = recording.truth.poses.copy()
    poses[0, :2] += shift
    return replace(recording, truth=replace(recording.truth, poses=poses))


def write_csv_folder(folder: Path, recording: Recording) -> Path:
    """The files of `--format csv`."""
    folder.mkdir(parents=True, exist_ok=True)
    assert recording.truth is not None

    def write(name: str, header: str, rows: np.ndarray) -> None:
        np.savetxt(folder / name, rows, delimiter=",", header=header, comments="", fmt="%.9g")

    names = np.arange(len(recording.landmarks))
    write("landmarks.csv", "landmark,x,y", np.column_stack([names, recording.landmarks]))
    write("controls.csv", "time,speed,turn_rate", np.column_stack([recording.control_seconds, recording.controls]))
    columns = "range,bearing" if recording.kind == "range-bearing" else "ahead,left"
    sightings = np.column_stack([recording.seconds, recording.landmark, recording.sightings])
    write("sightings.csv", f"time,landmark,{columns}", sightings)
    write("truth.csv", "time,x,y,heading", np.column_stack([recording.truth.seconds, recording.truth.poses]))
    return folder

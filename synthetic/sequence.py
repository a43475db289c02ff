"""Writes a rendered stereo sequence as a KITTI-style folder with exact truth."""

import argparse
import json
import logging
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.errors import InputError, SigmaSlamError
from sigmaslam.synthetic.scene import Pinhole, Scene, render
from sigmaslam.synthetic.sensor import Sensor, expose
from sigmaslam.synthetic.trajectories import room_flight, street_drive
from sigmaslam.synthetic.worlds import room_scene, street_scene

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Preset:
    """A kind of sequence: its stereo camera and its clock.

    Attributes:
        width, height: pixels.
        focal: pixels, at this width.
        baseline: metres.
        fps: frames per second.
    """

    width: int
    height: int
    focal: float
    baseline: float
    fps: float


PRESETS = {
    "room": Preset(400, 304, 300.0, 0.11, 20.0),
    "street": Preset(640, 240, 360.0, 0.54, 10.0),
}
LARGEST_GAIN_DIFFERENCE = 0.06
TOP_STREET_SPEED = 9.0  # metres per second, of `street_drive`
# The smallest files of OpenCV's choices: the images are noisy, so that runs of equal bytes are rare.
PNG_OPTIONS = (
    cv2.IMWRITE_PNG_COMPRESSION,
    9,
    cv2.IMWRITE_PNG_STRATEGY,
    cv2.IMWRITE_PNG_STRATEGY_FILTERED,
)


@dataclass(frozen=True, slots=True)
class Simulation:
    """All that a sequence is made from; the same preset, frames and seed give the same.

    Attributes:
        scene: the world.
        T_world_camera: (frames, 4, 4) poses of the left camera.
        left: the left camera; the right one is the same, `baseline` metres along its x axis.
        baseline: metres.
        fps: frames per second.
    """

    scene: Scene
    T_world_camera: np.ndarray
    left: Pinhole
    baseline: float
    fps: float


def simulate(preset: str, frames: int, seed: int, width: int | None = None, height: int | None = None) -> Simulation:
    """A seeded scene with a path and a stereo camera.

    Args:
        preset: a key of `PRESETS`.
        frames: number of stereo pairs.
        seed: of all randomness.
        width, height: pixels, the preset's unless given; the field of view across stays the same.
    Raises:
        InputError: the preset is unknown, or a number is out of range.
    """
    if preset not in PRESETS:
        raise InputError(f"preset {preset!r} is unknown; choose one of {', '.join(sorted(PRESETS))}")
    if frames < 1:
        raise InputError(f"frames is {frames}; give at least 1")
    if seed < 0:
        raise InputError(f"seed is {seed}; give a number from 0 up")
    chosen = PRESETS[preset]
    width, height = width or chosen.width, height or chosen.height
    if width < 16 or height < 16:
        raise InputError(f"the image size {width}x{height} is too small; give at least 16x16")
    focal = chosen.focal * width / chosen.width
    camera = Pinhole(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    # Separate streams: the path does not depend on how much the scene draws.
    scene_rng, path_rng = (np.random.default_rng([seed, stream]) for stream in (0, 1))
    if preset == "room":
        scene, poses = room_scene(scene_rng), room_flight(path_rng, frames, chosen.fps)
    else:
        driven = frames / chosen.fps * TOP_STREET_SPEED
        scene = street_scene(scene_rng, max(60.0, driven + 40.0))
        poses = street_drive(path_rng, frames, chosen.fps)
    return Simulation(scene, poses, camera, chosen.baseline, chosen.fps)


def write_sequence(
    out: Path,
    preset: str,
    frames: int,
    seed: int,
    disparity_offset: float = 0.0,
    width: int | None = None,
    height: int | None = None,
    sensor: Sensor | None = None,
) -> None:
    """Renders a stereo sequence into a new KITTI-style folder.

    Writes `image_0/%06d.png` (left), `image_1/%06d.png` (right), `calib.txt` (P0, P1), `times.txt` (seconds),
    `poses.txt` (rows of T_first_camera, the left camera's exact pose in its first frame) and `scene.json`.

    Args:
        out: folder to make; must be absent or empty.
        preset: a key of `PRESETS`.
        frames: number of stereo pairs.
        seed: of all randomness.
        disparity_offset: pixels by which the images' disparity u_left - u_right exceeds what the written
            calibration says, as if the right camera were badly calibrated.
        width, height: pixels, the preset's unless given.
        sensor: blur and noise of both cameras; the right one's gain differs by a few per cent.
    Raises:
        InputError: the folder is not empty, the preset is unknown, or a number is out of range.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} exists and is not an empty folder; remove it or choose another --out")
    simulation = simulate(preset, frames, seed, width, height)
    camera = simulation.left
    right_camera = replace(camera, cx=camera.cx - disparity_offset)
    T_left_right = np.eye(4)
    T_left_right[0, 3] = simulation.baseline
    left_sensor = sensor or Sensor()
    difference = np.random.default_rng([seed, 2]).uniform(-1, 1) * LARGEST_GAIN_DIFFERENCE
    right_sensor = replace(left_sensor, gain=left_sensor.gain * (1.0 + difference))

    for eye in ("image_0", "image_1"):
        (out / eye).mkdir(parents=True, exist_ok=True)
    projection = np.concatenate([camera.matrix, np.zeros((3, 1))], axis=1)
    right_projection = projection.copy()
    right_projection[0, 3] = -camera.fx * simulation.baseline
    (out / "calib.txt").write_text(f"P0: {_row(projection)}\nP1: {_row(right_projection)}\n")
    (out / "times.txt").write_text("".join(f"{k / simulation.fps:.6e}\n" for k in range(frames)))
    poses = simulation.T_world_camera
    relative = np.linalg.inv(poses[0]) @ poses
    relative[0] = np.eye(4)
    (out / "poses.txt").write_text("".join(f"{_row(pose[:3])}\n" for pose in relative))
    recipe = {
        "preset": preset,
        "frames": frames,
        "seed": seed,
        "disparity_offset": disparity_offset,
        "fps": simulation.fps,
        "camera": asdict(camera),
        "baseline": simulation.baseline,
        "left_sensor": asdict(left_sensor),
        "right_sensor": asdict(right_sensor),
    }
    if sensor is None:
        recipe["command"] = _command(preset, frames, seed, disparity_offset, width, height)
    (out / "scene.json").write_text(json.dumps(recipe, indent=2) + "\n")

    for k in range(frames):
        views = (
            ("image_0", camera, poses[k], left_sensor),
            ("image_1", right_camera, poses[k] @ T_left_right, right_sensor),
        )
        for stream, (eye, view_camera, T_world_view, view_sensor) in enumerate(views):
            ideal = render(simulation.scene, view_camera, T_world_view).image
            photograph = expose(ideal, view_sensor, np.random.default_rng([seed, 3, k, stream]))
            path = out / eye / f"{k:06d}.png"
            if not cv2.imwrite(str(path), photograph, PNG_OPTIONS):
                raise InputError(f"{path} cannot be written; is the disk full or read-only?")
        logger.info("%s: frame %d of %d", out, k + 1, frames)


def _row(matrix: np.ndarray) -> str:
    return " ".join(f"{value:.12e}" for value in matrix.ravel())


def _command(
    preset: str, frames: int, seed: int, disparity_offset: float, width: int | None, height: int | None
) -> str:
    """The command line that writes the same folder again."""
    words = ["python", "-m", "sigmaslam.synthetic.sequence", preset, "--out", "DIR"]
    words += ["--frames", str(frames), "--seed", str(seed)]
    if disparity_offset:
        words += ["--disparity-offset", repr(disparity_offset)]
    if width:
        words += ["--width", str(width)]
    if height:
        words += ["--height", str(height)]
    return " ".join(words)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line: `python -m sigmaslam.synthetic.sequence PRESET --out DIR --frames N --seed S`."""
    parser = argparse.ArgumentParser(prog="python -m sigmaslam.synthetic.sequence", description=__doc__)
    parser.add_argument("preset", choices=sorted(PRESETS))
    parser.add_argument("--out", type=Path, required=True, help="folder to make; absent or empty")
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--disparity-offset", type=float, default=0.0, help="pixels, published minus true")
    parser.add_argument("--width", type=int)
    parser.add_argument("--height", type=int)
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        write_sequence(
            options.out,
            options.preset,
            options.frames,
            options.seed,
            options.disparity_offset,
            options.width,
            options.height,
        )
    except SigmaSlamError as error:
        logger.error("error: %s", error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

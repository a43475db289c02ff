"""Animations of docs/usage.md: rendered sequences while they are tracked, as `track --video` shows them.

`python -m sigmaslam_benchmarks.tracking.tracking_gallery --out docs/images --work build/gallery`
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.files import atomic_path
from sigmaslam.geometry.camera import StereoCamera
from sigmaslam.live.frame_drawing import FramePainter
from sigmaslam.live.frame_sink import TrackedFrame
from sigmaslam.live.video import frame_rate
from sigmaslam.readers import open_sequence
from sigmaslam.run_record.removal import remove_run
from sigmaslam.runs.request import InputOptions, LiveOptions, OutputOptions, TrackRequest
from sigmaslam.runs.track import track_sequence
from sigmaslam_benchmarks.trial import render
from sigmaslam_synthetic.simulation import Recipe

# Small renders, so that the page is made in minutes. Seeds from 1000 on are for reported figures.
RECIPES = (
    Recipe("street", 48, seed=7, width=768, height=232),
    Recipe("organ", 48, seed=7, width=480, height=384),
)
_WIDTH, _QUALITY = 1000, 60
MAX_BYTES = 2_000_000
"""Of an animation on a page."""


@dataclass
class Animation:
    """A sink that keeps the pictures of a run.

    Attributes:
        name: for messages.
        painter: draws them.
        pictures: (H, W, 3) uint8 each.
        timestamps: of their frames, seconds.
    """

    name: str
    painter: FramePainter
    pictures: list[np.ndarray]
    timestamps: list[float]

    @classmethod
    def of(cls, name: str, camera: StereoCamera) -> Animation:
        """Without pictures yet."""
        return cls(name, FramePainter(camera), [], [])

    def add(self, frame: TrackedFrame) -> None:
        """Draws a frame."""
        self.painter.add(frame)
        self.pictures.append(self.painter.draw())
        self.timestamps.append(frame.result.timestamp)

    def close(self) -> None:
        """All are in memory."""

    def write(self, path: Path) -> None:
        """Writes an animated WebP that plays as fast as the frames came, over and over."""
        scale = _WIDTH / self.pictures[0].shape[1]
        animation = cv2.Animation()
        animation.frames = [
            cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) for picture in self.pictures
        ]
        milliseconds = round(1e3 / frame_rate(np.array(self.timestamps)))
        animation.durations = [milliseconds] * len(self.pictures)
        animation.loop_count = 0
        with atomic_path(path) as temporary:
            cv2.imwriteanimation(str(temporary), animation, [cv2.IMWRITE_WEBP_QUALITY, _QUALITY])


def write_tracking_gallery(out: Path, work: Path, recipes: Sequence[Recipe] = RECIPES) -> list[Path]:
    """Renders and tracks sequences, and writes their animations, `track_<preset>.webp`.

    Args:
        out: folder of the animations.
        work: folder for renders and runs; frames that are there are kept.
        recipes: of the sequences.
    """
    out.mkdir(parents=True, exist_ok=True)
    work.mkdir(parents=True, exist_ok=True)
    written = []
    for recipe in recipes:
        sequence = open_sequence(render(work, recipe, workers=1))
        animation = Animation.of(recipe.preset, sequence.camera)
        run = work / f"run_{recipe.preset}{recipe.seed}"
        remove_run(run)
        track_sequence(TrackRequest(InputOptions(sequence), OutputOptions(run), live=LiveOptions(sinks=[animation])))
        path = out / f"track_{recipe.preset}.webp"
        animation.write(path)
        written.append(path)
    return written


def run_gallery(
    module: str, description: str | None, write: Callable[[Path, Path], list[Path]], arguments: Sequence[str] | None
) -> None:
    """Command line of a gallery: says how large the pictures are that `write(out, work)` has written."""
    parser = argparse.ArgumentParser(prog=f"python -m sigmaslam_benchmarks.tracking.{module}", description=description)
    parser.add_argument("--out", type=Path, required=True, help="folder of the pictures")
    parser.add_argument("--work", type=Path, required=True, help="folder for renders, kept for the next time, and runs")
    given = parser.parse_args(arguments)
    for path in write(given.out, given.work):
        print(f"{path}: {path.stat().st_size / 1e6:.2f} MB")


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    run_gallery("tracking_gallery", __doc__, write_tracking_gallery, arguments)


if __name__ == "__main__":
    main()

"""What a run leaves behind to look at: log.jsonl, TensorBoard's events, sample pictures."""

import json
from pathlib import Path

import cv2
import numpy as np
from torch.utils.tensorboard import SummaryWriter

from sigmaslam.files import atomic_path, atomic_write_text

LOG_NAME = "log.jsonl"
_TENSORBOARD = "tensorboard"
_SAMPLES = "samples"


class Journal:
    """Writes into a run folder; what a stopped run wrote after its checkpoint is taken back.

    Args:
        out: run folder.
        done: steps that are done: 0, or those of the checkpoint that the run goes on from.
    """

    def __init__(self, out: Path, done: int) -> None:
        self._log = out / LOG_NAME
        self._samples = out / _SAMPLES
        _keep_until(self._log, done)
        self._board = SummaryWriter(out / _TENSORBOARD, purge_step=done + 1 if done else None)

    def write_losses(self, step: int, values: dict[str, float]) -> None:
        """One line of the log, and a curve for each value."""
        with self._log.open("a") as log:
            log.write(json.dumps({"step": step, **values}) + "\n")
        self._add("train", step, values)

    def write_metrics(self, step: int, metrics: dict[str, float]) -> None:
        """Curves of a validation."""
        self._add("held_out", step, metrics)

    def write_sample(self, step: int, picture: np.ndarray) -> None:
        """A picture (H, W, 3) in OpenCV's order of colours."""
        self._samples.mkdir(exist_ok=True)
        with atomic_path(self._samples / f"step_{step:05d}.png") as path:
            cv2.imwrite(str(path), picture)
        self._board.add_image("matches", picture[..., ::-1], step, dataformats="HWC")

    def close(self) -> None:
        """Nothing is written afterwards."""
        self._board.close()

    def _add(self, group: str, step: int, values: dict[str, float]) -> None:
        for name, value in values.items():
            self._board.add_scalar(f"{group}/{name}", value, step)
        self._board.flush()


def _keep_until(log: Path, step: int) -> None:
    """Takes back the lines after a step, and one that a power cut left unfinished."""
    if log.is_file():
        lines = log.read_text().splitlines(keepends=True)
        whole = [line for line in lines if line.endswith("}\n")]
        atomic_write_text(log, "".join(line for line in whole if json.loads(line)["step"] <= step))

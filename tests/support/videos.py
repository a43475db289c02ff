"""Video files to be read back."""

from pathlib import Path

import cv2
import numpy as np


def write_video(path: Path, images: list[np.ndarray], rate_hz: float) -> Path:
    """Grey images as motion JPEG."""
    height, width = images[0].shape
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), rate_hz, (width, height))
    assert writer.isOpened()
    for image in images:
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path

"""Features for one's own scene: the shipped network goes on with renders that look like it, here brick walls.

    python examples/train_for_my_scene.py my_features

A mix names what pairs are made of: textures (`sigmaslam.synthetic.rendering.textures.KINDS`), "scenes" (streets, rooms)
or "endoscopy". Leaves in turn keep the network from forgetting the rest. This run is tiny: give 800 steps and the sizes
that are the defaults of `TrainingConfig`, then `sigmaslam export my_features --out graphs`.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.frontend.learned import extract
from sigmaslam.frontend.types import Features
from sigmaslam.inference.onnx_graph import shipped_weights
from sigmaslam.models.torch_runtime import TorchFeatures
from sigmaslam.training.features.loop import train
from sigmaslam.training.features.recipes import TrainingConfig
from sigmaslam.training.mixes import MIXES

MIXES["brick walls"] = ("bricks", "leaves", "facade", "leaves")
TINY = TrainingConfig(
    steps=4, data="brick walls", batch_size=4, size=96, points=32, learning_rate=5e-4, validate_every=0
)


def run(out: Path, config: TrainingConfig = TINY) -> Path:
    """Trains from the shipped weights on; returns the new ones."""
    train(out, config, workers=0, start=shipped_weights("features.safetensors"))
    return out / "features.safetensors"


def features_of(weights: Path, image: np.ndarray) -> Features:
    """Keypoints and descriptors of an (H, W) uint8 image."""
    return extract(TorchFeatures(weights), image, max_keypoints=256)


if __name__ == "__main__":
    weights = run(Path(sys.argv[1]))
    image = cv2.imread(str(Path(__file__).parents[1] / "synthetic/demo/image_0/000000.png"), cv2.IMREAD_GRAYSCALE)
    print(f"{weights} finds {len(features_of(weights, image).keypoints)} keypoints in the first image of the demo")

"""Features for one's own scene: the shipped network goes on with renders that look like it, here brick walls.

    python examples/train_for_my_scene.py my_features

Shares say what pairs are made of: worlds and textures by name (`sigmaslam_training.sources.SOURCES`), Python files that
make a world, folders of photographs. Leaves keep the network from forgetting the rest. This run is tiny: give 800 steps
and the sizes that are the defaults of `TrainingConfig`, then `sigmaslam train export my_features --out graphs`. The
command line does the same: docs/matching.md.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.frontend.learned import extract
from sigmaslam.frontend.types import Features
from sigmaslam.inference.onnx_graph import shipped_weights
from sigmaslam_models.torch_runtime import TorchFeatures
from sigmaslam_training.features.loop import train
from sigmaslam_training.features.recipes import TrainingConfig

BRICK_WALLS = {"bricks": 0.25, "facade": 0.25, "leaves": 0.5}
TINY = TrainingConfig(
    steps=4, shares=BRICK_WALLS, batch_size=4, size=96, points=32, learning_rate=5e-4, validate_every=0
)


def run(out: Path, config: TrainingConfig = TINY) -> Path:
    """Trains from the shipped weights on; returns the new ones."""
    train(out, config, workers=0, start=shipped_weights("features.safetensors"))
    return out / "features.safetensors"


def features_of(weights: Path, image: np.ndarray) -> Features:
    """Keypoints and descriptors of an (H, W) uint8 image."""
    return extract(TorchFeatures(weights), image, max_keypoints=256)


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    weights = run(Path(sys.argv[1]))
    image = cv2.imread(
        str(Path(__file__).parents[1] / "synthetic/sigmaslam_synthetic/demo/image_0/000000.png"), cv2.IMREAD_GRAYSCALE
    )
    print(f"{weights} finds {len(features_of(weights, image).keypoints)} keypoints in the first image of the demo")

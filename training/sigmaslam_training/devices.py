"""Where a run works: a processor or a GPU."""

import os

import torch
from torch import Tensor, nn

from sigmaslam.errors import InputError
from sigmaslam_models.feature_network import FeatureMaps, FeatureNetwork
from sigmaslam_training.features.stream import TrainingPair


def choose_device(name: str) -> torch.device:
    """The device of that name.

    Args:
        name: auto (a GPU if there is one), cpu, cuda or cuda:1.
    Raises:
        InputError: there is no such device.
    """
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError as error:
        raise InputError(f"device {name!r} is unknown: give auto, cpu, cuda or cuda:1") from error
    if device.type == "cpu":
        return device
    if device.type != "cuda":
        raise InputError(f"device {name!r} is not for training: give auto, cpu, cuda or cuda:1")
    index, count = device.index or 0, torch.cuda.device_count()
    if index >= count:
        raise InputError(f"device cuda:{index} does not exist, this machine has {count} GPUs: give cpu")
    return torch.device("cuda", index)


def describe_hardware(device: torch.device) -> str:
    """For the card."""
    gpu = f"{torch.cuda.get_device_name(device)}, " if device.type == "cuda" else ""
    return f"{gpu}{os.cpu_count()} CPU cores, torch {torch.__version__}"


class Bfloat16Network(nn.Module):
    """A network that computes in bfloat16, as on a GPU, and answers in float32, as the losses are."""

    def __init__(self, network: FeatureNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, cells: Tensor) -> FeatureMaps:
        """Maps of a batch of images, as `FeatureNetwork` gives them."""
        with torch.autocast(cells.device.type, dtype=torch.bfloat16):
            maps = self.network(cells)
        return FeatureMaps(*(each.float() for each in maps))

    def describe(self, maps: FeatureMaps, keypoints: Tensor) -> Tensor:
        """Descriptors, as `FeatureNetwork` gives them; in float32."""
        return self.network.describe(maps, keypoints)


def to_device(batch: TrainingPair, device: torch.device) -> TrainingPair:
    """The batch on the device; from pinned memory the copy does not keep the processor waiting."""
    image0, image1, keypoints0, places1, visible, keypoints1 = (each.to(device, non_blocking=True) for each in batch)
    return image0, image1, keypoints0, places1, visible, keypoints1

"""Where a run works: a processor or a GPU, alone or as one of several processes under torchrun."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

from sigmaslam.errors import InputError
from sigmaslam_models.feature_network import FeatureMaps, FeatureNetwork
from sigmaslam_training.features.batch_loss import pair_loss
from sigmaslam_training.features.losses import PairLoss
from sigmaslam_training.features.stream import TrainingPair


@dataclass(frozen=True, slots=True)
class Workplace:
    """Where one process of a run works.

    Attributes:
        device: of its network.
        rank: number of the process; 0 writes the files.
        ranks: number of processes.
    """

    device: torch.device
    rank: int = 0
    ranks: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process writes log, checkpoints and weights."""
        return self.rank == 0

    @property
    def on_gpu(self) -> bool:
        """Whether the network runs in bfloat16 on a GPU."""
        return self.device.type == "cuda"

    def agree(self, wish: bool) -> bool:
        """Whether any process wishes it: the same answer in all of them."""
        if self.ranks == 1:
            return wish
        votes = torch.tensor(float(wish), device=self.device)
        distributed.all_reduce(votes, op=distributed.ReduceOp.MAX)
        return bool(votes.item())


@contextmanager
def open_workplace(device: str = "auto", batch_size: int = 0) -> Iterator[Workplace]:
    """The workplace of this process; under torchrun it joins the others and leaves them when the block ends.

    Args:
        device: auto (a GPU if there is one), cpu, cuda or cuda:1; with several processes a GPU each.
        batch_size: pairs a step, which the processes share alike.
    Raises:
        InputError: there is no such device, or the batch cannot be shared.
    """
    ranks = int(os.environ.get("WORLD_SIZE", "1"))
    if batch_size % ranks:
        raise InputError(f"a batch of {batch_size} pairs cannot be shared by {ranks} processes: start a divisor of it")
    rank = int(os.environ.get("RANK", "0")) if ranks > 1 else 0
    chosen = choose_device(device, int(os.environ.get("LOCAL_RANK", "0")) if ranks > 1 else None)
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
    if ranks == 1:
        yield Workplace(chosen)
        return
    distributed.init_process_group("nccl" if chosen.type == "cuda" else "gloo", rank=rank, world_size=ranks)
    try:
        yield Workplace(chosen, rank, ranks)
    finally:
        distributed.destroy_process_group()


def leads() -> bool:
    """Whether this process is the only one or the first of several."""
    return os.environ.get("RANK", "0") == "0"


def describe_hardware(place: Workplace) -> str:
    """For the card."""
    processes = f"{place.ranks} processes, " if place.ranks > 1 else ""
    gpu = f"{torch.cuda.get_device_name(place.device)}, " if place.on_gpu else ""
    return f"{processes}{gpu}{describe_processor()}"


def describe_processor() -> str:
    """For the card of a run without a GPU."""
    return f"{os.cpu_count()} CPU cores, torch {torch.__version__}"


class NetworkLoss(nn.Module):
    """The network and its losses as one module, which is what DistributedDataParallel wraps.

    Args:
        network: in training.
        bfloat16: whether the network runs in it; the losses are float32 always.
    """

    def __init__(self, network: FeatureNetwork, bfloat16: bool = False) -> None:
        super().__init__()
        self.network: nn.Module = Bfloat16Network(network) if bfloat16 else network

    def forward(self, batch: TrainingPair, generator: torch.Generator) -> PairLoss:
        """Losses of a batch; see `pair_loss`."""
        return pair_loss(cast(FeatureNetwork, self.network), *batch, generator)


class Bfloat16Network(nn.Module):
    """A network that computes in bfloat16 and answers in float32."""

    def __init__(self, network: FeatureNetwork) -> None:
        super().__init__()
        self.network = network

    def forward(self, cells: Tensor) -> FeatureMaps:
        """Maps of a batch of images, as `FeatureNetwork` gives them."""
        with torch.autocast(cells.device.type, dtype=torch.bfloat16):
            maps = self.network(cells)
        return FeatureMaps(*(each.float() for each in maps))

    def describe(self, maps: FeatureMaps, keypoints: Tensor) -> Tensor:
        """Descriptors, as `FeatureNetwork` gives them; in float32, as the losses."""
        return self.network.describe(maps, keypoints)


def place_network(network: FeatureNetwork, place: Workplace) -> FeatureNetwork:
    """The network on its device, with batch statistics of all processes where they have GPUs."""
    if place.on_gpu and place.ranks > 1:
        network = nn.SyncBatchNorm.convert_sync_batchnorm(network)
    network.to(place.device)
    network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return network


def loss_module(network: FeatureNetwork, place: Workplace) -> nn.Module:
    """Called with a batch and a generator, gives a `PairLoss`; its gradients are the mean over the processes."""
    loss = NetworkLoss(network, bfloat16=place.on_gpu)
    if place.ranks == 1:
        return loss
    return DistributedDataParallel(loss, device_ids=[place.device.index] if place.on_gpu else None)


def to_device(batch: TrainingPair, place: Workplace) -> TrainingPair:
    """The batch on the device; from pinned memory the copy does not keep the processor waiting."""
    image0, image1, keypoints0, places1, visible, keypoints1 = (
        each.to(place.device, non_blocking=True) for each in batch
    )
    return image0, image1, keypoints0, places1, visible, keypoints1


def choose_device(name: str, local_rank: int | None = None) -> torch.device:
    """The device of a name, auto, cpu, cuda or cuda:1, for one of several processes of this machine.

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
    count = torch.cuda.device_count()
    index = device.index or 0 if local_rank is None else local_rank
    if index >= count:
        raise InputError(f"device cuda:{index} does not exist, this machine has {count} GPUs: give cpu, or start fewer")
    return torch.device("cuda", index)

"""Trains the stereo network for a given time: pairs of layers and renders, whose cameras are drawn anew each time."""

import json
import math
import os
import random
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from sigmaslam_models.stereo_network import StereoNetwork
from sigmaslam_training.stereo.layered_scenes import LayeredScenes, Pairs
from sigmaslam_training.stereo.rendered_pairs import RenderedPairs
from sigmaslam_training.stereo.stereo_loss import stereo_loss
from sigmaslam_training.stereo.unlike_eyes import photograph


@dataclass(frozen=True, slots=True)
class StereoTraining:
    """What a training is made of.

    Attributes:
        seconds: it lasts, the painting of textures included.
        seed: of everything.
        batch: pairs a step.
        crop: (H, W) of the pairs that the network sees.
        size: (H, W) of the pairs that are drawn.
        workers: processes that render.
        rendered: share of renders in a batch, as soon as there are enough.
        kept: layered pairs that are kept and used again.
        drawn: new layered pairs every other step.
        rate: largest learning rate, reached after a twentieth of the time; then half a cosine to nothing.
    """

    seconds: float
    seed: int = 20261127
    batch: int = 16
    crop: tuple[int, int] = (320, 640)
    size: tuple[int, int] = (352, 704)
    workers: int = 7
    rendered: float = 0.4
    kept: int = 1500
    drawn: int = 4
    rate: float = 2e-3


_TEXTURES, _TEXTURE_SIZE = 64, 512  # a worker
_PLACES = 700  # pairs a worker may render
_SAVE_EVERY, _LOG_EVERY = 30.0, 5.0  # seconds
_DECAY, _AVERAGE, _LONGEST_GRADIENT = 1e-4, 0.998, 1.0


class _Kept:
    """Pairs on the device, as halves and truth; the oldest make way."""

    def __init__(self, places: int, size: tuple[int, int], device: torch.device) -> None:
        self.count, self._next, self._places = 0, 0, places
        self._images = torch.empty((places, 2, *size), dtype=torch.float16, device=device)
        self._disparity = torch.empty((places, 1, *size), device=device)

    def add(self, images: Tensor, disparity: Tensor) -> None:
        for image, truth in zip(images, disparity, strict=True):
            self._images[self._next], self._disparity[self._next] = image, truth
            self._next = (self._next + 1) % self._places
            self.count = min(self.count + 1, self._places)

    def sample(self, count: int, crop: tuple[int, int], numbers: random.Random) -> tuple[Tensor, Tensor]:
        """Crops of so many pairs, upside down now and then."""
        height, width = self._images.shape[2:]
        images, truths = [], []
        for _ in range(count):
            index, flip = numbers.randrange(self.count), numbers.random() < 0.15
            top, start = numbers.randint(0, height - crop[0]), numbers.randint(0, width - crop[1])
            window = slice(top, top + crop[0]), slice(start, start + crop[1])
            image, truth = self._images[index][:, *window].float(), self._disparity[index][:, *window]
            images.append(image.flip(1) if flip else image)
            truths.append(truth.flip(1) if flip else truth)
        return torch.stack(images), torch.stack(truths)


def train_stereo(
    config: StereoTraining, out: Path, device: torch.device, note: Callable[[str], None] = print
) -> StereoNetwork:
    """Trains; leaves `stereo.pt`, `config.json` and `log.jsonl` in a folder, the weights every half minute."""
    began = time.monotonic()
    out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(config.seed)
    generator = torch.Generator(device)
    generator.manual_seed(config.seed)
    numbers = random.Random(config.seed)
    network = StereoNetwork().to(device).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    average = StereoNetwork().to(device).eval()
    average.load_state_dict(network.state_dict())
    optimizer = torch.optim.AdamW(network.parameters(), config.rate, weight_decay=_DECAY)
    facts = {**asdict(config), "device": _name(device), "torch": torch.__version__, "cores": os.cpu_count()}
    (out / "config.json").write_text(json.dumps(facts, indent=1))
    with tempfile.TemporaryDirectory() as scratch, (out / "log.jsonl").open("a") as log:
        source = RenderedPairs(
            Path(scratch), config.seed, config.size, config.workers, _PLACES, _TEXTURES, _TEXTURE_SIZE
        )
        try:
            _wait(source, config, note)
            textures = torch.from_numpy(source.painted).to(device)
            layers = LayeredScenes(textures, config.size, generator)
            layered = _Kept(config.kept, config.size, device)
            rendered = _Kept(2 * config.kept, config.size, device)
            step, saved, logged, failures = 0, began, began, 0
            sums: dict[str, float | Tensor] = {}
            while (elapsed := time.monotonic() - began) < config.seconds:
                try:
                    if step % 500 == 0:
                        layers.replace_textures(torch.from_numpy(source.painted).to(device))
                    for images, disparity in source.new():
                        rendered.add(torch.from_numpy(images)[None].to(device), torch.from_numpy(disparity)[None, None].to(device))
                    with torch.no_grad():
                        if step % 2 == 0:
                            drawn = layers.draw(config.drawn)
                            layered.add(torch.cat([drawn.left, drawn.right], dim=1), drawn.disparity)
                        share = round(config.rendered * config.batch) if rendered.count >= 16 else 0
                        images, truth = layered.sample(config.batch - share, config.crop, numbers)
                        if share:
                            more, truths = rendered.sample(share, config.crop, numbers)
                            images, truth = torch.cat([images, more]), torch.cat([truth, truths])
                        left, right = photograph(Pairs(images[:, :1], images[:, 1:], truth), generator)
                    rate = _rate(elapsed / config.seconds) * config.rate
                    for group in optimizer.param_groups:
                        group["lr"] = rate
                    network.train()
                    with torch.autocast(device.type, torch.bfloat16, enabled=device.type == "cuda"):
                        maps = network(left, right)
                    loss, figures = stereo_loss(maps, truth)
                    optimizer.zero_grad(set_to_none=True)
                    loss.backward()
                    torch.nn.utils.clip_grad_norm_(network.parameters(), _LONGEST_GRADIENT)
                    for parameter in network.parameters():
                        if parameter.grad is not None:  # a step that has no number is none
                            parameter.grad.nan_to_num_(0.0, 0.0, 0.0)
                    optimizer.step()
                    _follow(average, network, min(_AVERAGE, (1.0 + step) / (10.0 + step)))
                except torch.OutOfMemoryError as error:
                    # Another process on the same GPU may have taken what was there.
                    failures += 1
                    note(f"out of memory, {failures}: {str(error)[:200]}")
                    optimizer.zero_grad(set_to_none=True)
                    torch.cuda.empty_cache()
                    time.sleep(1.0)
                    if failures > 50:
                        raise
                    continue
                step += 1
                for name, value in figures.items():
                    sums[name] = sums.get(name, 0.0) + value
                sums["steps"] = sums.get("steps", 0.0) + 1
                now = time.monotonic()
                if now - logged > _LOG_EVERY or step == 1:
                    logged = now
                    steps = float(sums.pop("steps"))
                    line = {name: round(float(value) / steps, 4) for name, value in sums.items()}
                    line |= {"step": step, "s": round(now - began, 1), "renders": rendered.count, "alive": source.alive}
                    line |= {"layers": layered.count, "textures": len(layers.textures), "rate": round(rate, 6)}
                    log.write(json.dumps(line) + "\n")
                    log.flush()
                    note(json.dumps(line))
                    sums = {}
                if now - saved > _SAVE_EVERY:
                    saved = now
                    _save(out, average, network, step)
            _save(out, average, network, step)
        finally:
            source.close()
    return average


def _wait(source: RenderedPairs, config: StereoTraining, note: Callable[[str], None]) -> None:
    """Until there are textures to begin with."""
    began = time.monotonic()
    wanted = min(64, config.workers * _TEXTURES)
    while len(source.painted) < wanted and time.monotonic() - began < 0.25 * config.seconds and source.alive:
        time.sleep(0.25)
    note(f"{len(source.painted)} textures after {time.monotonic() - began:.1f} s, {source.alive} processes")
    if not len(source.painted):
        raise RuntimeError("no process could paint a texture")


def _rate(share: float) -> float:
    """Of the learning rate, by the share of the time that has gone."""
    return min(share / 0.05, 0.5 * (1.0 + math.cos(math.pi * min(share, 1.0))) + 0.005)


@torch.no_grad()
def _follow(average: StereoNetwork, network: StereoNetwork, decay: float) -> None:
    old, new = (
        [value for value in each.state_dict().values() if value.dtype.is_floating_point] for each in (average, network)
    )
    torch._foreach_lerp_(old, new, 1.0 - decay)


def _save(out: Path, average: StereoNetwork, network: StereoNetwork, step: int) -> None:
    temporary = out / "stereo.pt.part"
    states = {"average": average.state_dict(), "network": network.state_dict()}
    torch.save({name: {k: v.cpu() for k, v in state.items()} for name, state in states.items()} | {"step": step}, temporary)
    temporary.replace(out / "stereo.pt")


def _name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu"

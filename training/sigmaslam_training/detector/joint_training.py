"""Trains the feature network with a learned response for so many seconds: `python -m ... --seconds 480 --out run`."""

import argparse
import json
import math
import signal
import sys
import time
import traceback
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_training.detector.joint_loss import JointLoss, joint_loss
from sigmaslam_training.detector.photographs import photograph
from sigmaslam_training.detector.reliefs import Reliefs
from sigmaslam_training.detector.scene_feed import SceneFeed, paint_textures
from sigmaslam_training.detector.view_store import Views, ViewStore


@dataclass(frozen=True, slots=True)
class JointConfig:
    """What one run is made of.

    Attributes:
        batch_size: pairs a step.
        size: side of the images.
        keypoints, points, anchors: as `joint_loss` takes them.
        learning_rate: peak; it rises for a twentieth of the time and falls to zero as a cosine.
        scene_share: of pairs that are rendered scenes, once enough have come.
        relief_scenes, relief_every: so many new scenes of heights every so many steps.
        quality_weight, odds_weight, agreement_weight, place_weight: of the losses beside the descriptors'.
        seed: of everything.
    """

    batch_size: int = 32
    size: int = 320
    keypoints: int = 640
    points: int = 320
    anchors: int = 192
    learning_rate: float = 1e-3
    scene_share: float = 0.3
    relief_scenes: int = 4
    relief_every: int = 2
    quality_weight: float = 0.5
    odds_weight: float = 0.4
    agreement_weight: float = 0.2
    place_weight: float = 0.1
    seed: int = 1


class Trainer:
    """One run.

    Args:
        config: of the run.
        seconds: that it lasts, from `began` (of `time.monotonic`).
        out: folder for weights and card.
        start: weights to go on from.
        scenes: .npz of scenes that are there from the beginning, if any.
        workers: processes that render.
        device: of the network.
    """

    def __init__(
        self,
        config: JointConfig,
        seconds: float,
        out: Path,
        start: Path,
        scenes: Path | None,
        workers: int,
        device: torch.device,
        began: float,
    ) -> None:
        self._config, self._device, self._out, self._done = config, device, out, 0
        self._began, self._ends = began, began + seconds
        self._feed: SceneFeed | None = None
        try:
            self._feed = SceneFeed(workers, config.seed, config.size) if workers else None
        except Exception:  # reliefs are drawn without
            self.note("failure", error=traceback.format_exc()[-1500:])
        torch.manual_seed(config.seed)
        self._generator = torch.Generator(device).manual_seed(config.seed)
        self._network = FeatureNetwork(detects=True)
        self._network.load_state_dict({**self._network.state_dict(), **load_file(start)})
        self._network.to(device).train()
        self._optimizer = torch.optim.AdamW(
            self._network.parameters(), config.learning_rate, weight_decay=1e-4, fused=device.type == "cuda"
        )
        on_gpu = device.type == "cuda"
        self._relief_store = ViewStore(768 if on_gpu else 24, 4, config.size, device)
        self._scene_store = ViewStore(512 if on_gpu else 24, 8, config.size, device)
        self._reliefs = Reliefs(config.size, 4, device, self._generator)
        painted = paint_textures(np.random.default_rng(config.seed), 12)
        self._bank = torch.from_numpy(painted).to(device)
        self.note("painted", textures=len(self._bank))
        try:
            if scenes is not None and scenes.is_file():
                self._load(scenes)
        except Exception:
            self.note("failure", error=traceback.format_exc()[-1500:])
        for _ in range(16 if on_gpu else 3):
            self._draw_reliefs()
        self.note("ready", scenes=self._scene_store.filled, reliefs=self._relief_store.filled)

    def note(self, kind: str, **facts: Any) -> None:
        """A line of the output."""
        print(json.dumps({"kind": kind, "seconds": round(time.monotonic() - self._began, 1), **facts}), flush=True)

    def run(self) -> None:
        """All steps that the time allows; what is learned is saved whatever happens."""
        try:
            self._steps()
        finally:
            self.save(self._done)
            self.note("done", step=self._done)
            if self._feed:
                self._feed.stop()

    def _steps(self) -> None:
        step, told, saved = 0, time.monotonic(), time.monotonic()
        sums: dict[str, float] = {}
        failures = 0
        since = 0
        start = time.monotonic()
        while (now := time.monotonic()) < self._ends:
            done = (now - start) / max(self._ends - start, 1e-6)
            rate = (
                self._config.learning_rate
                * min(1.0, 20 * done + 0.02)
                * 0.5
                * (1.0 + math.cos(math.pi * min(done, 1.0)))
            )
            for group in self._optimizer.param_groups:
                group["lr"] = rate
            self._collect()
            try:
                if step % self._config.relief_every == 0:
                    self._draw_reliefs()
                loss = self._step()
            except RuntimeError as error:
                failures += 1
                self.note("failure", step=step, error=traceback.format_exc()[-1500:])
                if failures > 10:
                    raise
                if "out of memory" in str(error):
                    torch.cuda.empty_cache()
                continue
            step += 1
            self._done = step
            since += 1
            if step % 5 == 0 or step < 5:
                for name, value in loss._asdict().items():
                    sums[name] = sums.get(name, 0.0) + float(value.detach())
                sums["_"] = sums.get("_", 0.0) + 1.0
            if now - told > 5.0 or step in (1, 10):
                count = max(sums.pop("_", 1.0), 1.0)
                facts = {name: round(value / count, 4) for name, value in sums.items()}
                self.note(
                    "losses",
                    step=step,
                    rate=round(rate, 6),
                    steps_per_second=round(since / max(now - told, 1e-3), 2),
                    scenes=self._scene_store.filled,
                    textures=len(self._bank),
                    alive=self._feed.alive() if self._feed else 0,
                    memory_gib=round(torch.cuda.max_memory_allocated() / 2**30, 2)
                    if self._device.type == "cuda"
                    else 0,
                    **facts,
                )
                told, since, sums = now, 0, {}
            if now - saved > 30.0:
                self.save(step)
                saved = now

    def save(self, step: int) -> None:
        """Weights and card; each appears whole or not at all."""
        state = {name: value.detach().cpu().contiguous() for name, value in self._network.state_dict().items()}
        if not all(torch.isfinite(value).all() for value in state.values() if value.is_floating_point()):
            self.note("failure", step=step, error="weights are not finite: not saved")
            return
        path = self._out / "features.safetensors"
        save_file(state, path.with_suffix(".part"))
        path.with_suffix(".part").replace(path)
        card = {
            "config": asdict(self._config),
            "step": step,
            "duration_s": round(time.monotonic() - self._began, 1),
            "torch": torch.__version__,
            "hardware": torch.cuda.get_device_name() if self._device.type == "cuda" else "cpu",
            "command": " ".join(sys.argv),
        }
        part = self._out / "features.json.part"
        part.write_text(json.dumps(card, indent=2) + "\n")
        part.replace(self._out / "features.json")

    def _step(self) -> JointLoss:
        config = self._config
        from_scenes = round(config.scene_share * config.batch_size * min(1.0, self._scene_store.filled / 16))
        parts = [self._relief_store.draw(config.batch_size - from_scenes, self._generator)]
        if from_scenes:
            parts.append(self._scene_store.draw(from_scenes, self._generator))
        sides = [Views(*(torch.cat(each) for each in zip(*side, strict=True))) for side in zip(*parts, strict=True)]
        views = Views(*(torch.cat(each) for each in zip(*sides, strict=True)))
        images = photograph(views.light, self._generator)
        loss = joint_loss(
            self._network, images, views, config.keypoints, config.points, config.anchors, self._generator
        )
        total = (
            loss.descriptor
            + config.quality_weight * loss.quality
            + config.odds_weight * loss.odds
            + config.agreement_weight * loss.agreement
            + config.place_weight * loss.place
        )
        self._optimizer.zero_grad(set_to_none=True)
        total.backward()
        norm = torch.nn.utils.clip_grad_norm_(self._network.parameters(), 1.0)
        if bool(torch.isfinite(norm)):
            self._optimizer.step()
        return loss

    @torch.no_grad()
    def _draw_reliefs(self) -> None:
        for views in self._reliefs.scenes(self._bank, self._config.relief_scenes):
            self._relief_store.add(views)

    @torch.no_grad()
    def _collect(self) -> None:
        for kind, value in self._feed.arrived() if self._feed else ():
            try:
                if kind == "textures":
                    self._bank = torch.cat([self._bank, torch.from_numpy(value).to(self._device)])[-512:]
                elif kind == "scene":
                    self._add_scene(value)
                else:
                    self.note("failure", error=str(value)[-1500:])
            except Exception:  # training goes on without what came
                self.note("failure", error=traceback.format_exc()[-1500:])

    def _add_scene(self, scene: dict[str, np.ndarray]) -> None:
        light, depth, camera, T = (
            torch.from_numpy(np.asarray(scene[name])).to(self._device)
            for name in ("light", "depth", "camera", "T_world_camera")
        )
        self._scene_store.add(Views(light.unsqueeze(1), depth.unsqueeze(1), camera, T))

    @torch.no_grad()
    def _load(self, path: Path) -> None:
        """Scenes with light as bytes of its root and inverse depth as 16 bits."""
        with np.load(path) as content:
            arrays = dict(content)
        for k in range(len(arrays["camera"])):
            light = (arrays["light"][k].astype(np.float32) / 255.0) ** 2 * arrays["white"][k]
            inverse = arrays["inverse_depth"][k].astype(np.float32) / 65535.0 * arrays["nearest"][k]
            with np.errstate(divide="ignore"):
                depth = 1.0 / inverse
            self._add_scene(
                {
                    "light": light,
                    "depth": depth,
                    "camera": arrays["camera"][k],
                    "T_world_camera": arrays["T_world_camera"][k],
                }
            )


def main() -> None:
    """The command line."""
    began = time.monotonic()
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--start", type=Path, required=True)
    parser.add_argument("--scenes", type=Path)
    parser.add_argument("--workers", type=int, default=7)
    parser.add_argument("--set", nargs="*", default=[], help="name=value of the configuration")
    arguments = parser.parse_args()
    fields = JointConfig.__dataclass_fields__
    chosen = dict(each.split("=") for each in arguments.set)
    config = JointConfig(**{name: type(fields[name].default)(value) for name, value in chosen.items()})
    arguments.out.mkdir(parents=True, exist_ok=True)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    # Second derivatives and geometry need all bits of a float.
    torch.backends.cuda.matmul.allow_tf32 = False
    torch.backends.cudnn.allow_tf32 = False
    if device.type == "cuda":
        torch.cuda.set_per_process_memory_fraction(0.45)
        torch.backends.cudnn.benchmark = True
    else:
        torch.set_num_threads(1)
    trainer = Trainer(
        config, arguments.seconds, arguments.out, arguments.start, arguments.scenes, arguments.workers, device, began
    )
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("stopped"))
    trainer.run()


if __name__ == "__main__":
    main()

"""The training loop: resumable at any step, the same result on as many processes whether it was interrupted or not."""

import time
from contextlib import closing, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from sigmaslam.errors import SigmaSlamError
from sigmaslam.files import atomic_write_json, make_folder
from sigmaslam.progress import open_progress
from sigmaslam_training.devices import Workplace, loss_module, open_workplace, to_device
from sigmaslam_training.features.checkpoint import (
    CHECKPOINT_NAME,
    TrainingState,
    begin,
    check_run_folder,
    resume_checkpoint,
    save_checkpoint,
)
from sigmaslam_training.features.losses import PairLoss
from sigmaslam_training.features.pictures import draw_sample
from sigmaslam_training.features.recipes import TrainingConfig, check_config
from sigmaslam_training.features.stream import TrainingPair, open_stream, pair_loader
from sigmaslam_training.features.validation import PAIRS, held_out_seed, held_out_sources, matching_accuracy
from sigmaslam_training.interruption import Interruption
from sigmaslam_training.journal import Journal
from sigmaslam_training.run_card import CARD_NAME, describe_origin, make_card
from sigmaslam_training.snapshot import save_tensors

WEIGHTS_NAME = "features.safetensors"
_LOG_EVERY = 50
_SHOW_EVERY = 10


def train(
    out: Path,
    config: TrainingConfig,
    workers: int = 1,
    resume: bool = False,
    recipe: str | None = None,
    start: Path | None = None,
    device: str = "auto",
) -> dict[str, Any]:
    """Trains the correspondence network on renders and writes weights and card into `out`.

    Under torchrun each process takes its share of every batch. Ctrl-C or SIGTERM: the step under way is finished and
    saved, then TrainingStopped, a KeyboardInterrupt, is raised.

    Args:
        out: run folder; gets checkpoint.safetensors, log.jsonl, tensorboard/, samples/, features.safetensors and
            features.json.
        config: what the run is made of.
        workers: processes that make pairs, for each process that trains.
        resume: go on from the checkpoint in `out`.
        recipe: name of the configuration, for the card.
        start: weights to go on from; None: random ones, or what the resumed run began with.
        device: auto (a GPU if there is one), cpu, cuda or cuda:1.
    Returns:
        The card: recipe, config, seed, commit, command, duration, metrics on held-out renders.
    Raises:
        InputError: the folder, the configuration, the device or the weights do not go together.
        TrainingStopped: the run was stopped; it can be resumed.
    """
    check_config(config)
    check_run_folder(out, resume)
    with open_workplace(device, config.batch_size) as place:
        path = out / CHECKPOINT_NAME
        if resume:
            state = resume_checkpoint(path, config, recipe, start, place)
        else:
            state = begin(config, recipe, start, place)
            # Before the run: the tree may move on while it lasts.
            state.origin = describe_origin([out] if start is None else [out, start])
        make_folder(out)
        with closing(Journal(out, state.step)) if place.leads else nullcontext() as journal:
            _Run(state, place, out, journal).finish(workers)
        card = make_card(state, place)
        if place.leads:
            save_tensors(out / WEIGHTS_NAME, state.network.state_dict())
            atomic_write_json(out / CARD_NAME, card)
    return card


class TrainingStopped(KeyboardInterrupt):
    """A run was stopped.

    Attributes:
        saved: steps that the checkpoint has; 0: there is none.
        steps: of the whole run.
    """

    def __init__(self, saved: int, steps: int) -> None:
        super().__init__(saved, steps)
        self.saved, self.steps = saved, steps


class _Run:
    """The steps that a state lacks, and what is written meanwhile.

    Args:
        state: goes on changing.
        place: of this process.
        out: run folder.
        journal: of the process that leads.
    """

    def __init__(self, state: TrainingState, place: Workplace, out: Path, journal: Journal | None) -> None:
        self._state, self._place, self._journal = state, place, journal
        self._checkpoint = out / CHECKPOINT_NAME
        self._saved = state.step
        self._loss = loss_module(state.network, place)
        self._began = time.monotonic() - state.seconds
        self._logged = (state.step, time.monotonic())
        self._progress = open_progress(hidden=not place.leads)

    def finish(self, workers: int) -> None:
        """Trains to the end; stopped, it saves the last whole step and raises TrainingStopped."""
        interruption = Interruption(self._place)
        with interruption.listening():
            try:
                with self._progress:
                    self._steps(workers, interruption)
            except KeyboardInterrupt:
                if not interruption.torn and self._state.step > self._saved:
                    self._save()
                raise TrainingStopped(self._saved, self._state.config.steps) from None

    def _steps(self, workers: int, interruption: Interruption) -> None:
        state, config, place = self._state, self._state.config, self._place
        task = self._progress.add_task("training", total=config.steps, completed=state.step, note="")
        # The workers begin while this process validates.
        batches = iter(pair_loader(config, state.step, workers, place.rank, place.ranks, place.on_gpu))
        self._validate_if_due()
        for batch in batches:
            with interruption.whole_step():
                loss = self._step(to_device(batch, place))
            self._progress.update(task, completed=state.step)
            last = state.step == config.steps
            if state.step % _SHOW_EVERY == 0 or last:
                note = " ".join(f"{name} {float(value.detach()):.3f}" for name, value in loss._asdict().items())
                self._progress.update(task, note=note)
            if state.step % _LOG_EVERY == 0 or last:
                self._log(loss)
            self._validate_if_due()
            if state.step % config.checkpoint_every == 0 or last:
                self._save()

    def _step(self, batch: TrainingPair) -> PairLoss:
        """One step of the optimiser."""
        state, config = self._state, self._state.config
        seed = (config.seed * 1_000_000_007 + state.step + self._place.rank * 500_000_003) % 2**63
        state.network.train()
        loss: PairLoss = self._loss(batch, torch.Generator().manual_seed(seed))
        state.optimizer.zero_grad(set_to_none=True)
        (loss.descriptor + config.quality_weight * loss.quality + config.place_weight * loss.place).backward()
        if not nn.utils.clip_grad_norm_(state.network.parameters(), 1.0).isfinite():
            raise SigmaSlamError(f"step {state.step}: loss or gradient is not finite: mend their source, then --resume")
        state.optimizer.step()
        state.schedule.step()
        state.step += 1
        return loss

    def _log(self, loss: PairLoss) -> None:
        if self._journal is None:
            return
        step, now = self._state.step, time.monotonic()
        before, then = self._logged
        self._logged = (step, now)
        values = {name: float(value.detach()) for name, value in loss._asdict().items()}
        rate = float(self._state.schedule.get_last_lr()[0])
        speed = (step - before) / max(now - then, 1e-9)
        self._journal.write_losses(step, {**values, "learning_rate": rate, "steps_per_second": round(speed, 3)})

    def _validate_if_due(self) -> None:
        """Validates and draws a sample; before the first step it draws alone."""
        state, config = self._state, self._state.config
        if self._journal is None or config.validate_every == 0:
            return
        due = state.step % config.validate_every == 0 or state.step == config.steps
        if not due or state.validated == state.step:
            return
        seed, sources = held_out_seed(config.seed), held_out_sources(config.mix)
        if state.step:
            # A tenth of what is learned from: a run of a few steps, to try it, ends soon.
            count = min(PAIRS, 1 + config.steps * config.batch_size // 10)
            self._progress.console.print(f"step {state.step}: matching {count} held-out pairs")
            state.metrics = matching_accuracy(state.network, seed, sources, count)
            self._journal.write_metrics(state.step, state.metrics)
            metrics = ", ".join(f"{name} {value:.3f}" for name, value in state.metrics.items())
            self._progress.console.print(f"step {state.step}: {metrics}")
        pairs = [open_stream(source, seed, config.size).pair(0) for source in sources]
        self._journal.write_sample(state.step, np.concatenate([draw_sample(state.network, pair) for pair in pairs]))
        state.validated = state.step

    def _save(self) -> None:
        if self._place.leads:
            self._state.seconds = time.monotonic() - self._began
            save_checkpoint(self._checkpoint, self._state)
            self._saved = self._state.step

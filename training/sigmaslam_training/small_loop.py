"""The loop of a small network on one processor: saved now and then, and resumed to the bit."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from sigmaslam_training.devices import Workplace
from sigmaslam_training.interruption import Interruption
from sigmaslam_training.snapshot import check_same, read_snapshot, restore, write_snapshot

SAVE_EVERY = 250
"""Steps between two checkpoints."""


def train_steps(
    network: nn.Module,
    optimizer: torch.optim.Optimizer,
    schedule: torch.optim.lr_scheduler.LRScheduler,
    steps: int,
    losses: Callable[[int], Iterator[Tensor]],
    checkpoint: Path,
    made_of: dict[str, Any],
    note: Callable[[int, str], None],
    max_gradient: float = float("inf"),
) -> None:
    """Takes the steps, or those that the checkpoint lacks; the network is left in evaluation mode.

    Args:
        network, optimizer, schedule: before the first step.
        steps: of the optimiser, in all.
        losses: given how many steps are done, the loss of each further one.
        checkpoint: file for the state, every 250 steps, at the end and when the run is stopped.
        made_of: what the training is made of, as JSON holds it.
        note: is told of every step and the loss.
        max_gradient: longer gradients are cut to this norm.
    Raises:
        InputError: the checkpoint cannot be read, or is of a training made of something else.
        KeyboardInterrupt: the run was stopped; it goes on from the checkpoint.
    """
    done = 0
    if checkpoint.is_file():
        snapshot = read_snapshot(checkpoint)
        check_same(checkpoint, "", made_of, snapshot.facts["made_of"])
        done = restore(snapshot, network, optimizer, schedule)
    step, coming = done, losses(done)

    def save() -> None:
        write_snapshot(checkpoint, network, optimizer, schedule, step, {"made_of": made_of})

    interruption = Interruption(Workplace(torch.device("cpu")))
    with interruption.listening():
        try:
            while step < steps:
                with interruption.whole_step():
                    network.train()
                    loss = next(coming)
                    optimizer.zero_grad(set_to_none=True)
                    loss.backward()
                    if max_gradient < float("inf"):
                        nn.utils.clip_grad_norm_(network.parameters(), max_gradient)
                    optimizer.step()
                    schedule.step()
                    step += 1
                note(step, f"loss {float(loss.detach()):.3f}")
                if step % SAVE_EVERY == 0 or step == steps:
                    save()
        except KeyboardInterrupt:
            if not interruption.torn and step > done:
                save()
            raise
    network.eval()

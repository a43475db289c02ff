"""`python -m sigmaslam.training.filter_tuning`: trains covariances of the verifier of places through the filter.

The loss is the negative log-likelihood of the true pose of a frame relative to the last keyframe, under the posterior
of the update that ships, of frames that the tracker followed in rendered sequences. What it gains is measured on other
sequences: on their updates, and by tracking them again. The shipped weights are made without it, see docs/matching.md.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.func import functional_call

from sigmaslam.errors import InputError, SigmaSlamError
from sigmaslam.evaluation.metrics.trajectory_errors import absolute_trajectory_error, pose_nees
from sigmaslam.evaluation.rendered_camera import open_rendered
from sigmaslam.evaluation.trial import rendered_truth
from sigmaslam.files import atomic_path, atomic_write_text, check_new_folder, make_folder
from sigmaslam.frontend.descriptor import DescriptorFrontend
from sigmaslam.frontend.learned import LearnedDetector
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.inference.onnx_graph import shipped_weights
from sigmaslam.models.network_export import load_verifier
from sigmaslam.models.torch_runtime import TorchModule
from sigmaslam.models.verifier_network import PLACE_COLUMNS, MatchCovariance, MatchVerifier
from sigmaslam.progress import open_progress
from sigmaslam.readers import StereoSequence
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam.slam.config import TrackerConfig
from sigmaslam.slam.tracker import StereoTracker
from sigmaslam.training.matching.recorded_updates import RecordedUpdate, record_updates
from sigmaslam.training.matching.scoring import PLACE_VERIFIER_NAME

PARTS = ("layer", "scale")
"""What is trained: the last layer's rows of log sigma, or a gain and a shift of what they give, for either axis."""
FIGURES_NAME = "filter_tuning.json"
_LEARNING_RATE, _MAX_GRADIENT, _BATCH = 1e-2, 1.0, 8
_DEGREES_OF_FREEDOM = 6


class TunedVerifier(nn.Module):
    """The verifier of places, of which a part is trained; in float64, as the filter.

    Args:
        verifier: to start from; is left as it is.
        part: one of `PARTS`.
    """

    def __init__(self, verifier: MatchVerifier, part: str) -> None:
        super().__init__()
        last = verifier.layers[-1]
        assert isinstance(last, nn.Linear)
        self._last_name = f"verifier.layers.{len(verifier.layers) - 1}"
        # In a list it is no part of this module, whose parameters are those that are trained.
        self._network = [MatchCovariance(deepcopy(verifier)).double().requires_grad_(False)]
        self.register_buffer("_weight", last.weight.detach().double())
        self.register_buffer("_bias", last.bias.detach().double())
        if part == "layer":
            self.of_weight = nn.Parameter(torch.zeros_like(self._weight[1:]))
            self.of_bias = nn.Parameter(torch.zeros_like(self._bias[1:]))
        else:
            self.log_gain, self.shift = (nn.Parameter(torch.zeros(2, dtype=torch.float64)) for _ in range(2))
        self.part = part

    _weight: Tensor
    _bias: Tensor

    def forward(self, columns: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
        """Probability (M,) and covariance (M, 2, 2), as of `MatchCovariance`."""
        given: tuple[Tensor, Tensor] = functional_call(self._network[0], self._last_layer(), (columns, axes))
        return given

    def _last_layer(self) -> dict[str, Tensor]:
        sigma_weight, sigma_bias = self._weight[1:], self._bias[1:]
        if self.part == "layer":
            sigma_weight, sigma_bias = sigma_weight + self.of_weight, sigma_bias + self.of_bias
        else:
            gain = self.log_gain.exp()
            sigma_weight, sigma_bias = gain[:, None] * sigma_weight, gain * sigma_bias + self.shift
        weight, bias = torch.cat([self._weight[:1], sigma_weight]), torch.cat([self._bias[:1], sigma_bias])
        return {f"{self._last_name}.weight": weight, f"{self._last_name}.bias": bias}

    def state(self) -> dict[str, Tensor]:
        """Weights of a `MatchVerifier` that gives the same, float32."""
        whole = {**self._network[0].state_dict(), **self._last_layer()}
        return {name.removeprefix("verifier."): value.detach().float().clone() for name, value in whole.items()}


@dataclass(frozen=True, slots=True)
class UpdateFigures:
    """How well the poses of updates are known, relative to the last keyframe.

    Attributes:
        count: of updates.
        nll, nll_median: negative log-likelihood of the true pose.
        nees, nees_median: normalised estimation error squared per degree of freedom; 1 and 0.89 where it is right.
    """

    count: int
    nll: float
    nll_median: float
    nees: float
    nees_median: float


@dataclass(frozen=True, slots=True)
class RunFigures:
    """One sequence tracked from its first to its last frame.

    Attributes:
        name: of the sequence.
        ate: root mean square position error after alignment, metres.
        nees: of poses relative to the first, per degree of freedom.
        nis: per degree of freedom, median over the tracked frames.
        tracked: how many frames were.
    """

    name: str
    ate: float
    nees: float
    nis: float
    tracked: int


def assess(verifier: nn.Module, updates: Sequence[RecordedUpdate]) -> UpdateFigures:
    """Repeats updates with the covariances of a verifier."""
    nll, nees = np.zeros((2, len(updates)))
    with torch.no_grad():
        for k, update in enumerate(updates):
            found = update.repeat(verifier)
            nll[k] = -float(update.log_likelihood(found))
            nees[k] = float(update.nees(found)) / _DEGREES_OF_FREEDOM
    return UpdateFigures(len(updates), *(float(f(x)) for x in (nll, nees) for f in (np.mean, np.median)))


def tune(
    verifier: TunedVerifier,
    updates: Sequence[RecordedUpdate],
    epochs: int,
    seed: int,
    note: Callable[[int, float], None] = lambda seen, loss: None,
) -> None:
    """Trains in place: each update once an epoch, in random order, eight in a step.

    Args:
        verifier: whose part is trained.
        updates: to learn from.
        epochs: times that each is seen.
        seed: of their order.
        note: is told after each step how many updates were seen in all, and the step's loss.
    """
    rng = np.random.default_rng(seed)
    optimizer = torch.optim.Adam(verifier.parameters(), _LEARNING_RATE)
    seen = 0
    for _ in range(epochs):
        order = rng.permutation(len(updates))
        for batch in np.split(order, range(_BATCH, len(order), _BATCH)):
            optimizer.zero_grad()
            total = 0.0
            for index in batch:  # one by one: frames see different numbers of landmarks
                update = updates[index]
                loss = -update.log_likelihood(update.repeat(verifier)) / len(batch)
                loss.backward()
                total += float(loss.detach())
            nn.utils.clip_grad_norm_(verifier.parameters(), _MAX_GRADIENT)
            optimizer.step()
            seen += len(batch)
            note(seen, total)


def track(sequence: StereoSequence, truth: Trajectory, verifier: nn.Module) -> RunFigures:
    """Tracks a rendered sequence with a verifier of places, float32, and the other networks that ship."""
    config, estimator = TrackerConfig(), _Estimator(verifier)
    detector = LearnedDetector(config.max_keypoints, threads=1)
    tracker = StereoTracker(sequence.camera, DescriptorFrontend("learned", detector, estimator), threads=1)
    frames = [tracker.step(frame.left, frame.right, frame.timestamp) for frame in sequence.frames()]
    tracked = [each for each in frames if each.status == "tracking"]
    known = [each for each in frames if each.has_pose]
    if not tracked:
        raise InputError(f"{sequence.source}: no frame could be tracked: take another sequence to test on")
    trajectory = Trajectory(
        np.array([each.timestamp for each in known]), np.stack([each.T_world_camera for each in known])
    )
    return RunFigures(
        sequence.source.name if isinstance(sequence.source, Path) else str(sequence.source),
        absolute_trajectory_error(trajectory, truth).rmse,
        pose_nees(trajectory, truth, np.stack([each.covariance for each in known])).mean,
        float(np.median([each.nis / each.dof for each in tracked])),
        len(tracked),
    )


class _Estimator(ConfidenceEstimator):
    """With another verifier of places."""

    def __init__(self, verifier: nn.Module) -> None:
        super().__init__()
        self._place_verifier = TorchModule(verifier)


def format_figures(
    updates: dict[str, tuple[UpdateFigures, UpdateFigures]], runs: Sequence[tuple[RunFigures, RunFigures]]
) -> str:
    """Both tables in Markdown, figures before and after.

    Args:
        updates: by the name of the set.
        runs: of the sequences that were not learned from.
    """
    lines = [
        "| updates | | NLL: mean (median) | NEES per degree of freedom: mean (median) |",
        "|---|---|---|---|",
    ]
    for name, pair in updates.items():
        for when, each in zip(("shipped", "tuned"), pair, strict=True):
            nll, nees = f"{each.nll:.2f} ({each.nll_median:.2f})", f"{each.nees:.2f} ({each.nees_median:.2f})"
            lines.append(f"| {name}, {each.count} | {when} | {nll} | {nees} |")
    lines += ["", "| whole run | tracked | ATE mm | ratio | NEES | NIS, median |", "|---|---|---|---|---|---|"]
    for before, after in runs:
        cells = [f"{before.tracked} -> {after.tracked}", f"{1e3 * before.ate:.3g} -> {1e3 * after.ate:.3g}"]
        cells.append(f"{after.ate / before.ate:.2f}")
        cells += [f"{a:.2f} -> {b:.2f}" for a, b in ((before.nees, after.nees), (before.nis, after.nis))]
        lines.append(f"| {before.name} | {' | '.join(cells)} |")
    ratios = [
        np.exp(np.mean([np.log(getattr(after, name) / getattr(before, name)) for before, after in runs]))
        for name in ("ate", "nees", "nis")
    ]
    ate, nees, nis = (f"{ratio:.2f}" for ratio in ratios)
    return "\n".join([*lines, f"| ratio, geometric mean | | | {ate} | {nees} | {nis} |"])


def main(argv: Sequence[str] | None = None) -> None:
    """Records, trains, measures; prints the figures, progress goes to the standard error."""
    parser = argparse.ArgumentParser(
        prog="python -m sigmaslam.training.filter_tuning", description="\n\n".join((__doc__ or "").split("\n\n")[1:])
    )
    add = parser.add_argument
    made_by = "rendered sequences, made by 'sigmaslam render NAME --out FOLDER --truth sparse'"
    add("--train", nargs="+", type=Path, required=True, metavar="FOLDER", help=f"to learn from: {made_by}")
    add("--test", nargs="+", type=Path, required=True, metavar="FOLDER", help="to measure on: others of them")
    add("--out", type=Path, required=True, metavar="FOLDER", help=f"new: {PLACE_VERIFIER_NAME} and {FIGURES_NAME}")
    add("--part", choices=PARTS, default=PARTS[0], help="train the last layer, or gain and shift of log sigma alone")
    add("--epochs", type=int, default=4, metavar="N", help="times that each update is seen (%(default)s)")
    add("--seed", type=int, default=0, metavar="N", help="of their order (%(default)s)")
    try:
        print(run(parser.parse_args(argv)))
    except SigmaSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def run(options: argparse.Namespace) -> str:
    """What the command line asks for; returns the tables.

    Raises:
        InputError: an option is out of range, a sequence is in both sets or cannot be read, or the folder is not empty.
    """
    if options.epochs < 1 or options.seed < 0:
        raise InputError(f"--epochs is {options.epochs}, --seed {options.seed}: give at least 1, and 0 or more")
    both = {folder.resolve() for folder in options.train} & {folder.resolve() for folder in options.test}
    if both:
        raise InputError(f"{min(both)} is in --train and in --test: what is learned from measures nothing")
    check_new_folder(options.out)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    train, test = ([_open(folder) for folder in folders] for folders in (options.train, options.test))
    shipped = load_verifier(shipped_weights(PLACE_VERIFIER_NAME), PLACE_COLUMNS)
    tuned = TunedVerifier(shipped, options.part)
    with open_progress() as progress:

        def bar(name: str, total: int) -> Callable[[int, str], None]:
            task = progress.add_task(name, total=total, note="")
            return lambda done, text: progress.update(task, completed=done, note=text)

        sets: dict[str, list[RecordedUpdate]] = {}
        for name, sequences in (("train", train), ("test", test)):
            note, sets[name] = bar(f"recording {name}", len(sequences)), []
            for k, pair in enumerate(sequences):
                note(k, str(pair[0].source))
                sets[name] += record_updates(*pair)
            note(len(sequences), "")
        note = bar("measuring", 4 + 2 * len(test))
        before = {name: assess(tuned, updates) for name, updates in sets.items()}
        note(2, "")
        told = bar("training", options.epochs * len(sets["train"]))
        tune(tuned, sets["train"], options.epochs, options.seed, lambda seen, loss: told(seen, f"loss {loss:.2f}"))
        figures = {name: (before[name], assess(tuned, updates)) for name, updates in sets.items()}
        after = MatchVerifier(PLACE_COLUMNS)
        after.load_state_dict(tuned.state())
        runs: list[tuple[RunFigures, RunFigures]] = []
        for k, pair in enumerate(test):
            note(4 + 2 * k, str(pair[0].source))
            one, other = (track(*pair, MatchCovariance(each)) for each in (shipped, after.eval()))
            runs.append((one, other))
        note(4 + 2 * len(test), "")
    _write(options, tuned, figures, runs)
    return format_figures(figures, runs)


def _write(
    options: argparse.Namespace,
    tuned: TunedVerifier,
    figures: dict[str, tuple[UpdateFigures, UpdateFigures]],
    runs: Sequence[tuple[RunFigures, RunFigures]],
) -> None:
    content: dict[str, Any] = {"part": options.part, "epochs": options.epochs, "seed": options.seed}
    content |= {name: [folder.name for folder in getattr(options, name)] for name in ("train", "test")}
    content["updates"] = {name: [asdict(each) for each in pair] for name, pair in figures.items()}
    content["runs"] = [[asdict(each) for each in pair] for pair in runs]
    make_folder(options.out)
    with atomic_path(options.out / PLACE_VERIFIER_NAME) as path:
        save_file(tuned.state(), path)
    atomic_write_text(options.out / FIGURES_NAME, json.dumps(content, indent=2) + "\n")


def _open(folder: Path) -> tuple[StereoSequence, Trajectory]:
    truth = rendered_truth(folder)
    if not truth.is_file():
        raise InputError(f"{folder} has no {truth.name}: render it by `sigmaslam render NAME --truth sparse`")
    return open_rendered(folder), read_trajectory(truth)


if __name__ == "__main__":
    main()

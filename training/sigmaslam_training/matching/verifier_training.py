"""Trains the match verifier on refined matches of rendered pairs, and calibrates it on others."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits

from sigmaslam.errors import SigmaSlamError
from sigmaslam.estimation.chi_square import NORMAL_WITHIN_2
from sigmaslam.frontend.affine_alignment import refine_by_neighbours
from sigmaslam.frontend.lucas_kanade import refine
from sigmaslam.frontend.match_confidence import MIN_LOGIT
from sigmaslam.frontend.patch_evidence import Evidence, examine_patches
from sigmaslam.frontend.types import Refinement
from sigmaslam.frontend.verifier_inputs import describe_matches
from sigmaslam.table import Table
from sigmaslam_evaluation.metrics.probability_calibration import RIGHT
from sigmaslam_models.scorer_network import MatchScorer
from sigmaslam_models.verifier_network import MatchVerifier
from sigmaslam_training.matching.match_sets import MatchSet, PairRecord
from sigmaslam_training.matching.scorer_training import score_set
from sigmaslam_training.small_loop import train_steps

_LEARNING_RATE = 3e-3
_BATCH = 4096
# Degrees of freedom of Student's t: few near-misses among the right matches must not widen the sigma of all.
_FREEDOM = 20.0
# Pairs whose images differ by more than a shift are refined by the neighbours' maps alone.
_SHIFTED = ("stereo", "scenes", "video")
_MAPPED = ("planes", "turned planes", "scenes", "video")
_FAR = 1e3


@dataclass(frozen=True, slots=True)
class VerifierRows(Table):
    """Refined matches of many pairs.

    Attributes:
        inputs: (M, C) as the verifier takes them.
        error: (M, 2) of the refined place along the patch's axes, pixels; very large where there is no truth.
        pair: (M,) which pair each is of.
    """

    inputs: np.ndarray
    error: np.ndarray
    pair: np.ndarray

    @property
    def right(self) -> np.ndarray:
        """(M,) bool, within 3 px of the truth."""
        return np.asarray(np.linalg.norm(self.error, axis=1) < RIGHT)


def collect_rows(records: Iterable[PairRecord], scorer: MatchScorer, note: Callable[[int], None]) -> VerifierRows:
    """Refines the matches of all records as the run time does.

    Args:
        records: pairs with their sets.
        scorer: trained.
        note: is told how many records are done.
    """
    parts = []
    for number, record in enumerate(records):
        for found in record.sets.values():
            logit = score_set(scorer, found)
            kept = found.putative.mutual & (logit > MIN_LOGIT)
            for mapped, sources in ((False, _SHIFTED), (True, _MAPPED)):
                if found.source in sources and kept.any():
                    parts.append(_rows_of(record, found, logit, kept, mapped, number))
        note(number + 1)
    if not parts:
        raise SigmaSlamError("the scorer finds no match likely in any pair: train it longer, or on more pairs")
    return VerifierRows.concatenate(parts)


def _rows_of(
    record: PairRecord, found: MatchSet, logit: np.ndarray, kept: np.ndarray, mapped: bool, number: int
) -> VerifierRows:
    putative = found.putative.select(kept)
    points0 = found.features0.keypoints[putative.index0].astype(np.float64)
    points1 = found.features1.keypoints[putative.index1].astype(np.float64)
    refinement: Refinement
    if mapped:
        refinement = refine_by_neighbours(record.image0, record.image1, points0, points1, logit[kept])
    else:
        refinement = refine(record.image0, record.image1, points0, points1)
    evidence = examine_patches(record.image0, record.image1, points0, refinement.places, refinement.A)
    sigma0, sigma1 = found.features0.sigma[putative.index0], found.features1.sigma[putative.index1]
    columns = describe_matches(logit[kept], evidence, refinement, sigma0, sigma1)
    error = error_along_axes(evidence, refinement.places, found.places[kept])
    return VerifierRows(columns, error, np.full(len(columns), number))


def error_along_axes(evidence: Evidence, places: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(M, 2) float32 places less true ones along the patches' axes, pixels; very large where the truth is infinite."""
    error = np.nan_to_num(places - truth, nan=_FAR, posinf=_FAR, neginf=-_FAR)
    along_axes = np.einsum("mji,mj->mi", evidence.axes, np.clip(error, -_FAR, _FAR))
    return np.asarray(along_axes, np.float32)


def verifier_loss(logit: Tensor, log_sigma: Tensor, error: Tensor) -> Tensor:
    """Cross-entropy of right and wrong, and for the right ones Student's t likelihood of their error.

    Args:
        logit: (M,).
        log_sigma, error: (M, 2) along the patches' axes.
    """
    right = (error.norm(dim=1) < RIGHT).to(logit.dtype)
    square = (error.square() * torch.exp(-2.0 * log_sigma)).sum(dim=1)
    likelihood = log_sigma.sum(dim=1) + 0.5 * (_FREEDOM + 2.0) * torch.log1p(square / _FREEDOM)
    return binary_cross_entropy_with_logits(logit, right) + (likelihood * right).sum() / right.sum().clamp_min(1.0)


def train_verifier(
    rows: VerifierRows, steps: int, seed: int, checkpoint: Path, note: Callable[[int, str], None]
) -> MatchVerifier:
    """Trains from random weights, or goes on from the checkpoint.

    Args:
        rows: to learn from.
        steps, seed, checkpoint, note: as `train_scorer` takes them.
    Raises:
        InputError, KeyboardInterrupt: as there.
    """
    torch.manual_seed(seed)
    verifier = MatchVerifier(rows.inputs.shape[1])
    columns, error = torch.from_numpy(rows.inputs), torch.from_numpy(rows.error)
    verifier.mean.copy_(columns.mean(dim=0))
    verifier.spread.copy_(columns.std(dim=0) + 1e-3)
    optimizer = torch.optim.AdamW(verifier.parameters(), _LEARNING_RATE, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _LEARNING_RATE, total_steps=steps)

    def losses(done: int) -> Iterator[Tensor]:
        generator = torch.Generator().manual_seed(seed)
        for step in count():
            batch = torch.randint(len(columns), (_BATCH,), generator=generator)
            if step >= done:
                logit, log_sigma = verifier(columns[batch])
                yield verifier_loss(logit, log_sigma, error[batch])

    made_of = {"steps": steps, "seed": seed, "rows": len(columns)}
    train_steps(verifier, optimizer, schedule, steps, losses, checkpoint, made_of, note)
    return verifier


def calibrate(verifier: MatchVerifier, rows: VerifierRows) -> None:
    """Fits the numbers that turn what it learned into probabilities and sigmas that hold, on held-out pairs.

    Scale and shift of the logit by likelihood (Platt 1999); the scale of sigma such that as many errors of right
    matches lie within two sigma, along either axis, as of a normal error.
    """
    with torch.no_grad():
        logit, log_sigma = verifier(torch.from_numpy(rows.inputs))
    right = torch.from_numpy(rows.right)
    scale, shift = torch.ones((), requires_grad=True), torch.zeros((), requires_grad=True)
    optimizer = torch.optim.LBFGS([scale, shift], max_iter=100, line_search_fn="strong_wolfe")

    def likelihood() -> Tensor:
        optimizer.zero_grad()
        loss = binary_cross_entropy_with_logits(scale * logit + shift, right.to(logit.dtype))
        loss.backward()
        return loss

    optimizer.step(likelihood)
    deviation = (torch.from_numpy(rows.error)[right] * torch.exp(-log_sigma[right])).abs().flatten()
    with torch.no_grad():
        verifier.logit_shift.copy_(scale * verifier.logit_shift + shift)
        verifier.logit_scale.copy_(scale * verifier.logit_scale)
        verifier.sigma_scale.mul_(torch.quantile(deviation, NORMAL_WITHIN_2) / 2.0)

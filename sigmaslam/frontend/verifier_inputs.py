"""Inputs of the match verifier: columns that describe refined matches."""

from enum import Enum, auto

import numpy as np

from sigmaslam.frontend.patch_evidence import Evidence
from sigmaslam.frontend.types import Refinement

# There the scorer errs once in 3,000: more is no better. The verifier was trained within it.
_MAX_LOGIT = 8.0
# Pixels from where the neighbours have a match: more is no worse, and infinite where there are none.
_MAX_DISTANCE = 50.0


class PlaceSearch(Enum):
    """How places were found without features of image 1."""

    IN_TIME = auto()  # near a prediction, in a later image
    ALONG_ROWS = auto()  # in the other eye, anywhere along the row
    PREDICTED_ALONG_ROWS = auto()  # in the other eye, near a predicted disparity


def describe_matches(
    logit: np.ndarray, evidence: Evidence, refinement: Refinement, sigma0: np.ndarray, sigma1: np.ndarray
) -> np.ndarray:
    """The columns that the verifier takes.

    Args:
        logit: (M,) of the scorer.
        evidence: of the patches at the refined places.
        refinement: of the matches.
        sigma0, sigma1: (M,) of the keypoints of either image, pixels.
    Returns:
        (M, 14) float32: logit / 4; logs of half the squared difference of the patches, of both contrasts and both
        sharpnesses; moves along both axes; whether refined, whether by the neighbours' map; logs of both sigmas and
        of the spacing; distance from the neighbours' map.
    """
    shift = _along_axes(evidence, refinement.places - refinement.start)
    distance = np.zeros(len(logit)) if refinement.distance is None else refinement.distance
    return np.column_stack(
        [
            np.clip(logit, -_MAX_LOGIT, _MAX_LOGIT) / 4.0,
            *_appearance(evidence),
            np.log1p(np.abs(shift)),
            refinement.moved,
            np.full(len(logit), refinement.A is not None),
            np.log(sigma0 * evidence.zoom + 0.05),
            np.log(sigma1 + 0.05),
            np.log(evidence.spacing),
            np.log1p(np.minimum(distance, _MAX_DISTANCE)),
        ]
    ).astype(np.float32)


def describe_places(
    departure: np.ndarray, spread: np.ndarray, evidence: Evidence, sigma0: np.ndarray, search: PlaceSearch
) -> np.ndarray:
    """The columns that the verifier of places takes, which were found without features of image 1.

    Args:
        departure: (M, 2) from where the neighbours would have each place, pixels; `compare_with_neighbours`.
        spread: (M,) of the neighbours' own departures.
        evidence: of the patches at the places.
        sigma0: (M,) of the keypoints of image 0, pixels.
        search: how the places were found.
    Returns:
        (M, 12) float32: log of the spread; logs of half the squared difference of the patches, of both contrasts and
        both sharpnesses; departures along both axes; whether in time, whether predicted; logs of sigma and of the
        spacing.
    """
    return np.column_stack(
        [
            np.log(spread + 0.1),
            *_appearance(evidence),
            np.log1p(np.minimum(np.abs(_along_axes(evidence, departure)), _MAX_DISTANCE)),
            np.full(len(spread), search is PlaceSearch.IN_TIME),
            np.full(len(spread), search is not PlaceSearch.ALONG_ROWS),
            np.log(sigma0 * evidence.zoom + 0.05),
            np.log(evidence.spacing),
        ]
    ).astype(np.float32)


def _appearance(evidence: Evidence) -> tuple[np.ndarray, ...]:
    return (
        np.log(0.5 * (1.0 - evidence.correlation) + 1e-3),
        np.log(evidence.contrast0),
        np.log(evidence.contrast1),
        np.log(evidence.sharpness + 1e-3),
    )


def _along_axes(evidence: Evidence, offset: np.ndarray) -> np.ndarray:
    """(M, 2) offsets (M, 2) in pixels of image 1 along the patches' axes, in samples."""
    return np.asarray(np.einsum("mji,mj->mi", evidence.axes, offset) / evidence.spacing[:, None])

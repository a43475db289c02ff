"""Regions of an image, and cells: what is crowded in one place counts no more than what covers as much of the image."""

import numpy as np

# Along the image's longer and its shorter side.
_LONGER, _SHORTER = 6, 4
CELLS = _LONGER * _SHORTER


def image_cells(places: np.ndarray, width: int, height: int) -> np.ndarray:
    """(M,) number of the cell, from 0 to `CELLS` - 1, that each of the places (M, 2), pixels, is in."""
    columns, rows = (_LONGER, _SHORTER) if width >= height else (_SHORTER, _LONGER)
    place = np.clip((places / (width, height) * (columns, rows)).astype(np.int64), 0, (columns - 1, rows - 1))
    return np.asarray(place[:, 0] + columns * place[:, 1])


def explained_area(cells: np.ndarray, chosen: np.ndarray, weight: np.ndarray) -> float:
    """Share of the image that some places stand for: of each cell with places the share of its own.

    Args:
        cells: (M,) of all places, as of `image_cells`.
        chosen: (M,) bool.
        weight: (M,) of each place.
    """
    agreeing, present = (np.bincount(cells, each, CELLS) for each in (weight * chosen, weight))
    seen = present > 0.0
    return float(np.mean(agreeing[seen] / present[seen])) if seen.any() else 0.0


def pixels_in(region: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Which pixels (N, 2) (u, v) are in a region (H, W) bool; (N,) bool."""
    height, width = region.shape
    column, row = np.clip(np.rint(pixels), 0, (width - 1, height - 1)).astype(int).T
    return np.asarray(region[row, column])

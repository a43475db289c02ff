"""What the learned response of the detector is trained by: whether a place would be matched rightly."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from sigmaslam_models.detector import BORDER, CELL, pick_peaks, to_cells
from sigmaslam_models.feature_network import FeatureNetwork

Transfer = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
"""From points (N, 2) of image 0 to places (N, 2) in image 1, and whether they are seen there (N,) bool."""

# A match is right within so many pixels, and worth the less the farther it is from its place.
_RIGHT = 3.0
# Pixels a keypoint: 1,024 in an image of 640x480.
_PIXELS = 300
# A place is drawn from each of so many squares of so many pixels a side, this often. As many keypoints of the other
# image are asked whether they match: were they as few as are kept, being kept would be its own reward.
_SQUARE, _SQUARES_PER_KEYPOINT, _DRAWS = 8, 2, 4
# Of keypoints nearer than this the stronger one alone is a maximum.
_SUPPRESSED = 1.5


class _Squares(NamedTuple):
    """Of an image, S squares of 64 pixels: values (S, 64), and pixels (S, 64, 2) (u, v)."""

    values: Tensor
    pixels: Tensor


class _Nearest(NamedTuple):
    """Of points (M,): index of the keypoint of image 1 that resembles them most, and whether they resemble it most."""

    partner: Tensor
    best: Tensor


def detector_loss(
    network: FeatureNetwork, image0: Tensor, image1: Tensor, transfer: Transfer, generator: torch.Generator
) -> Tensor:
    """Minus the mean worth of keypoints of image 0 that lie in image 1; its gradient reaches the response alone.

    In each square of pixels places are drawn by their response, as in DISK (Tyszkiewicz 2020), and those that match
    better than the others drawn there are made more likely: each draw's baseline is the mean of the others. Squares
    take part with a probability that rises with their largest response, about a threshold that as many exceed as
    there are keypoints; those whose maximum is worth more than that of a square at the threshold gain.

    Args:
        network: with a response; in evaluation mode.
        image0, image1: (1, H, W) float32 in [0, 1], H and W multiples of 16.
        transfer: between them, exact.
        generator: of the draws.
    """
    assert network.response is not None
    cells = to_cells(torch.stack([image0, image1]))
    count = image0.shape[-1] * image0.shape[-2] // _PIXELS
    with torch.no_grad():
        maps = network(cells)
        quality = functional.interpolate(maps.quality, scale_factor=2.0, mode="bilinear", align_corners=False)
    # The extractor ranks by the root of the response times the quality.
    strength = network.response(cells, maps.fine) * quality.sigmoid().square()
    with torch.no_grad():
        keypoints, strongest = pick_peaks(strength, strength, _SQUARES_PER_KEYPOINT * count)
        descriptors = network.describe(maps, keypoints)
        known = strongest > 0
    squares = _squares(functional.pixel_shuffle(strength[:1], CELL)[0, 0])
    largest = squares.values.amax(dim=1)
    chosen = largest.detach().topk(min(_SQUARES_PER_KEYPOINT * count, len(largest))).indices
    chosen = chosen[largest[chosen] > 0]
    logarithm = squares.values[chosen].clamp_min(1e-12).log()
    likelihood = logarithm.log_softmax(dim=1)
    with torch.no_grad():
        draws = torch.multinomial(likelihood.exp(), _DRAWS, replacement=True, generator=generator)
        picked = torch.cat([logarithm.argmax(dim=1, keepdim=True), draws], dim=1)
        points = squares.pixels[chosen].gather(1, picked.unsqueeze(-1).expand(-1, -1, 2)).flatten(0, 1)
        described = network.describe(type(maps)(*(each[:1] for each in maps)), points[None])[0]
        mutual = _partners(
            points, described, keypoints[0][known[0]], descriptors[0][known[0]], descriptors[1][known[1]]
        )
        places, seen = (torch.from_numpy(each) for each in transfer(points.double().numpy()))
        distance = (keypoints[1][known[1]][mutual.partner] - places.float()).norm(dim=1)
        right = mutual.best & seen & (distance < _RIGHT)
        reward = torch.where(right, 1.0 - distance / _RIGHT, 0.0).view(picked.shape)
        # What is hidden there is no match; what leaves the image is nobody's fault.
        last = torch.tensor([image1.shape[-1] - 1, image1.shape[-2] - 1])
        inside = ((places >= 0) & (places <= last)).all(dim=1).view(picked.shape)
        drawn = reward[:, 1:]
        others = (drawn.sum(dim=1, keepdim=True) - drawn) / (_DRAWS - 1)
        advantage = torch.where(inside[:, 1:], drawn - others, 0.0)
    drawing = (advantage * likelihood.gather(1, draws)).sum()
    level = largest[chosen].clamp_min(1e-12).log()
    with torch.no_grad():
        threshold = level.topk(min(count, len(level))).values[-1]
        spread = level.std().clamp_min(1e-3)
    part = ((level - threshold) / spread).sigmoid()
    with torch.no_grad():
        weight = torch.where(inside[:, 0], part * (1.0 - part), 0.0)
        worth = (weight * reward[:, 0]).sum() / weight.sum().clamp_min(1e-6)
        gain = torch.where(inside[:, 0], reward[:, 0] - worth, 0.0)
        mean = (part * reward[:, 0]).sum() / (part * inside[:, 0]).sum().clamp_min(1e-6)
    surrogate = (drawing + (part * gain).sum()) / count
    return surrogate.detach() - surrogate - mean


def _squares(image: Tensor) -> _Squares:
    """The squares of (H, W), zero at the border where there are no keypoints."""
    height, width = image.shape
    inner = torch.zeros_like(image)
    inner[BORDER:-BORDER, BORDER:-BORDER] = 1.0
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    values, u, v = (
        each.view(height // _SQUARE, _SQUARE, width // _SQUARE, _SQUARE).transpose(1, 2).reshape(-1, _SQUARE**2)
        for each in (image * inner, columns.float(), rows.float())
    )
    return _Squares(values, torch.stack([u, v], dim=-1))


def _partners(
    points: Tensor, described: Tensor, keypoints0: Tensor, descriptors0: Tensor, descriptors1: Tensor
) -> _Nearest:
    """Nearest neighbours of points (M, 2) of image 0 if each, alone, took the place of the keypoints next to it."""
    similarity = described @ descriptors1.T
    best, partner = similarity.max(dim=1)
    rivals = (descriptors0 @ descriptors1.T).T[partner]
    replaced = torch.cdist(points, keypoints0, compute_mode="donot_use_mm_for_euclid_dist") < _SUPPRESSED
    return _Nearest(partner, best >= rivals.masked_fill(replaced, -1.0).amax(dim=1))

"""Losses of a batch of pairs: descriptors, quality, sigma, and the response that detects."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from sigmaslam_models.detector import detect, pick_peaks, to_cells
from sigmaslam_models.feature_network import FeatureMaps, FeatureNetwork, sample_map
from sigmaslam_models.learned_response import LEAST
from sigmaslam_training.detector.view_store import Places, Views, sample, transfer
from sigmaslam_training.features.losses import place_loss

_RIGHT = 3.0  # pixels: a match is right, a keypoint has a partner
_CLASH = 4.0  # nearer keypoints are no distractors
_JITTER = 0.7
_MARGIN = 4.0
_TEMPERATURE = 20.0
_WINDOW = 4  # windows of 9x9 pixels
_MIN_SEEN = 0.6  # share of a window


class JointLoss(NamedTuple):
    """Terms, and what there is to watch."""

    descriptor: Tensor
    quality: Tensor
    odds: Tensor
    agreement: Tensor
    place: Tensor
    recall: Tensor
    right: Tensor
    right_hessian: Tensor
    repeated: Tensor
    seen: Tensor


class _Matched(NamedTuple):
    """Of keypoints (2B, K): whether they have a label, whether they match rightly, distance to the nearest keypoint."""

    counts: Tensor
    right: Tensor
    nearest: Tensor
    partner: Tensor
    places: Places


def joint_loss(
    network: FeatureNetwork,
    images: Tensor,
    views: Views,
    keypoints: int,
    points: int,
    anchors: int,
    generator: torch.Generator,
) -> JointLoss:
    """Losses of B pairs.

    Args:
        network: with a response, in training.
        images: (2B, 1, H, W); image k goes with image k + B.
        views: of the same.
        keypoints, points, anchors: of an image: detected, described, and windows in which responses are compared.
        generator: of the device.
    """
    total, half = len(images), len(images) // 2
    other = torch.arange(total, device=images.device).roll(half)
    target = views.take(other)
    cells = to_cells(images)
    maps = network(cells)
    assert network.response is not None
    response = network.response(cells, maps.fine)
    logarithm = response.clamp_min(1e-3).log()
    with torch.no_grad():
        found, strength = pick_peaks(response.detach(), response.detach(), keypoints, LEAST)
        blobs, blob_strength = detect(cells, keypoints)
    described = network.describe(maps, found)
    with torch.no_grad():
        matched = _match(views, target, other, found, strength > 0, described)
        blob_matched = _match(views, target, other, blobs, blob_strength > 0, network.describe(maps, blobs))
    odds = _cross_entropy(sample(logarithm, found), matched)
    quality = _cross_entropy(sample_map(maps.quality, found).squeeze(-1), matched)
    quality_blobs = _cross_entropy(sample_map(maps.quality, blobs).squeeze(-1), blob_matched)
    log_sigma = sample_map(maps.log_sigma, found).squeeze(-1)
    zoom = _zoom(found, matched.places.pixels, matched.counts)
    place = place_loss(
        matched.nearest,
        log_sigma,
        log_sigma[other].gather(1, matched.partner),
        zoom,
        matched.counts & (matched.nearest < _RIGHT),
    )
    agreement = _agreement(logarithm, views, target, other, found, matched, anchors, generator)
    descriptor, recall = _descriptor_loss(
        network, maps, views, target, other, found, strength > 0, blobs, described, points, generator
    )
    count = matched.counts.float().sum().clamp_min(1.0)
    return JointLoss(
        descriptor,
        quality + quality_blobs,
        odds,
        agreement,
        place,
        recall,
        (matched.right & matched.counts).float().sum() / count,
        (blob_matched.right & blob_matched.counts).float().sum() / blob_matched.counts.float().sum().clamp_min(1.0),
        (matched.counts & (matched.nearest < 1.0)).float().sum() / count,
        count / matched.counts.numel(),
    )


def _match(views: Views, target: Views, other: Tensor, found: Tensor, known: Tensor, described: Tensor) -> _Matched:
    places = transfer(views, target, found)
    size = views.depth.shape[-1]
    inner = ((places.pixels >= 8.0) & (places.pixels <= size - 9.0)).all(dim=-1)
    there, known_there = found[other], known[other]
    distance = torch.cdist(places.pixels, there, compute_mode="donot_use_mm_for_euclid_dist")
    distance = distance.masked_fill(~known_there.unsqueeze(1), 1e4)
    similarity = described @ described[other].transpose(1, 2)
    similarity = similarity.masked_fill(~known_there.unsqueeze(1) | ~known.unsqueeze(2), -2.0)
    best = similarity.argmax(dim=2)
    mutual = similarity.argmax(dim=1).gather(1, best) == torch.arange(found.shape[1], device=found.device)
    right = mutual & places.visible & (distance.gather(2, best.unsqueeze(-1)).squeeze(-1) < _RIGHT)
    nearest, partner = distance.min(dim=2)
    return _Matched(places.visible & known & inner, right, nearest, partner, places)


def _cross_entropy(logit: Tensor, matched: _Matched) -> Tensor:
    weight = matched.counts.to(logit.dtype)
    loss = functional.binary_cross_entropy_with_logits(logit, matched.right.to(logit.dtype), reduction="none")
    return (loss * weight).sum() / weight.sum().clamp_min(1.0)


def _agreement(
    logarithm: Tensor,
    views: Views,
    target: Views,
    other: Tensor,
    found: Tensor,
    matched: _Matched,
    anchors: int,
    generator: torch.Generator,
) -> Tensor:
    """Cross entropy between where a window has its peak in one image and in the other, seen through the geometry.

    Windows lie anywhere, not on cells: a response that prefers some pixels of a cell agrees with nothing.
    """
    total, size, device = len(found), logarithm.shape[-1], found.device
    first = torch.rand(found.shape[:2], generator=generator, device=device) + matched.counts.float()
    chosen = first.topk(anchors // 2, dim=1).indices
    at_peaks = found.gather(1, chosen.unsqueeze(-1).expand(-1, -1, 2))
    at_peaks = at_peaks + (2 * _WINDOW - 2) * (torch.rand(at_peaks.shape, generator=generator, device=device) - 0.5)
    anywhere = size * torch.rand((total, anchors - anchors // 2, 2), generator=generator, device=device)
    centre = torch.cat([at_peaks, anywhere], dim=1).round().clamp(8 + _WINDOW, size - 9 - _WINDOW)
    steps = torch.arange(-_WINDOW, _WINDOW + 1, device=device, dtype=centre.dtype)
    offsets = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), dim=-1).view(1, 1, -1, 2)
    pixels = centre.unsqueeze(2) + offsets
    flat = pixels.flatten(1, 2)
    places = transfer(views, target, flat)
    shape = pixels.shape[:3]
    here = logarithm.flatten(1).gather(1, (flat[..., 1] * size + flat[..., 0]).long()).view(shape)
    there = sample(logarithm[other], places.pixels).view(shape)
    seen = places.visible.view(shape)
    here, there = (each.masked_fill(~seen, -1e4).log_softmax(dim=2) for each in (here, there))
    cross = -(here.exp() * there + there.exp() * here).masked_fill(~seen, 0.0).sum(dim=2)
    with torch.no_grad():
        useful = (seen.float().mean(dim=2) >= _MIN_SEEN).float()
        level = logarithm.detach().flatten(1).gather(1, (flat[..., 1] * size + flat[..., 0]).long()).view(shape)
        weight = useful * (0.1 + level.amax(dim=2).sigmoid())
    return (cross * weight).sum() / weight.sum().clamp_min(1.0)


def _descriptor_loss(
    network: FeatureNetwork,
    maps: FeatureMaps,
    views: Views,
    target: Views,
    other: Tensor,
    found: Tensor,
    known: Tensor,
    blobs: Tensor,
    described: Tensor,
    points: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Dual softmax over places in the other image and keypoints elsewhere; and the recall."""
    device, size = found.device, views.depth.shape[-1]

    def some(keypoints: Tensor, count: int) -> Tensor:
        order = torch.rand(keypoints.shape[:2], generator=generator, device=device)
        seen = transfer(views, target, keypoints).visible
        chosen = (order + seen.float()).topk(count, dim=1).indices
        return keypoints.gather(1, chosen.unsqueeze(-1).expand(-1, -1, 2))

    anywhere = 8 + (size - 17) * torch.rand((len(found), points // 8, 2), generator=generator, device=device)
    with torch.no_grad():
        source = torch.cat([some(found, points // 2), some(blobs, points - points // 2 - points // 8), anywhere], dim=1)
        places = transfer(views, target, source)
        visible = places.visible & ((places.pixels >= _MARGIN) & (places.pixels <= size - 1 - _MARGIN)).all(dim=-1)
        shaken = places.pixels + _JITTER * torch.randn(source.shape, generator=generator, device=device)
        clash = torch.cdist(places.pixels, found[other], compute_mode="donot_use_mm_for_euclid_dist") < _CLASH
        useless = ~known[other].unsqueeze(1) | clash
        # Places of two points that lie on each other would push each other away.
        near = torch.cdist(places.pixels, places.pixels, compute_mode="donot_use_mm_for_euclid_dist") < _CLASH
        near &= ~torch.eye(points, dtype=torch.bool, device=device)
    own = network.describe(maps, source)
    there = FeatureMaps(*(each[other] for each in maps))
    partner = network.describe(there, shaken)
    similarity = _TEMPERATURE * own @ torch.cat([partner, described[other]], dim=1).transpose(1, 2)
    hidden = ~visible.unsqueeze(1) | near
    hidden = torch.where(torch.eye(points, dtype=torch.bool, device=device), ~visible.unsqueeze(1), hidden)
    similarity = similarity.masked_fill(torch.cat([hidden, useless], dim=2), -1e4)
    forward = similarity.log_softmax(dim=2)[:, :, :points].diagonal(dim1=1, dim2=2)
    backward = similarity[:, :, :points].log_softmax(dim=1).diagonal(dim1=1, dim2=2)
    weight = visible.to(similarity.dtype)
    count = weight.sum().clamp_min(1.0)
    with torch.no_grad():
        rows = torch.arange(points, device=device)
        best = (similarity.argmax(dim=2) == rows) & (similarity[:, :, :points].argmax(dim=1) == rows) & visible
    return -((forward + backward) * weight).sum() / count, best.float().sum() / count


def _zoom(keypoints: Tensor, places: Tensor, visible: Tensor) -> Tensor:
    """(B, 1) by how much lengths grow from image to image, from the spread of the visible points."""
    weight = visible.to(places.dtype).unsqueeze(-1)
    total = weight.sum(dim=1, keepdim=True).clamp_min(1.0)

    def spread(points: Tensor) -> Tensor:
        centred = (points - (points * weight).sum(dim=1, keepdim=True) / total) * weight
        return centred.square().sum(dim=(1, 2)).clamp_min(1.0)

    return (spread(places) / spread(keypoints)).sqrt().clamp(0.2, 5.0).unsqueeze(1)

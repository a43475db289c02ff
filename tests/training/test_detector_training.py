"""What the detector's response is trained by: partners by hand, gradients that favour what matches, runs that go on."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from sigmaslam.errors import InputError
from sigmaslam_models.detector import pick_peaks, to_cells
from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_synthetic.rendering.textures import dead_leaves
from sigmaslam_training.features import detector_training
from sigmaslam_training.features.detector_loss import _partners, _squares, detector_loss
from sigmaslam_training.features.detector_training import DetectorConfig, train_detector


def network() -> FeatureNetwork:
    torch.manual_seed(0)
    result = FeatureNetwork(detects=True).eval().requires_grad_(False)
    assert result.response is not None
    result.response.requires_grad_(True)
    return result


def texture() -> torch.Tensor:
    return torch.from_numpy(dead_leaves((192, 192), np.random.default_rng(5)).astype(np.float32) / 255.0)[None]


def gradient(transfer) -> torch.Tensor:
    net, image = network(), texture()
    assert net.response is not None
    loss = detector_loss(net, image, image, transfer, torch.Generator().manual_seed(1))
    loss.backward()
    grad = net.response.decide.weight.grad
    assert grad is not None
    return grad


def test_squares_hold_their_pixels_and_nothing_of_the_border():
    image = torch.arange(32.0 * 48.0).view(32, 48) + 1.0
    squares = _squares(image)
    assert squares.values.shape == (24, 64)
    u, v = squares.pixels.unbind(dim=-1)
    inside = (u >= 8) & (u < 40) & (v >= 8) & (v < 24)
    torch.testing.assert_close(squares.values, torch.where(inside, v * 48.0 + u + 1.0, 0.0))


def test_a_point_replaces_its_neighbour_but_not_a_rival_farther_off():
    unit = torch.eye(3)
    points = torch.tensor([[10.0, 10.0], [10.0, 10.0], [50.0, 50.0]])
    # The first keypoint, next to the points, resembles partner 0 exactly, the second partner 1.
    keypoints0 = torch.tensor([[10.5, 10.0], [30.0, 30.0]])
    described = torch.stack([unit[0], (unit[1] + 0.1 * unit[2]) / 1.01**0.5, (unit[0] + 0.1 * unit[2]) / 1.01**0.5])
    found = _partners(points, described, keypoints0, unit[:2], unit[:2])
    assert found.partner.tolist() == [0, 1, 0]
    assert found.best.tolist() == [True, False, False]


def test_nothing_is_learned_where_nothing_is_seen():
    hidden = gradient(lambda points: (points, np.zeros(len(points), bool)))
    torch.testing.assert_close(hidden, torch.zeros_like(hidden))


@pytest.mark.long
def test_descent_finds_the_half_of_an_image_that_matches():
    """Places right of the middle are seen elsewhere than where they match: fewer keypoints must lie there."""
    net, image = network(), texture()
    assert net.response is not None

    def transfer(points):
        wrong = points[:, :1] > 96.0
        return points + 60.0 * wrong * np.array([[0.0, 1.0]]), np.ones(len(points), bool)

    def share() -> float:
        """Of the keypoints, on the left."""
        with torch.no_grad():
            cells = to_cells(image[None])
            response = net.response(cells, net(cells).fine)
            keypoints, _ = pick_peaks(response, response, 120)
        return float((keypoints[0, :, 0] < 96.0).float().mean())

    before, losses = share(), []
    optimizer = torch.optim.Adam(net.response.parameters(), 0.01)
    for step in range(40):
        loss = detector_loss(net, image, image, transfer, torch.Generator().manual_seed(step))
        losses.append(loss.item())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert share() > before + 0.05
    # Minus the worth of the keypoints: about half of them match before.
    assert losses[0] > -0.5
    assert losses[-1] < losses[0] - 0.05


@pytest.mark.long
def test_an_interrupted_run_ends_as_an_uninterrupted_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    torch.manual_seed(0)
    start = tmp_path / "start.safetensors"
    save_file({name: value.contiguous() for name, value in FeatureNetwork().state_dict().items()}, start)
    monkeypatch.setattr(detector_training, "_TURNS", ("leaves",))
    monkeypatch.setattr(detector_training, "matching_accuracy", lambda *_: {"mma_3": 0.5})
    config = DetectorConfig(steps=4, batch_size=1, size=96)
    card = train_detector(tmp_path / "whole", config, start)
    assert card["config"]["start"] == "start.safetensors"
    train = detector_training.train_steps

    def stopped(network, optimizer, schedule, steps, losses, *others, **options):
        def two(done):
            coming = losses(done)
            for _ in range(2 - done):
                yield next(coming)
            raise KeyboardInterrupt

        train(network, optimizer, schedule, steps, two, *others, **options)

    monkeypatch.setattr(detector_training, "train_steps", stopped)
    with pytest.raises(KeyboardInterrupt):
        train_detector(tmp_path / "parts", config, start)
    monkeypatch.setattr(detector_training, "train_steps", train)
    train_detector(tmp_path / "parts", config, start)
    whole, parts = (load_file(tmp_path / name / "features.safetensors") for name in ("whole", "parts"))
    begun = load_file(start)
    for name, value in whole.items():
        torch.testing.assert_close(parts[name], value, rtol=0, atol=0)
        if name in begun:
            torch.testing.assert_close(value, begun[name], rtol=0, atol=0)
    assert any(bool(value.any()) for name, value in whole.items() if name.startswith("response.decide"))
    with pytest.raises(InputError):
        train_detector(tmp_path / "whole", DetectorConfig(steps=5, batch_size=1, size=96), start)

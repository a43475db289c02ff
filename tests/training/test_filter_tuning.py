"""Updates of a rendered sequence are traced to the verifier, and a part of it learns from their true poses."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from sigmaslam.errors import InputError
from sigmaslam.estimation.chi_square import CHI_SQUARE_95
from sigmaslam.evaluation.rendered_camera import open_rendered
from sigmaslam.filters.manifolds.se3_matrices import exp_se3
from sigmaslam.geometry.trajectory import Trajectory
from sigmaslam.inference.onnx_graph import shipped_weights
from sigmaslam.models.network_export import load_verifier
from sigmaslam.models.verifier_network import PLACE_COLUMNS, MatchCovariance, MatchVerifier
from sigmaslam.readers.trajectory_files import read_trajectory
from sigmaslam.training import filter_tuning
from sigmaslam.training.filter_tuning import PARTS, TunedVerifier, assess, tune
from sigmaslam.training.matching.recorded_updates import RecordedUpdate, RecordingTracker

DEMO = Path(__file__).resolve().parents[2] / "synthetic" / "demo"
FRAMES = 6


@pytest.fixture(scope="module")
def tracker() -> RecordingTracker:
    sequence = open_rendered(DEMO)
    tracker = RecordingTracker(sequence.camera, read_trajectory(DEMO / "poses.txt"))
    for _, frame in zip(range(FRAMES), sequence.frames(), strict=False):
        tracker.step(frame.left, frame.right, frame.timestamp)
    return tracker


@pytest.fixture(scope="module")
def updates(tracker: RecordingTracker) -> list[RecordedUpdate]:
    return tracker.updates


@pytest.fixture
def shipped() -> MatchVerifier:
    return load_verifier(shipped_weights("place_verifier.safetensors"), PLACE_COLUMNS)


def relative_covariance(update: RecordedUpdate, verifier: torch.nn.Module) -> Tensor:
    covariance = update.repeat(verifier).covariance
    difference = covariance[-6:] - covariance[-12:-6]
    return difference[:, -6:] - difference[:, -12:-6]


def test_every_followed_frame_is_traced_and_its_update_repeated(tracker: RecordingTracker, shipped: MatchVerifier):
    verifier = TunedVerifier(shipped, "layer")
    assert tracker.followed >= FRAMES - 2
    assert len(tracker.updates) == tracker.followed
    for update in tracker.updates:
        found = relative_covariance(update, verifier).detach()
        torch.testing.assert_close(found, update.inflation * update.relative, rtol=1e-5, atol=1e-12)


def test_true_poses_are_within_the_covariances(updates: list[RecordedUpdate], shipped: MatchVerifier):
    """With the truth of another frame they would not be."""
    verifier = TunedVerifier(shipped, "layer")
    for update in updates:
        assert update.nees(update.repeat(verifier)) < 3.0 * CHI_SQUARE_95[6]
        wrong = replace(update, T_last_frame=update.T_last_frame @ update.T_last_frame)
        assert wrong.nees(wrong.repeat(verifier)) > 30.0 * CHI_SQUARE_95[6]


@pytest.mark.parametrize("part", PARTS)
def test_the_weights_that_are_written_give_what_was_trained(part: str, shipped: MatchVerifier):
    tuned = TunedVerifier(shipped, part)
    generator = torch.Generator().manual_seed(0)
    columns = torch.randn(50, PLACE_COLUMNS, generator=generator)
    axes = torch.eye(2).expand(50, 2, 2)
    before = MatchCovariance(shipped)(columns, axes)
    for found, expected in zip(tuned(columns.double(), axes.double()), before, strict=True):
        torch.testing.assert_close(found.float(), expected, rtol=1e-5, atol=1e-7)
    with torch.no_grad():
        for parameter in tuned.parameters():
            parameter += 0.1 * torch.randn(parameter.shape, generator=generator)
    written = MatchVerifier(PLACE_COLUMNS)
    written.load_state_dict(tuned.state())
    after = MatchCovariance(written.eval())(columns, axes)
    for found, expected in zip(after, tuned(columns.double(), axes.double()), strict=True):
        torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(after[0], before[0], rtol=0, atol=0)  # the probability has no part in the update
    assert not torch.allclose(after[1], before[1], rtol=1e-3)


def test_a_shift_of_log_sigma_scales_covariances(shipped: MatchVerifier):
    tuned = TunedVerifier(shipped, "scale")
    columns, axes = torch.zeros(3, PLACE_COLUMNS).double(), torch.eye(2).double().expand(3, 2, 2)
    before = tuned(columns, axes)[1]
    with torch.no_grad():
        tuned.shift[:] = torch.tensor([0.5, -0.25])
    expected = before * torch.diag_embed(torch.tensor([1.0, -0.5]).double().exp())
    torch.testing.assert_close(tuned(columns, axes)[1], expected)


@pytest.mark.parametrize("part", PARTS)
def test_gradients_of_the_likelihood_equal_finite_differences(
    part: str, updates: list[RecordedUpdate], shipped: MatchVerifier
):
    update, tuned = updates[-1], TunedVerifier(shipped, part)
    value = update.log_likelihood(update.repeat(tuned))
    parameters = list(tuned.parameters())
    slopes = torch.autograd.grad(value, parameters)
    assert min(slope.abs().max() for slope in slopes) > 1e-3
    generator = torch.Generator().manual_seed(0)
    directions = [torch.randn(each.shape, generator=generator, dtype=torch.float64) for each in parameters]
    size, values = 1e-5, []
    with torch.no_grad():
        for step in (size, -2.0 * size):
            for parameter, direction in zip(parameters, directions, strict=True):
                parameter += step * direction
            values.append(update.log_likelihood(update.repeat(tuned)))
    expected = (values[0] - values[1]) / (2.0 * size)
    found = sum((slope * direction).sum() for slope, direction in zip(slopes, directions, strict=True))
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)


def without_error(update: RecordedUpdate, verifier: torch.nn.Module) -> RecordedUpdate:
    """As if the truth were where the update has the pose."""
    found, poses = update.repeat(verifier), update.frame.poses
    for _ in range(3):  # the error is of the left
        error, _ = found.relative_error(poses[-1], update.T_last_frame, poses[-2])
        last = exp_se3(found.offset[-12:-6].detach()) @ poses[-2]
        move = exp_se3(-error.detach())
        update = replace(update, T_last_frame=torch.linalg.inv(last) @ move @ last @ update.T_last_frame)
    return update


def far_off(update: RecordedUpdate, verifier: torch.nn.Module) -> RecordedUpdate:
    wrong = torch.eye(4, dtype=torch.float64)
    wrong[:3, 3] = 0.05
    return replace(update, T_last_frame=update.T_last_frame @ wrong)


@pytest.mark.parametrize(("changed", "sign"), [(without_error, -1.0), (far_off, 1.0)])
def test_sigmas_shrink_without_errors_and_grow_with_large_ones(
    changed: Callable[[RecordedUpdate, torch.nn.Module], RecordedUpdate],
    sign: float,
    updates: list[RecordedUpdate],
    shipped: MatchVerifier,
):
    tuned = TunedVerifier(shipped, "scale")
    seen: list[int] = []
    tune(tuned, [changed(each, tuned) for each in updates], 2, 0, lambda count, _: seen.append(count))
    assert seen[-1] == 2 * len(updates)
    assert (sign * tuned.shift.detach() > 0.0).all()


def test_training_is_the_same_for_the_same_seed(updates: list[RecordedUpdate], shipped: MatchVerifier):
    first, second = (TunedVerifier(shipped, "layer") for _ in range(2))
    for tuned in (first, second):
        tune(tuned, updates[:3], 1, 5)
    for found, expected in zip(first.parameters(), second.parameters(), strict=True):
        torch.testing.assert_close(found, expected, rtol=0, atol=0)
        assert found.abs().max() > 0.0


def test_figures_are_those_of_a_gaussian(updates: list[RecordedUpdate], shipped: MatchVerifier):
    tuned = TunedVerifier(shipped, "layer")
    figures = assess(tuned, updates)
    expected = []
    for update in updates:
        found, poses = update.repeat(tuned), update.frame.poses
        error, covariance = (x.detach() for x in found.relative_error(poses[-1], update.T_last_frame, poses[-2]))
        normal = torch.distributions.MultivariateNormal(torch.zeros(6).double(), covariance)
        expected.append(-float(normal.log_prob(error)))
    assert figures.count == len(updates)
    assert figures.nll == pytest.approx(np.mean(expected), rel=1e-9)
    assert figures.nll_median == pytest.approx(np.median(expected), rel=1e-9)


def shortened_demo(folder: Path) -> Path:
    """The first frames of the demo."""
    shutil.copytree(DEMO, folder)
    for name in ("poses.txt", "times.txt"):
        lines = (folder / name).read_text().splitlines(keepends=True)
        (folder / name).write_text("".join(lines[:FRAMES]))
    for eye in (0, 1):
        for path in sorted((folder / f"image_{eye}").iterdir())[FRAMES:]:
            path.unlink()
    return folder


@pytest.mark.slow
def test_the_command_writes_weights_and_figures(tmp_path: Path, capsys: pytest.CaptureFixture):
    train, test = shortened_demo(tmp_path / "train"), shortened_demo(tmp_path / "test")
    out = tmp_path / "out"
    arguments = ["--train", str(train), "--test", str(test), "--out", str(out), "--epochs", "1", "--part", "scale"]
    filter_tuning.main(arguments)
    assert "| ratio, geometric mean |" in capsys.readouterr().out
    figures = json.loads((out / "filter_tuning.json").read_text())
    before, after = figures["updates"]["test"]
    assert before["count"] == after["count"] >= FRAMES - 2
    (run, other), *rest = figures["runs"]
    assert not rest
    assert run["tracked"] == other["tracked"] == FRAMES - 1
    MatchVerifier(PLACE_COLUMNS).load_state_dict(load_file(out / "place_verifier.safetensors"))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"--epochs": "0"}, "give at least 1"),
        ({"--test": str(DEMO)}, "in --train and in --test"),
        ({"--test": "nowhere"}, "has no poses.txt"),
        ({"--out": str(DEMO)}, "not an empty folder"),
    ],
)
def test_wrong_arguments_are_refused(
    changed: dict[str, str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture
):
    options = {"--train": str(DEMO), "--test": str(tmp_path), "--out": str(tmp_path / "new"), **changed}
    with pytest.raises(SystemExit) as stopped:
        filter_tuning.main([word for pair in options.items() for word in pair])
    assert stopped.value.code == 2
    assert message in capsys.readouterr().err


def test_a_frame_without_a_true_pose_is_refused():
    sequence = open_rendered(DEMO)
    truth = read_trajectory(DEMO / "poses.txt")
    tracker = RecordingTracker(sequence.camera, Trajectory(truth.timestamps + 100.0, truth.poses))
    frame = next(sequence.frames())
    with pytest.raises(InputError, match="no true pose at"):
        tracker.step(frame.left, frame.right, frame.timestamp)

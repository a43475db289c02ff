"""Gates and robust weights, block by block: known answers, invariants, and a belief that is wrong and too sure."""

from __future__ import annotations

import math

import pytest
import torch
from scipy.stats import chi2
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_filters import systems
from sigmaslam_filters.core.solve import FORMS
from sigmaslam_filters.robust import ROBUST, common_scale, student_weight
from tests.support.filter_assertions import assert_close, assert_same_belief, assert_same_update
from tests.support.filter_builders import beliefs, bent_measurement, covariances, random_numbers, tensor

OPTIONS = [{"gate": 0.99}, {"robust": "student_t"}, {"robust": "huber"}, {"gate": 0.99, "robust": "student_t"}]
EYE = torch.eye(2, dtype=torch.float64)
PRIOR = filters.Gaussian(tensor(0.0, 0.0), 0.01 * EYE)


def fixes(count: int) -> filters.LinearMeasurement:
    """Positions, each of variance 1 in both components."""
    one = filters.LinearMeasurement(EYE, filters.Diagonal(tensor(1.0, 1.0)))
    measurement = filters.several(one, count)
    assert isinstance(measurement, filters.LinearMeasurement)
    return measurement


@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.parametrize("form", FORMS)
def test_a_measurement_as_expected_is_taken_at_its_word(form, options):
    bayes = filters.UnscentedKalmanFilter(form=form)
    prior, see = beliefs(3, 2), bent_measurement(2, 6, filters.BlockDiagonal(covariances(3, 2)))
    expected = bayes.update(prior, see, torch.zeros(3, 6, dtype=torch.float64))
    value = -expected.innovation  # z - h(x) = -e, so h(x) = -e
    plain, found = bayes.update(prior, see, value), bayes.update(prior, see, value, **options)
    assert_same_update(found, plain, 1e-12)
    assert found.weight is not None
    assert_close(found.weight, torch.ones(3, 3, dtype=torch.float64), 1e-15)
    assert plain.weight is None


@pytest.mark.parametrize("kind", ["model", "noise"])
def test_a_block_beyond_the_gate_is_as_if_it_were_missing(kind):
    noise = filters.BlockDiagonal(covariances(4, 2, seed=3)) if kind == "noise" else filters.Diagonal(torch.ones(8) + 0)
    if kind == "model":
        noise = filters.Diagonal(torch.ones(8, dtype=torch.float64))
    H = random_numbers(8, 2, seed=1)
    see = filters.LinearMeasurement(H, noise, block_size=2 if kind == "model" else None)
    bayes, value = filters.KalmanFilter(), 0.1 * random_numbers(3, 8, seed=2)
    value[1, 4] = 50.0
    found = bayes.update(PRIOR, see, value, gate=0.999)
    missing = value.clone()
    missing[1, 4:6] = torch.nan
    assert_same_update(found, bayes.update(PRIOR, see, missing), 1e-12)
    assert found.weight is not None
    assert found.weight.tolist() == [[1.0] * 4, [1.0, 1.0, 0.0, 1.0], [1.0] * 4]
    assert torch.as_tensor(found.count).tolist() == [8, 6, 8]


def test_the_gate_is_the_quantile_of_the_components_that_are_there():
    see, S = fixes(3), 1.01
    for components in (1, 2):
        at = math.sqrt(float(chi2.ppf(0.99, components)) * S / components)
        for distance, weight in ((at * 0.999, 1.0), (at * 1.001, 0.0)):
            value = torch.zeros(6, dtype=torch.float64)
            value[:components] = distance
            value[components:2] = torch.nan
            found = filters.KalmanFilter().update(PRIOR, see, value, gate=0.99).weight
            assert found is not None
            assert found.tolist() == [weight, 1.0, 1.0]


def test_blocks_that_are_most_of_a_measurement_are_never_refused():
    """Two of four, and one of one: the belief may be what is wrong."""
    for value in (tensor(9.0, 0.0, 9.0, 0.0, 0.0, 0.0, 0.0, 0.0), tensor(9.0, 0.0)):
        found = filters.KalmanFilter().update(PRIOR, fixes(len(value) // 2), value, gate=0.999)
        assert found.weight is not None
        assert_close(found.weight[0], tensor((4.0 + 2.0) / (4.0 + 81.0 / 1.01))[0], 1e-12)
        assert float(found.belief.mean[0]) > 0


@pytest.mark.parametrize("form", FORMS)
def test_student_t_finds_the_mode_of_a_cauchy_like_posterior(form):
    """A fixed point: weights are those of the posterior's own expected residuals, by textbook formulas."""
    value = tensor(0.3, -0.2, 0.1, 0.4, 12.0, -9.0)
    prior = filters.Gaussian(tensor(0.5, 0.0), covariances(2, seed=4))
    found = filters.KalmanFilter(form=form).update(prior, fixes(3), value, robust="student_t")
    weight, P = torch.ones(3, dtype=torch.float64), prior.covariance
    for _ in range(100):
        information = torch.linalg.inv(P) + weight.sum() * EYE
        covariance = torch.linalg.inv(information)
        z = value.reshape(3, 2)
        mean = covariance @ (torch.linalg.inv(P) @ prior.mean + (weight[:, None] * z).sum(dim=0))
        squared = (z - mean).square().sum(dim=-1) + covariance.trace()
        weight = ((4.0 + 2.0) / (4.0 + squared)).clamp_max(1.0)
    assert found.weight is not None
    assert_close(found.weight, weight, 1e-3)
    assert_close(found.belief.mean, mean, 1e-3)
    assert_close(found.belief.covariance, covariance, 1e-3)


@pytest.mark.parametrize("robust", ROBUST)
def test_outliers_in_many_blocks_move_the_posterior_less_and_less(robust):
    """The pull of Student's t vanishes with the distance, Huber's stays bounded, a Gaussian's grows."""
    prior = filters.Gaussian(tensor(0.0, 0.0), 100.0 * EYE)
    shifts = []
    for distance in (10.0, 100.0, 1000.0):
        value = torch.zeros(20, dtype=torch.float64)
        value[0] = distance
        bayes = filters.KalmanFilter()
        found = bayes.update(prior, fixes(10), value, robust=robust)
        shifts.append(float(found.belief.mean[0]))
        assert shifts[-1] < 0.35 * float(bayes.update(prior, fixes(10), value).belief.mean[0])
    assert shifts[2] < 0.02 if robust == "student_t" else shifts[2] < 1.1 * shifts[1] < 1.3 * shifts[0]


@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.parametrize("form", FORMS)
def test_masks_batches_and_forms_agree(form, options):
    """Each element as alone; a missing component as a removed one where the block has one left."""
    prior, noise = beliefs(4, 2, scale=0.1), covariances(3, 2, scale=0.3)
    see = filters.MeasurementModel(
        bent_measurement(2, 6).function, filters.BlockDiagonal(noise), residual=lambda a, b: a - b
    )
    value = random_numbers(4, 6, seed=7)
    value[1, 2] = value[2, 4] = value[2, 5] = torch.nan
    value[3, 0] = 30.0
    bayes = filters.UnscentedKalmanFilter(form=form, iterations=2)
    together = bayes.update(prior, see, value, **options)
    dense = filters.UnscentedKalmanFilter(form="dense", iterations=2).update(prior, see, value, **options)
    assert_same_update(together, dense, 1e-6)
    for k in range(4):
        alone = bayes.update(prior[k], see, value[k], **options)
        assert_same_belief(together.belief[k], alone.belief, 1e-12)
        assert_close(together.weight[k], alone.weight, 1e-12)


def refuse_always(update: filters.Update, value: Tensor, size: int) -> Tensor:
    """The value with NaN for blocks beyond the gate of 0.999, as a gate without regard for lock-out has it."""
    e, S = update.innovation.unflatten(-1, (-1, size)), filters.Dense(update.innovation_covariance).blocks(size)
    distance = (e * torch.linalg.solve(S, e.unsqueeze(-1)).squeeze(-1)).sum(dim=-1)
    inside = distance < float(chi2.ppf(0.999, size))
    return torch.where(inside.repeat_interleave(size, dim=-1), value, torch.nan)


@pytest.mark.long
@pytest.mark.parametrize("options", [*OPTIONS, None], ids=str)
def test_a_belief_that_is_wrong_and_too_sure_is_pulled_back(options):
    """A robot whose wheels slipped by 3 m, its belief sure of 0.05 m; a gate that always refuses is lost."""
    motion = systems.differential_drive(filters.Diagonal(tensor(0.02, 0.02) ** 2))
    landmarks = tensor(*[0.0, 5.0, 5.0, 0.0, -5.0, 2.0]).reshape(3, 2)
    see = filters.several(systems.range_and_bearing(filters.Diagonal(tensor(0.1, 0.02) ** 2)), 3)
    ukf = filters.UnscentedKalmanFilter(iterations=1)
    truth = tensor(1.0, 1.0, 0.3)
    belief = filters.Gaussian(truth + tensor(3.0, 0.0, 0.0), torch.diag(tensor(0.05, 0.05, 0.02) ** 2))
    noise, inputs = random_numbers(300, 6, seed=9), (tensor(0.3, 0.3), tensor(0.1))
    for k in range(300):
        truth = motion.function(truth, torch.zeros(2, dtype=torch.float64), *inputs)
        value = see.function(truth, landmarks) + noise[k] * tensor(0.1, 0.02).repeat(3)
        predicted = ukf.predict(belief, motion, *inputs).belief
        if options is None:
            value = refuse_always(ukf.update(predicted, see, value, landmarks), value, 2)
        belief = ukf.update(predicted, see, value, landmarks, **(options or {})).belief
    error = float((belief.mean - truth)[:2].norm())
    assert error > 1.0 if options is None else error < 0.1


def test_gates_and_weights_have_derivatives():
    def total(noise: Tensor, value: Tensor, options: dict) -> Tensor:
        see = filters.LinearMeasurement(random_numbers(6, 2, seed=1), filters.Diagonal(noise), block_size=2)
        found = filters.KalmanFilter().update(PRIOR, see, value, **options)
        return found.log_likelihood + found.belief.mean.sum()

    value = random_numbers(6, seed=3)
    value[0] = 30.0
    value.requires_grad_()
    noise = (0.5 + random_numbers(6, seed=2).square()).requires_grad_()
    for options in OPTIONS:
        assert torch.autograd.gradcheck(lambda n, v, options=options: total(n, v, options), (noise, value))


def test_options_that_cannot_be_followed_are_refused():
    update, value = filters.KalmanFilter().update, torch.zeros(6, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"gate is 13\.8; it must be a probability"):
        update(PRIOR, fixes(3), value, gate=13.8)
    with pytest.raises(ValueError, match="robust is 'cauchy'; choose student_t or huber"):
        update(PRIOR, fixes(3), value, robust="cauchy")
    with pytest.raises(ValueError, match="block_size is 4, but the value has 6 components"):
        update(
            PRIOR,
            filters.LinearMeasurement(random_numbers(6, 2), filters.Diagonal(torch.ones_like(value)), block_size=4),
            value,
            robust="huber",
        )
    noisy = filters.MeasurementModel(lambda x, v: x + v, EYE, additive=False)
    with pytest.raises(ValueError, match="need additive noise"):
        filters.UnscentedKalmanFilter().update(PRIOR, noisy, value[:2], robust="huber")


def test_a_sequence_passes_its_options_on_to_each_update():
    motion = filters.LinearMotion(EYE, 0.01 * EYE)
    values = 0.1 * random_numbers(6, 2)
    values[3] = 40.0
    bayes = filters.KalmanFilter()
    track = bayes.filter(PRIOR, motion, fixes(1), values, robust="student_t")
    belief = PRIOR
    for k in range(6):
        if k > 0:
            belief = bayes.predict(belief, motion).belief
        belief = bayes.update(belief, fixes(1), values[k], robust="student_t").belief
    assert_same_belief(track.filtered[-1], belief, 1e-14)
    assert float(bayes.filter(PRIOR, motion, fixes(1), values).filtered.mean[3, 0]) > 5 * float(
        track.filtered.mean[3, 0]
    )


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"gate": 0.99}, {"robust": "student_t"}], ids=str)
def test_a_graph_gates_and_weighs_as_torch_does(options, tmp_path):
    see = systems.range_and_bearing(filters.Diagonal(tensor(0.1, 0.02) ** 2))
    example = filters.StepExample(
        filters.Gaussian(tensor(0.0, 0.0, 0.1), torch.diag(tensor(0.1, 0.1, 0.02))),
        value=tensor(9.0, -1.0),
        measurement_inputs={"landmark": tensor(3.0, 1.0)},
    )
    ukf = filters.UnscentedKalmanFilter(iterations=1)
    assert filters.export_step(ukf, None, see, example, tmp_path / "robust.onnx", **options) < 1e-9


def squared_lengths(factor: float, count: int = 200, outliers: int = 0) -> Tensor:
    """Of residuals with `factor` times the variance that they claim; the outliers are a hundred times as long."""
    generator = torch.Generator().manual_seed(1)
    residual = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    squared = factor * (residual * residual).sum(dim=1)
    squared[:outliers] *= 1e4
    return squared


def scale_of(squared: Tensor, usable: Tensor) -> float:
    """`common_scale` of residuals with three components each."""
    median, largest = (torch.full_like(squared, chi2.ppf(share, 3)) for share in (0.5, 0.999))
    return float(common_scale(squared, median, largest, usable))


@pytest.mark.parametrize(
    ("factor", "outliers", "expected"),
    [(1.0, 0, 1.0), (4.0, 0, 4.0), (4.0, 60, 1.0), (100.0, 0, 1.0)],
    ids=["as claimed", "all of them blurred", "a part is wrong", "nothing fits"],
)
def test_common_scale_tells_blur_from_outliers(factor, outliers, expected):
    found = scale_of(squared_lengths(factor, outliers=outliers), torch.ones(200, dtype=torch.bool))
    assert found == pytest.approx(expected, rel=0.15 if expected > 1 else 0)


def test_common_scale_is_the_median_of_the_usable_ones():
    squared = squared_lengths(4.0)
    usable = torch.arange(200) % 3 != 0
    ratio = (squared / chi2.ppf(0.5, 3))[usable]
    found = scale_of(torch.where(usable, squared, squared * 1e3), usable)
    assert found == pytest.approx(float(ratio.quantile(0.5)), rel=1e-12)
    assert scale_of(squared, torch.zeros(200, dtype=torch.bool)) == 1.0


def test_weights_of_a_student_are_those_of_its_likelihood_but_for_one_factor():
    """The derivative of -log p by half the squared length is (nu + p) / (nu + s)."""
    squared = torch.linspace(0, 50, 11, dtype=torch.float64).requires_grad_()
    likelihood = -(2.0 + 3.0) / 2.0 * torch.log(1.0 + squared / 2.0)
    (slope,) = torch.autograd.grad(likelihood.sum(), squared)
    torch.testing.assert_close(student_weight(squared, 3.0, 2.0), -2.0 * slope)
    found = student_weight(squared, 3.0, 2.0, consistent=True)
    torch.testing.assert_close(found, -2.0 * slope * (2.0 + 3.0) / (2.0 + 3.0 + 2.0))

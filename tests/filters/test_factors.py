"""Factorisations: what they promise, and the unrolled ones against LAPACK's."""

import pytest
import torch
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_filters.core import factors, unrolled_factors
from sigmaslam_filters.core.noise_covariance import Noise
from tests.support.filter_assertions import assert_close
from tests.support.filter_builders import beliefs, bent_measurement, bent_motion, covariances, random_numbers, tensor

COUNT = 150
SIZES = [1, 2, 3, 4, 5, 6, 8]


def each(function, *arrays: Tensor) -> Tensor:
    """The function of one element after the other, which is never unrolled."""
    return torch.stack([function(*parts) for parts in zip(*arrays, strict=True)])


@pytest.mark.parametrize("size", SIZES)
def test_unrolled_cholesky_equals_lapack(size):
    P = covariances(COUNT, size)
    factor, _ = factors.cholesky(P)
    assert unrolled_factors.is_small(P)
    assert_close(factor, torch.linalg.cholesky(P), 1e-13)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("columns", [1, 3, 9])
def test_unrolled_triangularisation_equals_lapack(size, columns):
    pieces = [random_numbers(COUNT, size, columns), random_numbers(COUNT, size, 2, seed=1)]
    diagonal = 0.1 + random_numbers(COUNT, size, seed=2).square()
    found = factors.triangularise(pieces, diagonal)
    alone = each(lambda a, b, d: factors.triangularise([a, b], d), *pieces, diagonal)
    joined = torch.cat([*pieces, torch.diag_embed(diagonal)], dim=-1)
    assert_close(found, alone, 1e-12)
    assert_close(found, torch.linalg.cholesky(joined @ joined.mT), 1e-12)
    assert_close(factors.triangularise(pieces) @ factors.triangularise(pieces).mT, _outer(pieces), 1e-12)


def _outer(pieces: list[Tensor]) -> Tensor:
    joined = torch.cat(pieces, dim=-1)
    return joined @ joined.mT


@pytest.mark.parametrize("count", [2, COUNT])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_triangularisation_of_a_singular_matrix_restores_it(count, dtype):
    for rank in (1, 2, 3):
        A = (random_numbers(count, 5, rank) @ random_numbers(count, rank, 7, seed=1)).to(dtype)
        lower = factors.triangularise([A])
        assert bool((torch.diagonal(lower, dim1=-2, dim2=-1) >= 0).all())
        assert bool((lower.triu(1) == 0).all())
        assert_close(lower @ lower.mT, A @ A.mT, 50 * torch.finfo(dtype).eps)


@pytest.mark.parametrize("size", SIZES)
def test_unrolled_solutions_equal_lapack(size):
    lower = torch.linalg.cholesky(covariances(COUNT, size))
    right = random_numbers(COUNT, size, 4)
    for found, upper, matrix in (
        (factors.solve_lower(lower, right), False, lower),
        (factors.solve_lower_transposed(lower, right), True, lower.mT),
    ):
        assert_close(found, torch.linalg.solve_triangular(matrix, right, upper=upper), 1e-12)


@pytest.mark.parametrize("count", [2, COUNT])
def test_zero_pivots_are_known_directions(count):
    lower = torch.linalg.cholesky(covariances(count, 4))
    lower[:, :, 1] = 0.0
    right = random_numbers(count, 4, 2)
    right[:, 1] = (lower[:, 1][:, None] @ right)[:, 0]  # whatever it is, the others do not depend on it
    keep = torch.tensor([0, 2, 3])
    for transposed, solve in ((False, factors.solve_lower), (True, factors.solve_lower_transposed)):
        reduced = lower[:, keep][:, :, keep]
        expected = torch.linalg.solve_triangular(
            reduced.mT if transposed else reduced, right[:, keep], upper=transposed
        )
        found = solve(lower, right)[:, keep]
        if not transposed:
            assert_close(found, expected, 1e-12)
        assert bool(found.isfinite().all())


@pytest.mark.parametrize("rows", [1, 3, 6])
def test_unrolled_products_equal_lapack(rows):
    left, right = random_numbers(COUNT, rows, 5), random_numbers(COUNT, 5, 7, seed=1)
    vector = random_numbers(COUNT, 5, seed=2)
    assert_close(factors.multiply(left, right), left @ right, 1e-13)
    assert_close(factors.multiply(left[0], right), left[0] @ right, 1e-13)
    assert_close(factors.multiply(left, right[0]), left @ right[0], 1e-13)
    assert_close(factors.apply(left, vector), torch.einsum("bij,bj->bi", left, vector), 1e-13)
    assert_close(factors.apply(left[0], vector), vector @ left[0].mT, 1e-13)
    assert_close(factors.square([left, left]), 2 * left @ left.mT, 1e-13)


@pytest.mark.parametrize("count", [3, COUNT])
def test_cholesky_flags_each_bad_element_only(count):
    P = covariances(count, 4)
    P[0, 2, 1] = torch.nan
    P[1] = -P[1]
    P[2] = 0.0
    factor, healthy = factors.cholesky(P)
    assert healthy is not None
    assert healthy.tolist() == [False, False, *[True] * (count - 2)]
    assert_close(factor[2:], torch.cat([torch.zeros(1, 4, 4), torch.linalg.cholesky(P[3:])]).double(), 1e-13)


def each_noise() -> dict[str, Noise]:
    return {
        "diagonal": filters.Diagonal(0.1 + random_numbers(3, 6).square()),
        "blocks": filters.BlockDiagonal(covariances(3, 2, 3)),
        "dense": filters.Dense(covariances(3, 6)),
    }


@pytest.mark.parametrize("kind", each_noise())
def test_noise_agrees_with_its_covariance(kind):
    noise = each_noise()[kind]
    R, columns = noise.covariance(), random_numbers(3, 6, 4)
    assert noise.variance().shape[-1] == 6
    assert_close(noise.factor() @ noise.factor().mT, R, 1e-13)
    assert_close(noise.log_determinant(), torch.logdet(R), 1e-12)
    white = noise.whitened(columns)
    assert_close(white.mT @ white, columns.mT @ torch.linalg.solve(R, columns), 1e-12)
    root = noise.triangularised([columns])
    assert_close(root @ root.mT, R + columns @ columns.mT, 1e-12)
    mask = random_numbers(3, 6, seed=3) > 0
    expected = torch.where(mask[:, None] & mask[..., None], R, torch.eye(6, dtype=torch.float64))
    assert_close(noise.masked(mask).covariance(), expected, 0.0)


def test_wrong_shapes_of_noise_are_named():
    for make, shape in (
        (filters.Diagonal, ()),
        (filters.BlockDiagonal, (3, 2)),
        (filters.BlockDiagonal, (3, 2, 4)),
        (filters.Dense, (3, 2)),
    ):
        with pytest.raises(ValueError, match="expected, got"):
            make(torch.ones(shape))


def test_gaussian_is_the_same_by_covariance_and_by_any_root():
    root = random_numbers(3, 4, 6)
    by_root, by_covariance = (
        filters.Gaussian(random_numbers(3, 4), factor=root),
        filters.Gaussian(random_numbers(3, 4), root @ root.mT),
    )
    assert_close(by_root.covariance, by_covariance.covariance, 1e-13)
    assert_close(by_root.factor, by_covariance.factor, 1e-12)
    assert by_root.is_square_root
    assert not by_covariance.is_square_root
    for belief in (by_root, by_covariance):
        assert belief.size == 4
        assert belief.batch_shape == (3,)
        assert belief[1].mean.shape == (4,)
        assert belief[..., None].covariance.shape == (3, 1, 4, 4)
        assert belief.to(torch.float32).covariance.dtype == torch.float32
        assert_close(belief.batch_last().covariance, belief.covariance, 1e-15)
        chosen = belief.where(torch.tensor([True, False, True]), by_covariance[0])
        assert_close(chosen.covariance[1], by_covariance.covariance[0], 1e-13)
        assert_close(chosen.covariance[2], belief.covariance[2], 1e-13)


def test_wrong_gaussians_are_refused():
    mean, P = torch.zeros(3, 2), torch.eye(2)
    for arguments, message in (
        ((mean,), "either a covariance or a factor"),
        ((mean, torch.zeros(2, 3)), "expected, got"),
        ((mean, P.double()), "one floating dtype"),
        ((mean, P.expand(4, 2, 2)), "does not broadcast"),
    ):
        with pytest.raises(ValueError, match=message):
            filters.Gaussian(*arguments)
    with pytest.raises(ValueError, match="either a covariance or a factor"):
        filters.Gaussian(mean, P, factor=P)


MOTION, MEASUREMENT = bent_motion(2), bent_measurement(2, 2)


def step(
    bayes: filters.UnscentedKalmanFilter, mean: Tensor, held: Tensor, z: Tensor, by_root: bool
) -> tuple[Tensor, ...]:
    belief = filters.Gaussian(mean, factor=held, factor_is_lower=True) if by_root else filters.Gaussian(mean, held)
    predicted = bayes.predict(belief, MOTION).belief
    update = bayes.update(predicted, MEASUREMENT, z)
    return update.belief.mean, update.belief.held, update.nis, update.log_likelihood, update.healthy


@pytest.mark.slow
@pytest.mark.parametrize("form", ["dense", "qr"])
def test_compiled_step_equals_eager(form):
    belief, z = beliefs(40, 2), random_numbers(40, 2)
    z[3, 1] = torch.nan
    held = belief.factor if form == "qr" else belief.covariance
    bayes = filters.UnscentedKalmanFilter(form=form, on_failure="hold")
    compiled = torch.compile(step, fullgraph=True)
    found = compiled(bayes, belief.mean, held, z, form == "qr")
    for a, b in zip(found, step(bayes, belief.mean, held, z, form == "qr"), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12)


FORMS = ("dense", "low-rank", "qr")


def outputs(form: str, mean: Tensor, root: Tensor, variance: Tensor, z: Tensor, by_root: bool, m: int) -> Tensor:
    """All that predict and update give, as one number per element."""
    bayes = filters.UnscentedKalmanFilter(form=form)
    root = root.tril()
    belief = (
        filters.Gaussian(mean, factor=root, factor_is_lower=True) if by_root else filters.Gaussian(mean, root @ root.mT)
    )
    predicted = bayes.predict(belief, bent_motion(3)).belief
    measurement = filters.MeasurementModel(bent_measurement(3, m).function, filters.Diagonal(variance))
    update = bayes.update(predicted, measurement, z)
    total = update.nis + update.log_likelihood + update.innovation.sum(dim=-1)
    weights = random_numbers(3, 3, seed=9)
    return total + (update.belief.mean * weights[0]).sum(-1) + (update.belief.covariance * weights).sum((-2, -1))


@pytest.mark.long
@pytest.mark.parametrize("measurements", [2, 9])
@pytest.mark.parametrize("by_root", [False, True])
@pytest.mark.parametrize("form", FORMS)
def test_gradients_are_right_in_every_form(form, by_root, measurements):
    arguments = [
        random_numbers(2, 3),
        torch.linalg.cholesky(covariances(2, 3)),
        0.2 + random_numbers(2, measurements, seed=2).square(),
        random_numbers(2, measurements, seed=3),
    ]
    assert torch.autograd.gradcheck(
        lambda *given: outputs(form, *given, by_root, measurements), [a.requires_grad_() for a in arguments]
    )


@pytest.mark.parametrize("by_root", [False, True])
@pytest.mark.parametrize("form", FORMS)
def test_gradients_of_unrolled_filters_equal_those_of_single_ones(form, by_root):
    def gradients(pick: slice) -> list[Tensor]:
        arguments = [
            random_numbers(COUNT, 3)[pick],
            torch.linalg.cholesky(covariances(COUNT, 3))[pick],
            0.2 + random_numbers(COUNT, 2, seed=2).square()[pick],
            random_numbers(COUNT, 2, seed=3)[pick],
        ]
        leaves = [a.clone().requires_grad_() for a in arguments]
        return list(torch.autograd.grad(outputs(form, *leaves, by_root, 2).sum(), leaves))

    for large, few in zip(gradients(slice(None)), gradients(slice(0, 5)), strict=True):
        assert_close(large[:5], few, 1e-10)


SINGULAR_QR = pytest.mark.xfail(
    strict=True, reason="the derivative of LAPACK's QR does not exist for singular matrices"
)


@pytest.mark.parametrize(
    ("form", "count"),
    [pytest.param(f, n, marks=SINGULAR_QR if (f, n) == ("qr", 2) else ()) for f in FORMS for n in (2, COUNT)],
)
def test_gradients_are_finite_with_known_states_and_no_innovation(form, count):
    root = torch.linalg.cholesky(covariances(count, 3))
    root[:, 2] = 0.0
    mean = random_numbers(count, 3).requires_grad_()
    held = root.requires_grad_()
    variance = torch.full((2,), 0.3, dtype=torch.float64, requires_grad=True)
    belief = filters.Gaussian(mean, factor=held, factor_is_lower=True)
    measurement = filters.LinearMeasurement(random_numbers(2, 3), filters.Diagonal(variance))
    z = (mean.detach() @ measurement.matrix.mT).requires_grad_()
    update = filters.UnscentedKalmanFilter(form=form).update(belief, measurement, z)
    total = update.belief.mean.sum() + update.log_likelihood.sum() + update.nis.sum() + update.belief.covariance.sum()
    for gradient in torch.autograd.grad(total, [mean, held, variance, z]):
        assert bool(gradient.isfinite().all())
    assert_close(update.belief.mean[:, 2], mean[:, 2], 1e-14)
    assert_close(tensor(0.0).expand(count), update.nis.detach(), 1e-14)


@pytest.mark.parametrize("form", FORMS)
def test_forward_derivatives_equal_backward_ones(form):
    """Of the likelihood, by the measurement and the noise."""
    prior, z, variance = beliefs(3), random_numbers(2), tensor(0.3, 0.2)
    motion, see = bent_motion(3), bent_measurement(3, 2).function

    def likelihood(value, noise):
        bayes = filters.UnscentedKalmanFilter(form=form, iterations=1)
        predicted = bayes.predict(prior, motion).belief
        return bayes.update(predicted, filters.MeasurementModel(see, filters.Diagonal(noise)), value).log_likelihood

    forward = torch.func.jacfwd(likelihood, argnums=(0, 1))(z, variance)
    backward = torch.func.jacrev(likelihood, argnums=(0, 1))(z, variance)
    for a, b in zip(forward, backward, strict=True):
        assert_close(a, b, 1e-10)

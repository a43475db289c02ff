import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sigmaslam_filters.gaussian_belief import degree_of_belief


def covariances(*shape: int, scale: float = 0.1, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    root = scale * torch.randn(*shape, shape[-1], generator=generator, dtype=torch.float64)
    return root @ root.mT


def test_known_values():
    deviations = torch.tensor([0.1, 0.3, 0.2], dtype=torch.float64)
    assert float(degree_of_belief(torch.diag(deviations.square()))) == pytest.approx(0.7)
    assert float(degree_of_belief(torch.tensor([[0.25]]))) == pytest.approx(0.5)
    # Fully correlated: the deviation along (1, 1) is sqrt(2) that of each.
    assert float(degree_of_belief(torch.full((2, 2), 0.01))) == pytest.approx(1 - 0.1 * math.sqrt(2))
    assert float(degree_of_belief(torch.zeros(3, 3))) == 1.0


def test_belief_is_clipped_at_zero():
    assert float(degree_of_belief(torch.eye(2))) == 0.0
    assert float(degree_of_belief(1e6 * torch.eye(2))) == 0.0


def test_belief_is_the_printed_formula_and_not_the_determinant():
    P = covariances(20, 4)
    expected = (1 - torch.linalg.matrix_norm(P, ord=2).sqrt()).clamp(0, 1)
    torch.testing.assert_close(degree_of_belief(P), expected, rtol=1e-12, atol=1e-12)
    assert not torch.allclose(degree_of_belief(P), (1 - torch.linalg.det(P).sqrt()).clamp(0, 1))


@settings(max_examples=40, deadline=None)
@given(size=st.integers(1, 6), seed=st.integers(0, 1000), more=st.floats(0.0, 1.0))
def test_belief_does_not_rise_when_the_covariance_grows(size, seed, more):
    P = covariances(size, scale=0.2, seed=seed)
    before, after = degree_of_belief(P), degree_of_belief(P + more * covariances(size, scale=0.2, seed=seed + 1))
    assert 0 <= after <= before + 1e-12 <= 1 + 1e-12


def test_belief_does_not_depend_on_the_axes():
    P = covariances(4)
    rotation = torch.linalg.qr(covariances(4, seed=3)).Q
    torch.testing.assert_close(degree_of_belief(rotation @ P @ rotation.mT), degree_of_belief(P))


def test_a_batch_equals_a_loop():
    P = covariances(3, 5, 6)
    loop = torch.stack([torch.stack([degree_of_belief(one) for one in row]) for row in P])
    assert degree_of_belief(P).shape == (3, 5)
    torch.testing.assert_close(degree_of_belief(P), loop, rtol=1e-12, atol=1e-12)


def test_nan_and_infinity_stay_in_their_element():
    P = covariances(4, 3)
    alone = degree_of_belief(P)
    P[1, 2, 0] = math.nan
    P[2, 1, 1] = math.inf
    belief = degree_of_belief(P)
    assert belief.isnan().tolist() == [False, True, False, False]
    assert belief[2] == 0
    torch.testing.assert_close(belief[[0, 3]], alone[[0, 3]])


def test_gradient_is_that_of_the_formula():
    P = covariances(2, 3).requires_grad_()

    def of_symmetric_part(matrix: Tensor) -> Tensor:
        return degree_of_belief((matrix + matrix.mT) / 2)

    assert torch.autograd.gradcheck(of_symmetric_part, (P,))


def test_gradient_is_finite_where_the_belief_is_clipped():
    P = torch.stack([torch.zeros(2, 2), 4 * torch.eye(2), 0.04 * torch.eye(2), torch.full((2, 2), math.nan)])
    P.requires_grad_()
    degree_of_belief(P)[:3].sum().backward()
    assert P.grad is not None
    assert (P.grad[[0, 1, 3]] == 0).all()
    # -1 / (2 sigma) per unit of the largest variance.
    assert float(P.grad[2].trace()) == pytest.approx(-2.5)


def test_dtype_follows_the_input():
    assert degree_of_belief(covariances(2, 3).float()).dtype == torch.float32


@pytest.mark.parametrize("shape", [(3,), (2, 3), (4, 0, 0), ()])
def test_what_is_not_a_square_matrix_is_refused(shape):
    with pytest.raises(ValueError, match="must be"):
        degree_of_belief(torch.zeros(shape))

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from sigmaslam_filters.core import plain_factors


def cholesky(matrix: Tensor) -> Tensor:
    return plain_factors.cholesky(matrix)[0]


def random_matrices(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def positive_definite(*shape: int, seed: int = 0) -> Tensor:
    root = random_matrices(*shape, shape[-1], seed=seed)
    return root @ root.mT + 0.1 * torch.eye(shape[-1], dtype=torch.float64)


@settings(max_examples=25, deadline=None)
@given(size=st.integers(1, 24), batch=st.lists(st.integers(1, 3), max_size=2), seed=st.integers(0, 1000))
def test_cholesky_of_positive_definite_equals_lapack(size, batch, seed):
    matrix = positive_definite(*batch, size, seed=seed)
    torch.testing.assert_close(cholesky(matrix), torch.linalg.cholesky(matrix), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e6])
def test_cholesky_is_exact_when_a_state_is_a_copy_of_another(scale):
    # The last six rows repeat the first six, whatever the units.
    choice = torch.cat([torch.eye(9), torch.eye(9)[:6]]).double()
    matrix = scale * choice @ positive_definite(9) @ choice.T
    factor = cholesky(matrix)
    torch.testing.assert_close(factor @ factor.T, matrix, rtol=0, atol=1e-12 * scale)
    assert (factor[:, 9:] == 0).all()


def test_cholesky_is_exact_when_states_of_very_different_scale_are_copied():
    units = torch.tensor([1e2, 1e2, 1e-4, 1e-3, 1.0, 1e-2], dtype=torch.float64)
    choice = torch.cat([torch.diag(units), torch.diag(units)])
    matrix = choice @ positive_definite(6) @ choice.T
    factor = cholesky(matrix)
    deviations = matrix.diagonal().sqrt()
    error = (factor @ factor.T - matrix) / (deviations[:, None] * deviations)
    assert error.abs().max() < 1e-12


def test_cholesky_of_known_states_has_zero_rows():
    matrix = torch.zeros(7, 7, dtype=torch.float64)
    uncertain = torch.tensor([1, 3, 6])
    matrix[uncertain[:, None], uncertain] = positive_definite(3)
    factor = cholesky(matrix)
    torch.testing.assert_close(factor @ factor.T, matrix, rtol=0, atol=1e-12)
    assert (factor[[0, 2, 4, 5]] == 0).all()
    assert (cholesky(torch.zeros(4, 4, dtype=torch.float64)) == 0).all()


@pytest.mark.parametrize("rank", [1, 5, 11])
def test_cholesky_of_low_rank_gives_the_matrix_back(rank):
    root = random_matrices(12, rank, seed=rank)
    factor = cholesky(root @ root.T)
    torch.testing.assert_close(factor @ factor.T, root @ root.T, rtol=0, atol=1e-12)
    torch.testing.assert_close(factor, factor.tril(), rtol=0, atol=0)


def test_cholesky_reads_only_the_lower_triangle():
    matrix = positive_definite(8)
    garbage = matrix.tril() + random_matrices(8, 8, seed=5).triu(1)
    assert torch.equal(cholesky(garbage), cholesky(matrix))


def test_a_batch_equals_a_loop():
    matrices = positive_definite(3, 4, 6)
    factors = cholesky(matrices)
    for i in range(3):
        for j in range(4):
            torch.testing.assert_close(factors[i, j], cholesky(matrices[i, j]), rtol=0, atol=1e-13)


def test_dtype_follows_the_input():
    assert cholesky(positive_definite(5).float()).dtype == torch.float32


def test_arguments_are_not_changed():
    matrix = positive_definite(5)
    kept = matrix.clone()
    cholesky(matrix)
    assert torch.equal(matrix, kept)

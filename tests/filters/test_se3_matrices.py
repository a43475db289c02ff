import numpy as np
import pytest
import torch
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.func import jacrev

from sigmaslam.geometry import se3 as rotation
from sigmaslam_filters.manifolds.se3_matrices import adjoint_se3, exp_se3, invert_se3, log_se3, skew


def twists(count: int, angles: Tensor, seed: int = 0) -> Tensor:
    """Twists (count, 6) that turn by the given angles about random axes."""
    generator = torch.Generator().manual_seed(seed)
    axes = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    axes = axes / axes.norm(dim=1, keepdim=True)
    return torch.cat([torch.randn(count, 3, generator=generator, dtype=torch.float64), axes * angles[:, None]], dim=1)


def spread_twists() -> Tensor:
    """Turns of zero, of 1e-14 to 1e-1 and up to 3 radians."""
    tiny = 10.0 ** torch.linspace(-14, -1, 200, dtype=torch.float64)
    around_the_series = torch.linspace(0.9e-3, 1.1e-3, 21, dtype=torch.float64)
    angles = torch.cat(
        [torch.zeros(1).double(), tiny, around_the_series, torch.linspace(0.1, 3.0, 100, dtype=torch.float64)]
    )
    return twists(len(angles), angles)


def test_exp_equals_the_matrix_exponential():
    tangents = spread_twists()[::7]
    for tangent, found in zip(tangents.numpy(), exp_se3(tangents).numpy(), strict=True):
        generator = np.zeros((4, 4))
        generator[:3, :3], generator[:3, 3] = rotation.skew(tangent[3:]), tangent[:3]
        np.testing.assert_allclose(found, expm(generator), atol=2e-14)


def test_rotation_of_exp_equals_scipy():
    tangents = spread_twists()
    found = exp_se3(tangents)[:, :3, :3].numpy()
    np.testing.assert_allclose(found, Rotation.from_rotvec(tangents[:, 3:].numpy()).as_matrix(), atol=2e-15)


def test_numpy_and_torch_agree():
    tangents = spread_twists()
    T = exp_se3(tangents)
    np.testing.assert_allclose(T.numpy(), rotation.se3_exp(tangents.numpy()), atol=2e-15)
    np.testing.assert_allclose(log_se3(T).numpy(), rotation.se3_log(T.numpy()), atol=2e-13)
    np.testing.assert_allclose(invert_se3(T).numpy(), rotation.se3_inverse(T.numpy()), atol=1e-15)
    np.testing.assert_allclose(adjoint_se3(T).numpy(), rotation.se3_adjoint(T.numpy()), atol=1e-15)
    np.testing.assert_array_equal(skew(tangents[:, :3]).numpy(), rotation.skew(tangents[:, :3].numpy()))


def test_log_inverts_exp():
    tangents = spread_twists()
    torch.testing.assert_close(log_se3(exp_se3(tangents)), tangents, rtol=0, atol=2e-13)


def test_log_keeps_the_relative_accuracy_of_tiny_motions():
    tangents = 1e-12 * twists(20, torch.full((20,), 1.0, dtype=torch.float64))
    torch.testing.assert_close(log_se3(exp_se3(tangents)), tangents, rtol=1e-10, atol=0)


@pytest.mark.parametrize(("from_pi", "accuracy"), [(1e-1, 1e-12), (1e-2, 1e-10), (1e-3, 1e-8), (1e-4, 1e-6)])
def test_log_loses_accuracy_with_the_square_of_the_distance_from_a_half_turn(from_pi, accuracy):
    tangents = twists(200, torch.full((200,), np.pi - from_pi, dtype=torch.float64))
    torch.testing.assert_close(log_se3(exp_se3(tangents)), tangents, rtol=0, atol=accuracy)


def test_exp_of_log_gives_the_motion_back():
    T = exp_se3(twists(50, torch.linspace(0, 3.0, 50, dtype=torch.float64)))
    torch.testing.assert_close(exp_se3(log_se3(T)), T, rtol=0, atol=2e-13)


def test_adjoint_carries_a_twist_through_a_motion():
    T = exp_se3(twists(20, torch.linspace(0, 3, 20, dtype=torch.float64), seed=1))
    tangents = twists(20, torch.linspace(0, 2, 20, dtype=torch.float64), seed=2)
    carried = (adjoint_se3(T) @ tangents.unsqueeze(-1)).squeeze(-1)
    torch.testing.assert_close(T @ exp_se3(tangents) @ invert_se3(T), exp_se3(carried), rtol=0, atol=1e-13)


def test_adjoint_of_a_product_is_the_product_of_adjoints():
    a, b = exp_se3(twists(2, torch.tensor([1.0, 2.0], dtype=torch.float64)))
    torch.testing.assert_close(adjoint_se3(a @ b), adjoint_se3(a) @ adjoint_se3(b), rtol=0, atol=1e-14)


def test_inverse_undoes_a_motion():
    T = exp_se3(spread_twists())
    torch.testing.assert_close(invert_se3(T) @ T, torch.eye(4).double().expand_as(T), rtol=0, atol=1e-14)


def test_batches_equal_single_calls():
    tangents = spread_twists()[:24].reshape(2, 3, 4, 6)
    T = exp_se3(tangents)
    assert T.shape == (2, 3, 4, 4, 4)
    torch.testing.assert_close(T[1, 2, 3], exp_se3(tangents[1, 2, 3]), rtol=0, atol=1e-15)
    torch.testing.assert_close(log_se3(T)[1, 2, 3], log_se3(T[1, 2, 3]), rtol=0, atol=1e-15)


def test_derivative_at_zero_is_the_basis_of_the_algebra():
    zero = torch.zeros(6, dtype=torch.float64)
    derivative = jacrev(exp_se3)(zero)
    for i, tangent in enumerate(torch.eye(6, dtype=torch.float64)):
        torch.testing.assert_close(derivative[:3, :3, i], skew(tangent[3:]), rtol=0, atol=1e-15)
        torch.testing.assert_close(derivative[:3, 3, i], tangent[:3], rtol=0, atol=1e-15)
    around = jacrev(lambda tangent: log_se3(exp_se3(tangent)))(zero)
    torch.testing.assert_close(around, torch.eye(6, dtype=torch.float64), rtol=0, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-7, 0.9e-3, 1.1e-3, 0.5, 3.0])
def test_log_after_exp_has_the_identity_as_derivative(angle):
    tangent = twists(1, torch.tensor([angle], dtype=torch.float64))[0]
    around = jacrev(lambda tangent: log_se3(exp_se3(tangent)))(tangent)
    torch.testing.assert_close(around, torch.eye(6, dtype=torch.float64), rtol=0, atol=1e-6)

"""Closed forms of a manifold's derivatives are what differentiation of its two functions gives."""

import pytest
import torch
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_filters.core.forward_mode import push_along
from sigmaslam_filters.manifolds import SE2, SE3, SO2, SO3, Euclidean, Manifold, Product
from sigmaslam_filters.manifolds.tangent_maps import Differentiated, TangentMaps, tangent_maps
from tests.support.filter_assertions import assert_close
from tests.support.filter_builders import covariances, random_numbers, tensor

MANIFOLDS: list[Manifold] = [
    Euclidean(3),
    SO2(),
    *(kind(side) for kind in (SE2, SO3, SE3) for side in ("right", "left")),
    Product(SE3("left"), SO2(), Euclidean(2), SE2()),
]
each_manifold = pytest.mark.parametrize("manifold", MANIFOLDS, ids=str)
MAPS = ("push_retract", "push_local", "transport", "transport_back")
# Of rotations: none, across the end of each series, and to just under half a turn.
SCALES = tensor(0.0, 1e-9, 1e-4, 0.02, 0.2, 0.3, 1.0, 1.7)


def arguments(manifold: Manifold, name: str, grad: bool = False) -> list[Tensor]:
    """Points, tangents that turn by up to 3 rad, and seven changes along each."""
    count = len(SCALES)
    origin = torch.zeros(manifold.point_size, dtype=torch.float64)
    for part, place in quaternions(manifold):
        origin[place + part.point_size - 1] = 1.0
    point = manifold.retract(origin.expand(count, -1), 0.6 * random_numbers(count, manifold.tangent_size))
    tangent = random_numbers(count, manifold.tangent_size, seed=1)
    tangent = SCALES.unsqueeze(-1) * tangent / tangent.norm(dim=-1, keepdim=True) * 1.7
    size = manifold.point_size if name == "push_local" else manifold.tangent_size
    change = random_numbers(7, count, size, seed=2)
    given = [point, tangent, change] if name.startswith("transport") else [point, change]
    return [each.requires_grad_(grad) for each in given]


def quaternions(manifold: Manifold) -> list[tuple[Manifold, int]]:
    """Parts that end with a quaternion, and where they begin."""
    parts = manifold.parts if isinstance(manifold, Product) else (manifold,)
    starts = [sum(part.point_size for part in parts[:k]) for k in range(len(parts))]
    return [(part, start) for part, start in zip(parts, starts, strict=True) if isinstance(part, SO3 | SE3)]


@each_manifold
@pytest.mark.parametrize("name", MAPS)
def test_closed_forms_equal_derivatives(manifold: Manifold, name: str):
    given = arguments(manifold, name)
    assert tangent_maps(manifold) is manifold
    assert_close(getattr(manifold, name)(*given), getattr(Differentiated(manifold), name)(*given), 1e-10)


@each_manifold
@pytest.mark.parametrize("name", MAPS)
def test_gradients_of_closed_forms_equal_those_of_derivatives(manifold: Manifold, name: str):
    weights, found = None, []
    for maps in (manifold, Differentiated(manifold)):
        given = arguments(manifold, name, grad=True)
        result = getattr(maps, name)(*given)
        weights = random_numbers(*result.shape, seed=3) if weights is None else weights
        found.append(torch.autograd.grad((weights * result).sum(), given, allow_unused=True, materialize_grads=True))
    places = quaternions(manifold)
    for a, b in zip(*found, strict=True):
        if a.shape[-1] == manifold.point_size:
            # A unit quaternion does not become longer: along it the gradient has no meaning.
            a, b = a.clone(), b.clone()
            for part, start in places:
                end = start + part.point_size
                quaternion = given[0].detach()[..., end - 4 : end]
                for each in (a, b):
                    inner = each[..., end - 4 : end]
                    inner -= (inner * quaternion).sum(-1, keepdim=True) * quaternion
        assert torch.isfinite(a).all()
        assert_close(a, b, 1e-9)


@each_manifold
def test_transports_undo_each_other(manifold: Manifold):
    point, tangent, change = arguments(manifold, "transport")
    there = manifold.transport(point, tangent, change)
    assert_close(manifold.transport_back(point, tangent, there), change, 1e-12)


class Bare:
    """SE(3) without closed forms."""

    point_size, tangent_size = 7, 6
    retract = staticmethod(SE3().retract)
    local = staticmethod(SE3().local)


@pytest.mark.parametrize("iterations", [1, 3])
def test_extended_filter_is_the_same_without_closed_forms(iterations: int):
    assert not isinstance(Bare(), TangentMaps)
    space, found = SE3(), []
    step, matrix = 0.3 * random_numbers(6, seed=4), random_numbers(5, 7, seed=5)
    motion = filters.MotionModel(lambda x, w: space.retract(x, step + w), covariances(6, scale=0.01), additive=False)
    see = filters.MeasurementModel(
        lambda x: torch.sin(x @ matrix.mT),
        filters.Diagonal(tensor(*[0.01] * 5)),
        residual=lambda a, b: torch.sin(a - b),
    )
    mean = arguments(space, "push_local")[0]
    for each in (space, Bare()):
        bayes = filters.ExtendedKalmanFilter(each, iterations=iterations)
        start = filters.Gaussian(mean, covariances(len(mean), 6, scale=0.02))
        track = bayes.filter(start, motion, see, random_numbers(4, len(mean), 5, seed=6))
        smoothed = bayes.smooth(track)
        found.append((track.filtered.mean, track.filtered.covariance, track.nis, smoothed.mean, smoothed.covariance))
    for a, b in zip(*found, strict=True):
        assert_close(a, b, 1e-10)


def test_derivatives_along_directions_equal_those_of_torch():
    """Numbers and constants on both sides of each operator, in and out of inference mode."""
    x, direction, constant = random_numbers(3, 4).abs() + 0.5, random_numbers(3, 4, seed=1), random_numbers(4, seed=2)

    def function(x: Tensor) -> Tensor:
        y = (2.0 * x - 1.0) / 3.0 + (1.5 - x) * constant + 1.0 / x + constant / x - (constant - x) / (x + 3)
        y = torch.hypot(y, constant) + torch.atan2(constant, x) + torch.addcmul(constant, x, x) + x * 2 + x**2
        return torch.where(y > constant, y, 0.5 * constant) + torch.sub(y, constant, alpha=0.3)

    expected = torch.func.jvp(function, (x,), (direction,))
    for inference in (False, True):
        with torch.inference_mode(inference):
            inner = constant.clone()  # one that torch can take no gradients of
            found = push_along(lambda x, c=inner: function(x) + 0.0 * c, [x], [direction])
        for a, b in zip(found, expected, strict=True):
            assert_close(a, b, 1e-14)


def test_gradients_go_through_derivatives_along_directions():
    scale = tensor(0.7).requires_grad_()
    x, direction = random_numbers(3, 4), random_numbers(3, 4, seed=1)
    _, slope = push_along(lambda x: torch.sin(scale * x) + scale, [x], [direction])
    (found,) = torch.autograd.grad(slope.sum(), scale)
    s = scale.detach().requires_grad_()
    (expected,) = torch.autograd.grad((torch.cos(s * x) * s * direction).sum(), s)
    assert_close(found, expected, 1e-14)


@pytest.mark.long
def test_a_derivative_of_derivatives_along_broadcast_changes():
    """As in a compiled filter: one point, several changes; torch takes no derivative of what shares memory."""
    maps, point, changes = Differentiated(SO3()), tensor(0.0, 0.0, 0.0, 1.0), random_numbers(3, 4)
    value, slope = torch.func.jvp(lambda change: maps.push_local(point, change), (changes,), (changes,))
    # It is linear in the change.
    assert_close(slope, value, 1e-12)

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from kornia.geometry.conversions import rotation_matrix_to_quaternion
from kornia.geometry.liegroup import Se2, Se3, So2, So3
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.func import jacfwd, jacrev, jvp, vmap

from sigmaslam_filters.core.layout import concatenate, stack
from sigmaslam_filters.manifolds import SE2, SE3, SO2, SO3, Euclidean, Manifold, Product
from sigmaslam_filters.manifolds.se3_matrices import adjoint_se3, exp_se3, log_se3, skew
from tests.support.filter_builders import random_numbers

Group = SE2 | SO3 | SE3

GROUPS: list[Group] = [kind(side) for kind in (SE2, SO3, SE3) for side in ("right", "left")]
MANIFOLDS: list[Manifold] = [Euclidean(3), SO2(), *GROUPS, Product(SE3("left"), SO2(), Euclidean(2), SO3())]
each_group = pytest.mark.parametrize("group", GROUPS, ids=str)
each_manifold = pytest.mark.parametrize("manifold", MANIFOLDS, ids=str)

# Turns of nothing, of 1e-300 to 0.1, across the ends of the series, and to just under half a turn.
TINY = [0.0, *(10.0**k for k in (-300, -160, -30, -20, -10, -8, -6, -4, -3, -2, -1))]
ANGLES = [*TINY, *np.linspace(0.05, 3.14, 400), math.pi - 1e-6, math.pi - 1e-9]


def random_axes(count: int, seed: int = 0) -> Tensor:
    axes = random_numbers(count, 3, seed=seed)
    return axes / axes.norm(dim=-1, keepdim=True)


def tangents(manifold: Manifold, angles: Tensor, seed: int = 0) -> Tensor:
    """Tangents (len(angles), n) of which every rotation turns by the angles, about random axes."""
    if isinstance(manifold, Product):
        return torch.cat([tangents(part, angles, seed + i) for i, part in enumerate(manifold.parts)], dim=-1)
    result = random_numbers(len(angles), manifold.tangent_size, seed=seed)
    if isinstance(manifold, SO2 | SE2):
        result[:, -1] = angles * result[:, -1].sign()
    elif isinstance(manifold, SO3 | SE3):
        result[:, -3:] = random_axes(len(angles), seed=seed + 100) * angles.unsqueeze(-1)
    return result


def spread_tangents(manifold: Manifold) -> Tensor:
    return tangents(manifold, torch.tensor(ANGLES, dtype=torch.float64))


def identity(manifold: Manifold) -> Tensor:
    if isinstance(manifold, Product):
        return torch.cat([identity(part) for part in manifold.parts])
    point = torch.zeros(manifold.point_size, dtype=torch.float64)
    if isinstance(manifold, SO3 | SE3):
        point[-1] = 1.0
    return point


def random_points(manifold: Manifold, count: int, seed: int = 10) -> Tensor:
    angles = torch.linspace(0.1, 3.1, count, dtype=torch.float64)
    return manifold.retract(identity(manifold), tangents(manifold, angles, seed))


def hat(group: Group, tangent: Tensor) -> Tensor:
    """Matrices of the Lie algebra."""
    if isinstance(group, SO3):
        return skew(tangent)
    size = group.tangent_size // 2 if isinstance(group, SE3) else 2
    result = torch.zeros(*tangent.shape[:-1], size + 1, size + 1, dtype=tangent.dtype)
    result[..., :size, size] = tangent[..., :size]
    if isinstance(group, SE3):
        result[..., :3, :3] = skew(tangent[..., 3:])
    else:
        result[..., 0, 1], result[..., 1, 0] = -tangent[..., 2], tangent[..., 2]
    return result


def exp(group: Group, tangent: Tensor) -> Tensor:
    return group.retract(identity(group).to(tangent.dtype), tangent)


def log(group: Group, point: Tensor) -> Tensor:
    return group.local(identity(group).to(point.dtype), point)


def there_and_back(manifold: Manifold, point: Tensor) -> Callable[[Tensor], Tensor]:
    return lambda tangent: manifold.local(point, manifold.retract(point, tangent))


# Round trips


@each_manifold
def test_local_undoes_retract_up_to_half_a_turn(manifold: Manifold):
    tangent = spread_tangents(manifold)
    point = random_points(manifold, len(tangent))
    torch.testing.assert_close(there_and_back(manifold, point)(tangent), tangent, rtol=0, atol=2e-14)


@each_manifold
def test_local_leads_to_the_other_point(manifold: Manifold):
    start, end = random_points(manifold, 200), random_points(manifold, 200, seed=20)
    found = manifold.retract(start, manifold.local(start, end))
    # Of a quaternion, either sign will do.
    torch.testing.assert_close(manifold.local(end, found), 0 * manifold.local(end, end), rtol=0, atol=2e-14)


@each_group
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_tiny_turns_keep_their_digits(group: Group, dtype: torch.dtype):
    smallest = 1e-300 if dtype == torch.float64 else 1e-37
    angles = torch.tensor([a for a in TINY if a >= smallest], dtype=dtype).unsqueeze(-1)
    tangent = angles * tangents(group, torch.ones(len(angles), dtype=torch.float64)).to(dtype)
    error = (there_and_back(group, identity(group).to(dtype))(tangent) - tangent).abs() / angles
    assert error.max() < 4 * torch.finfo(dtype).eps


@pytest.mark.parametrize("side", ["left", "right"])
def test_half_a_turn_itself(side: str):
    axes = random_axes(100)
    half_turn = torch.full((100,), math.pi, dtype=torch.float64)
    for group, found in ((SO3(side), slice(0, 3)), (SE3(side), slice(3, 6))):
        tangent = torch.zeros(100, group.tangent_size, dtype=torch.float64)
        tangent[:, found] = math.pi * axes
        point = random_points(group, 100)
        back = there_and_back(group, point)(tangent)[:, found]
        torch.testing.assert_close(back.norm(dim=-1), half_turn, rtol=0, atol=4e-15)
        torch.testing.assert_close((back * axes).sum(dim=-1).abs(), half_turn)
    for quaternion in ([0.6, 0.0, 0.8, 0.0], [-0.6, 0.0, -0.8, 0.0], [-0.6, 0.0, -0.8, -0.0]):
        point = torch.tensor(quaternion, dtype=torch.float64)
        found_angle = SO3(side).local(identity(SO3()), point).norm()
        assert found_angle == pytest.approx(math.pi, abs=1e-15)


@pytest.mark.parametrize("group", [g for g in GROUPS if not isinstance(g, SE2)], ids=str)
def test_both_signs_of_a_quaternion_are_one_rotation(group: Group):
    start, end = random_points(group, 100), random_points(group, 100, seed=20)
    signs = torch.ones(group.point_size, dtype=torch.float64)
    signs[-4:] = -1.0
    expected = group.local(start, end)
    assert expected[..., -3:].norm(dim=-1).max() <= math.pi
    torch.testing.assert_close(group.local(start * signs, end), expected)
    torch.testing.assert_close(group.local(start, end * signs), expected)


def test_angles_wrap_to_the_half_open_interval():
    pi = math.pi
    edges = [math.nextafter(s * pi, t) for s in (-3, -1, 1, 3) for t in (-10, 10)]
    angle = torch.tensor([0.0, 1e-300, 3.0, -3.0, pi, -pi, 3 * pi, -3 * pi, 7.0, -7.0, 100.0, *edges]).double()
    angle = torch.cat([angle, 40.0 * random_numbers(10_000)]).unsqueeze(-1)
    for found in (
        SO2().retract(0 * angle, angle),
        SO2().local(0 * angle, angle),
        SO2().local(-0.5 * angle, 0.5 * angle),
    ):
        assert (found > -pi).all()
        assert (found <= pi).all()
        torch.testing.assert_close(found.sin(), angle.sin(), rtol=0, atol=1e-13)
        torch.testing.assert_close(found.cos(), angle.cos(), rtol=0, atol=1e-13)
        kept = (angle > -pi) & (angle <= pi)
        assert (found == angle)[kept].all()
    single = angle.float()
    assert (SO2().retract(0 * single, single) > -torch.tensor(pi)).all()
    assert (SO2().retract(0 * single, single) <= torch.tensor(pi)).all()
    assert SO2().local(torch.tensor([-3.0]), torch.tensor([3.0])).item() == pytest.approx(6.0 - 2 * pi, abs=1e-6)


@pytest.mark.parametrize("steps", [300, pytest.param(100_000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_a_long_chain_stays_at_unit_length(steps: int, dtype: torch.dtype):
    steps_taken = (0.3 * random_numbers(steps, 3)).to(dtype)
    point = identity(SO3()).to(dtype)
    for tangent in steps_taken:
        point = SO3().retract(point, tangent)
    assert abs(point.double().norm().item() - 1.0) < 2 * torch.finfo(dtype).eps


# Known answers


@each_group
def test_retract_multiplies_by_the_matrix_exponential(group: Group):
    tangent = spread_tangents(group)
    point = random_points(group, len(tangent))
    moved, start = group.to_matrix(group.retract(point, tangent)), group.to_matrix(point)
    step = torch.linalg.matrix_exp(hat(group, tangent))
    torch.testing.assert_close(moved, start @ step if group.side == "right" else step @ start, rtol=0, atol=3e-14)


@pytest.mark.parametrize("group", GROUPS[::2], ids=str)
def test_left_and_right_differ_by_the_adjoint(group: Group):
    tangent, point = spread_tangents(group), random_points(group, len(ANGLES))
    if isinstance(group, SE3):
        adjoint = adjoint_se3(group.to_matrix(point))
    elif isinstance(group, SO3):
        adjoint = group.to_matrix(point)
    else:
        adjoint = group.to_matrix(point)
        adjoint[..., 0, 2], adjoint[..., 1, 2] = point[..., 1], -point[..., 0]
    turned = (adjoint @ tangent.unsqueeze(-1)).squeeze(-1)
    other = type(group)("left")
    moved = group.retract(point, tangent)
    torch.testing.assert_close(
        group.to_matrix(other.retract(point, turned)), group.to_matrix(moved), atol=1e-14, rtol=0
    )
    torch.testing.assert_close(other.local(point, moved), turned, rtol=0, atol=3e-14)


def test_rotations_equal_scipy():
    tangent = spread_tangents(SO3())
    point = random_points(SO3(), len(tangent))
    turned = Rotation.from_quat(point.numpy()) * Rotation.from_rotvec(tangent.numpy())
    found = SO3().retract(point, tangent)
    np.testing.assert_allclose(SO3().to_matrix(found).numpy(), turned.as_matrix(), atol=2e-15)
    np.testing.assert_allclose(log(SO3(), found).numpy(), turned.as_rotvec(), atol=4e-15)
    kept = SO3().from_matrix(torch.from_numpy(turned.as_matrix()))
    np.testing.assert_allclose(kept.numpy(), turned.as_quat(canonical=True), atol=1e-15)


def test_motions_equal_the_exported_filters():
    tangent = spread_tangents(SE3())[:-100]
    T = exp_se3(tangent)
    torch.testing.assert_close(SE3().to_matrix(exp(SE3(), tangent)), T, rtol=0, atol=1e-14)
    torch.testing.assert_close(log(SE3(), SE3().from_matrix(T)), log_se3(T), rtol=0, atol=1e-13)


def test_groups_equal_kornia():
    # kornia's quaternions are (w, x, y, z), and its poses are parameters even when made of plain tensors.
    angles = torch.linspace(0.05, 3.1, 200, dtype=torch.float64)
    for group, theirs in ((SO3(), So3), (SE3(), Se3), (SE2(), Se2)):
        tangent = tangents(group, angles)
        point = exp(group, tangent)
        torch.testing.assert_close(group.to_matrix(point), theirs.exp(tangent).matrix().detach(), rtol=0, atol=1e-14)
        expected = theirs.from_matrix(group.to_matrix(point)).log().detach()
        torch.testing.assert_close(log(group, point), expected, rtol=0, atol=1e-13)
    angle = 5.0 * random_numbers(200)
    torch.testing.assert_close(SO2().retract(0 * angle[:, None], angle[:, None])[:, 0], So2.exp(angle).log().detach())
    R = SO3().to_matrix(random_points(SO3(), 100))
    quaternion = rotation_matrix_to_quaternion(R).roll(-1, dims=-1)
    torch.testing.assert_close(SO3().from_matrix(R), quaternion * quaternion[:, 3:].sign(), rtol=0, atol=1e-14)


@each_group
def test_matrices_and_points_convert_both_ways(group: Group):
    half_turns = torch.eye(3, dtype=torch.float64) * math.pi
    tangent = spread_tangents(group)
    if not isinstance(group, SE2):
        tangent[:3, -3:] = half_turns
    point = exp(group, tangent)
    matrix = group.to_matrix(point)
    back = group.from_matrix(matrix)
    torch.testing.assert_close(group.to_matrix(back), matrix, rtol=0, atol=1e-14)
    torch.testing.assert_close(group.local(point, back), torch.zeros_like(tangent), rtol=0, atol=1e-14)
    # Along the group, the matrix moves as the point does.
    step = random_numbers(*tangent.shape, seed=5)
    _, moved = jvp(
        lambda t: group.local(back, group.from_matrix(group.to_matrix(group.retract(back, t)))), (0 * step,), (step,)
    )
    torch.testing.assert_close(moved, step, rtol=0, atol=1e-13)
    if not isinstance(group, SE2):
        assert (back[..., -1] >= 0).all()


# Derivatives


@each_manifold
def test_there_and_back_has_derivative_identity(manifold: Manifold):
    at = tangents(manifold, torch.tensor([0.0, 1e-9, 1e-3, 0.1, 0.3, 1.0, 3.0, math.pi - 1e-6]).double())
    at[0] = 0.0
    points = torch.cat([identity(manifold).expand(1, -1), random_points(manifold, 7)])
    expected = torch.eye(manifold.tangent_size, dtype=torch.float64)
    for derivative in (jacfwd, jacrev):
        found = vmap(lambda x, v, d=derivative: d(there_and_back(manifold, x))(v))(points, at)
        torch.testing.assert_close(found, expected.expand_as(found), rtol=0, atol=2e-13)


@each_manifold
def test_derivatives_are_finite_at_special_points(manifold: Manifold):
    x = identity(manifold)
    half_turn = tangents(manifold, torch.tensor([math.pi], dtype=torch.float64))[0]
    v = torch.stack([0.0 * half_turn, half_turn, 1e-200 * half_turn])
    y = manifold.retract(x, v)

    def squared(v: Tensor) -> Tensor:
        return manifold.local(x, manifold.retract(x, v)).square().sum()

    assert vmap(jacfwd(jacrev(squared)))(v).isfinite().all()
    for derivative in (jacfwd, jacrev):
        local, retract = (derivative(f, argnums=(0, 1)) for f in (manifold.local, manifold.retract))
        found = (*vmap(local, (None, 0))(x, y), *vmap(local, (0, None))(y, x), *vmap(retract, (None, 0))(x, v))
        assert all(d.isfinite().all() for d in found)


@each_manifold
def test_second_derivatives_agree_with_differences_across_the_ends_of_the_series(manifold: Manifold):
    v = tangents(manifold, torch.linspace(0.02, 0.4, 60, dtype=torch.float64))
    x = random_points(manifold, 60)
    gradient = vmap(jacrev(lambda v, x: manifold.retract(x, v).pow(3).sum()))
    step = 1e-5 * random_numbers(manifold.tangent_size, seed=7)
    _, found = jvp(lambda v: gradient(v, x), (v,), (step.expand_as(v),))
    torch.testing.assert_close(found, 0.5 * (gradient(v + step, x) - gradient(v - step, x)), rtol=0, atol=1e-11)


# Shapes, types and transforms


@each_manifold
def test_batches_broadcast_and_equal_a_loop(manifold: Manifold):
    points, v = random_points(manifold, 6), tangents(manifold, torch.linspace(0, 2, 6, dtype=torch.float64))
    found = manifold.retract(points.unsqueeze(1), v)
    assert found.shape == (6, 6, manifold.point_size)
    back = manifold.local(points.unsqueeze(1), found)
    assert back.shape == (6, 6, manifold.tangent_size)
    mapped = vmap(vmap(manifold.retract, (None, 0)), (0, None))(points, v)
    mapped_back = vmap(vmap(manifold.local, (None, 0)), (0, 0))(points, mapped)
    for i in range(6):
        for j in range(6):
            y = manifold.retract(points[i], v[j])
            torch.testing.assert_close(found[i, j], y, rtol=0, atol=4e-15)
            torch.testing.assert_close(mapped[i, j], y, rtol=0, atol=4e-15)
            torch.testing.assert_close(back[i, j], manifold.local(points[i], y), rtol=0, atol=4e-15)
            torch.testing.assert_close(mapped_back[i, j], manifold.local(points[i], y), rtol=0, atol=4e-15)
    assert manifold.retract(points[:0], v[:0]).shape == (0, manifold.point_size)


@each_manifold
def test_float32_is_as_accurate_as_it_can_be(manifold: Manifold):
    v = tangents(manifold, torch.linspace(0.0, 3.1, 3000, dtype=torch.float64)).float()
    x = random_points(manifold, 3000).float()
    y = manifold.retract(x, v)
    assert y.dtype == torch.float32
    eps = torch.finfo(torch.float32).eps
    # Quaternions of float32 are of unit length only to its round-off.
    torch.testing.assert_close(y.double(), manifold.retract(x.double(), v.double()), rtol=0, atol=12 * eps)
    torch.testing.assert_close(
        manifold.local(x, y).double(), manifold.local(x.double(), y.double()), rtol=0, atol=24 * eps
    )


@each_manifold
def test_arguments_are_left_alone(manifold: Manifold):
    x, v = random_points(manifold, 5), spread_tangents(manifold)[:5]
    before = x.clone(), v.clone()
    manifold.local(x, manifold.retract(x, v))
    assert torch.equal(x, before[0])
    assert torch.equal(v, before[1])


@each_manifold
def test_wrong_sizes_say_what_was_expected(manifold: Manifold):
    p, n = manifold.point_size, manifold.tangent_size
    name = type(manifold).__name__
    with pytest.raises(ValueError, match=rf"{name}.*point must have shape \(\.\.\., {p}\), got \(2, {p + 1}\)"):
        manifold.retract(torch.zeros(2, p + 1), torch.zeros(n))
    with pytest.raises(ValueError, match=rf"{name}.*tangent must have shape \(\.\.\., {n}\), got \({n + 1},\)"):
        manifold.retract(torch.zeros(p), torch.zeros(n + 1))
    with pytest.raises(ValueError, match=rf"{name}.*other must have shape \(\.\.\., {p}\), got \(\)"):
        manifold.local(torch.zeros(p), torch.zeros(()))


def test_wrong_settings_are_refused():
    with pytest.raises(ValueError, match=r'SE3: side must be "right".*got .up.'):
        SE3("up")
    with pytest.raises(ValueError, match="at least one"):
        Product()
    with pytest.raises(ValueError, match=r"SE2.*matrix must have shape \(\.\.\., 3, 3\), got \(4, 4\)"):
        SE2().from_matrix(torch.eye(4))


def assert_compiled_equals_eager(manifold: Manifold, backend: str) -> None:
    torch.compiler.reset()
    x, v = random_points(manifold, 30), spread_tangents(manifold)[::13][:30]
    run = torch.compile(lambda x, v: there_and_back(manifold, x)(v), fullgraph=True, dynamic=False, backend=backend)
    torch.testing.assert_close(run(x, v), there_and_back(manifold, x)(v), rtol=0, atol=1e-14)


@pytest.mark.long
def test_all_is_one_graph():
    assert_compiled_equals_eager(Product(SE3(), SE2("left"), SO2(), Euclidean(2)), backend="eager")


@pytest.mark.slow
@pytest.mark.parametrize("manifold", [MANIFOLDS[-1], Product(SE2(), SE2("left"), SE3())], ids=str)
def test_compiled_equals_eager(manifold: Manifold):
    assert_compiled_equals_eager(manifold, backend="inductor")


# Products and memory


def test_a_product_is_its_parts_end_to_end():
    parts: tuple[Manifold, ...] = (SE2(), Euclidean(2), SO3("left"), SO2())
    product = Product(*parts)
    assert (product.point_size, product.tangent_size) == (3 + 2 + 4 + 1, 3 + 2 + 3 + 1)
    points, others = ([random_points(part, 20, seed) for part in parts] for seed in (10, 20))
    v = [tangents(part, torch.linspace(0, 2, 20, dtype=torch.float64)) for part in parts]
    moved = torch.cat([part.retract(x, t) for part, x, t in zip(parts, points, v, strict=True)], dim=-1)
    between = torch.cat([part.local(x, y) for part, x, y in zip(parts, points, others, strict=True)], dim=-1)
    assert torch.equal(product.retract(torch.cat(points, dim=-1), torch.cat(v, dim=-1)), moved)
    assert torch.equal(product.local(torch.cat(points, dim=-1), torch.cat(others, dim=-1)), between)
    nested = Product(Product(*parts[:2]), Product(*parts[2:]))
    assert torch.equal(nested.retract(torch.cat(points, dim=-1), torch.cat(v, dim=-1)), moved)


def test_flat_means_addition():
    assert Euclidean(4).flat
    assert Product(Euclidean(4), Product(Euclidean(1))).flat
    assert not any(m.flat for m in MANIFOLDS[1:])
    x, v = random_numbers(7, 5), random_numbers(7, 5, seed=1)
    for manifold in (Euclidean(5), Product(Euclidean(4), Euclidean(1))):
        assert torch.equal(manifold.retract(x, v), x + v)
        assert torch.equal(manifold.local(x, v), v - x)


def test_manifolds_are_values():
    assert Product(SE3(), Euclidean(6)) == Product(SE3("right"), Euclidean(6))
    assert len({Product(SE3(), Euclidean(6)), Product(SE3("right"), Euclidean(6)), SE3(), SE3("left")}) == 3
    assert str(Product(SO2(), Euclidean(6))) == "Product(SO2(), Euclidean(size=6))"


def test_stacked_vectors_have_contiguous_components():
    x, y = random_numbers(4, 50), random_numbers(50, seed=1)
    found = stack([x, y, 2.0 * x])
    assert found.shape == (4, 50, 3)
    assert torch.equal(found, torch.stack([x, y.expand(4, 50), 2.0 * x], dim=-1))
    assert all(found[..., i].stride(-1) == 1 for i in range(3))
    joined = concatenate([found, found[..., :1]])
    assert torch.equal(joined, torch.cat([found, found[..., :1]], dim=-1))
    assert joined[..., 3].stride(-1) == 1
    assert torch.equal(stack([x[0, 0], y[0]]), torch.stack([x[0, 0], y[0]]))
    point = random_points(MANIFOLDS[-1], 50)
    assert point[:, 4].is_contiguous()

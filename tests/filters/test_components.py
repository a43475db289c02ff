"""A step rewritten in components does what it did, and nothing is assembled in it."""

import functools

import pytest
import torch
from torch._dynamo.backends.common import aot_autograd
from torch._inductor.decomposition import select_decomp_table

import sigmaslam_filters as filters
from sigmaslam_filters.compiler import components

BATCH = 200


@pytest.fixture(autouse=True)
def nothing_compiled_before():
    torch._dynamo.reset()


def drive(state, control):
    x, y, heading = state[..., 0], state[..., 1], state[..., 2]
    distance, turn = control[..., 0], control[..., 1]
    return filters.stack([x + distance * torch.cos(heading), y + distance * torch.sin(heading), heading + turn])


def see(state, landmark):
    x, y = landmark[..., 0] - state[..., 0], landmark[..., 1] - state[..., 1]
    return filters.stack([torch.hypot(x, y), torch.atan2(y, x) - state[..., 2]])


def difference(measured, predicted):
    d = measured - predicted
    return filters.stack([d[..., 0], filters.wrap_angle(d[..., 1])])


def rewritten(step, arguments):
    """The step's graph, rewritten, as a function; and the graph."""
    graphs = []

    def compile_graph(module, example):
        components.InComponents()(module.graph, True)
        module.recompile()
        graphs.append(module.graph)
        return torch._functorch._aot_autograd.utils.make_boxed_func(module.forward)

    backend = aot_autograd(
        fw_compiler=compile_graph, inference_compiler=compile_graph, decompositions=select_decomp_table()
    )
    run = torch.compile(step, backend=backend, fullgraph=True, dynamic=False)
    run(*arguments)
    (graph,) = graphs
    return run, graph


def check_same(step, arguments, tolerance=3e-14):
    run, graph = rewritten(step, arguments)
    for found, expected in zip(run(*arguments), step(*arguments), strict=True):
        if expected.dtype == torch.bool:
            assert torch.equal(found, expected)
        else:
            scale = expected.nan_to_num().abs().max()
            torch.testing.assert_close(found, expected, rtol=0, atol=float(tolerance * scale), equal_nan=True)
    return graph


def prior(size=3, seed=0):
    generator = torch.Generator().manual_seed(seed)
    random = functools.partial(torch.randn, generator=generator, dtype=torch.float64)
    root = 0.1 * random(BATCH, size, size).tril()
    root.diagonal(dim1=-2, dim2=-1).abs_().add_(0.1)
    return random, random(BATCH, size), root


def localisation(bayes):
    motion = filters.MotionModel(drive, filters.Diagonal(torch.tensor([1e-4, 1e-4, 1e-5], dtype=torch.float64)))
    noise = filters.Diagonal(torch.tensor([0.01, 1e-4], dtype=torch.float64))
    sensor = filters.MeasurementModel(see, noise, residual=difference)

    def step(mean, root, control, value, landmark):
        belief = filters.Gaussian(mean, factor=root, factor_is_lower=True)
        result = bayes.update(bayes.predict(belief, motion, control).belief, sensor, value, landmark)
        return (
            result.belief.mean, result.belief.covariance, result.healthy, result.count, result.log_likelihood,
            result.nis, result.innovation,
        )  # fmt: skip

    random, mean, root = prior()
    landmark = 10.0 * random(BATCH, 2)
    control = random(BATCH, 2)
    value = see(drive(mean, control), landmark) + 0.1 * random(BATCH, 2)
    value[3, 0], value[4], value[5, 1] = torch.nan, torch.nan, torch.inf
    mean[6, 2], root[7, 1, 0], control[8, 0] = torch.nan, torch.inf, torch.nan
    return step, (mean, root, control, value, landmark)


@pytest.mark.long
@pytest.mark.parametrize(
    "bayes",
    [
        filters.UnscentedKalmanFilter(iterations=1, on_failure="hold"),
        filters.UnscentedKalmanFilter(points=filters.julier(1.0), on_failure="hold"),
        filters.ExtendedKalmanFilter(on_failure="hold"),
    ],
    ids=["cubature", "a centre and two linearisations", "ekf"],
)
def test_rewritten_steps_equal_the_library(bayes):
    step, arguments = localisation(bayes)
    graph = check_same(step, arguments)
    assert not step(*arguments)[2][5:8].any()
    shapes = {node.meta["val"].shape for node in graph.nodes if node.target is torch.ops.aten.mul.Tensor}
    assert {shape for shape in shapes if BATCH in shape} == {torch.Size([BATCH])}, "only components are multiplied"


@pytest.mark.long
def test_a_rewritten_step_raises_as_it_did():
    step, arguments = localisation(filters.UnscentedKalmanFilter(iterations=1, on_failure="raise"))
    arguments = [torch.where(torch.isfinite(each), each, 0.0) for each in arguments]
    run, _ = rewritten(step, arguments)
    arguments[0][7, 0] = torch.nan
    with pytest.raises(RuntimeError, match="a filter failed for an element"):
        run(*arguments)


@pytest.mark.long
def test_a_filter_on_a_manifold_is_rewritten():
    space = filters.SE2()
    ukf = filters.UnscentedKalmanFilter(space, iterations=1, on_failure="hold")
    odometry = filters.MotionModel(
        lambda pose, step: space.retract(pose, step), filters.Diagonal(torch.full((3,), 1e-3, dtype=torch.float64))
    )
    fix = filters.MeasurementModel(
        lambda pose: pose[..., :2], filters.Diagonal(torch.full((2,), 0.01, dtype=torch.float64))
    )

    def step(mean, root, moved, value):
        belief = filters.Gaussian(mean, factor=root, factor_is_lower=True)
        result = ukf.update(ukf.predict(belief, odometry, moved).belief, fix, value)
        return result.belief.mean, result.belief.covariance, result.healthy

    random, mean, root = prior()
    check_same(step, (mean, root, random(BATCH, 3), random(BATCH, 2)))


@pytest.mark.long
@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: x @ y.mT,
        lambda x, y: torch.einsum("bij,bkj->bik", x, y).sum(dim=(-2, -1)),
        lambda x, y: torch.linalg.solve(x + 9 * torch.eye(3), y),
        lambda x, y: x.amax(dim=-1) + y.prod(dim=-1),
        lambda x, y: (x > y).any(dim=-1) | (x > 0).all(dim=-1),
        lambda x, y: torch.stack([x, y]).sum(dim=0).flatten(-2),
        lambda x, y: torch.stack([x, y], dim=1).unflatten(2, (3, 1)).squeeze(3),
        lambda x, y: x[10:20] - y.mean(dim=0),
        lambda x, y: torch.cat([x, y], dim=0),
        lambda x, y: torch.cat([x, torch.zeros(len(x), 1, 3)], dim=1).cumsum(dim=-1),
        lambda x, y: x.flip(-1).mT.reshape(-1, 3) @ y[0],
        lambda x, y: torch.where(x[:, :1] > 0, x, 0.5) * torch.tensor([1.0, 0.0, 2.0]),
        lambda x, y: x.split([1, 2], dim=-1)[1] + y.unbind(-1)[0].unsqueeze(-1).expand(-1, -1, 2),
        lambda x, y: torch.nn.functional.pad(x, (1, 2, 0, 1), value=2.0) @ torch.ones(6, 2) + y.mean(),
        lambda x, y: torch.nn.functional.pad(x, (0, 0, 0, 0, 1, 1))[1:-1] - torch.nn.functional.pad(y, (-1, 1)),
        lambda x, y: x + torch.arange(3.0)[:, None].expand(len(x), 3, 3) * y.diagonal(dim1=-2, dim2=-1)[:, None],
        lambda x, y: ((x > y).sum(dim=-1), x.diagonal(1, 1, 2), y.diagonal(dim1=0, dim2=1)),
        lambda x, y: (x.to(torch.int64) + 1, x.isnan(), x.isfinite(), x.clamp(-0.5, 0.5), torch.zeros_like(y)),
    ],
)
def test_whatever_is_computed_comes_out_the_same(function):
    random, _, x = prior()
    y = random(BATCH, 3, 3)

    def step(x, y):
        made = function(x.float(), y.float())
        return made if isinstance(made, tuple) else (made,)

    check_same(step, (x, y), tolerance=1e-6)


def test_small_batches_and_long_programs_are_left_alone(monkeypatch):
    for batch, most in ((components.SMALLEST_BATCH - 1, 100), (BATCH, 5)):
        monkeypatch.setattr(components, "MOST_OPERATIONS", most)
        x = torch.randn(batch, 3, 3, generator=torch.Generator().manual_seed(0))
        graph = check_same(lambda x: (x.mT + torch.cos(x),), (x,), tolerance=0)
        assert any(node.target is torch.ops.aten.permute.default for node in graph.nodes)
        assert torch.Size([batch, 3, 3]) in {node.meta["val"].shape for node in graph.nodes if "cos" in node.name}
        torch._dynamo.reset()


@pytest.mark.slow
def test_compiled_it_equals_the_library():
    step, arguments = localisation(filters.UnscentedKalmanFilter(iterations=1, on_failure="hold"))
    run = filters.compile_step(step)
    for found, expected in zip(run(*arguments), step(*arguments), strict=True):
        if expected.dtype == torch.bool:
            assert torch.equal(found, expected)
        else:
            scale = float(expected.nan_to_num().abs().max())
            torch.testing.assert_close(found, expected, rtol=0, atol=3e-14 * scale, equal_nan=True)

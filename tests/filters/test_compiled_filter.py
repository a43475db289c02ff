"""compile_filter does what filter does, whatever it is compiled to."""

import logging

import pytest
import torch
from torch import Tensor

import sigmaslam_filters as filters
from sigmaslam_filters import systems
from sigmaslam_filters.compiler import compiled_filter
from sigmaslam_filters.compiler.scalar_sequence import CompiledStep, Plan, run_sequence
from sigmaslam_filters.compiler.scalar_step import ScalarStep, ScalarStepError
from tests.support.filter_assertions import assert_close
from tests.support.filter_builders import beliefs, bent_measurement, bent_motion, covariances, random_numbers, tensor

STEPS = 9


@pytest.fixture(autouse=True)
def nothing_compiled_before():
    torch._dynamo.reset()


def assert_same_track(found: filters.Track, expected: filters.Track, tolerance: float = 1e-12) -> None:
    for name in ("predicted", "filtered"):
        belief, other = getattr(found, name), getattr(expected, name)
        assert_close(belief.mean, other.mean, tolerance)
        assert_close(belief.covariance, other.covariance, tolerance)
        assert belief.is_square_root == other.is_square_root
    for name in ("innovation", "nis", "log_likelihood"):
        assert_close(getattr(found, name), getattr(expected, name), 100 * tolerance)
    assert torch.equal(found.count, expected.count)
    assert torch.equal(found.healthy, expected.healthy)


def linear() -> tuple[filters.LinearMotion, filters.LinearMeasurement]:
    motion = filters.LinearMotion(torch.eye(3).double() + 0.2 * random_numbers(3, 3), covariances(3, seed=1, scale=0.1))
    return motion, filters.LinearMeasurement(random_numbers(2, 3, seed=2), covariances(2, seed=3))


def is_one_function(run: compiled_filter.CompiledFilter) -> bool:
    return not run._steps and all(isinstance(step, CompiledStep) for step in run._scalar_steps.values())


@pytest.mark.slow
@pytest.mark.parametrize("batch", [(), (3,), (2, 2)], ids=str)
@pytest.mark.parametrize("form", ["auto", "qr"])
def test_compiled_linear_filter_equals_filter_for_other_batches_and_lengths(batch, form):
    """One function serves all batches and numbers of steps."""
    kf, models = filters.KalmanFilter(form=form), linear()
    run = filters.compile_filter(kf, *models)
    for steps, shape in ((STEPS, batch), (2, batch), (1, batch), (4, (5, *batch))):
        prior, values = beliefs(*shape, 3), random_numbers(steps, *shape, 2, seed=4)
        values[-1, ..., 0] = torch.nan
        assert_same_track(run(prior, values), kf.filter(prior, *models, values))
    assert len(run._scalar_steps) == 2  # the first event has no motion
    assert is_one_function(run)
    # A prior without a batch is that of every element, and so are values without one.
    assert_same_track(run(beliefs(3), values), kf.filter(beliefs(3), *models, values))
    assert_same_track(run(prior, values[:, 0]), kf.filter(prior, *models, values[:, :1].expand_as(values)))


def robot() -> tuple[filters.MotionModel, filters.MeasurementModel]:
    motion = systems.differential_drive(filters.Diagonal(tensor(0.05, 0.02) ** 2))
    return motion, systems.range_and_bearing(filters.Diagonal(tensor(0.1, 0.02) ** 2))


def pose() -> tuple[filters.MotionModel, filters.MeasurementModel]:
    space = filters.SE2("left")
    motion = filters.MotionModel(space.retract, filters.Diagonal(tensor(1e-3, 1e-3, 1e-4)))
    return motion, systems.range_and_bearing(filters.Diagonal(tensor(0.1, 0.02) ** 2))


def drawn(dtype: torch.dtype, size: int, *batch: int) -> tuple[filters.Gaussian, Tensor, list[Tensor], list[Tensor]]:
    """A prior, values with some missing, the motion's inputs and the landmarks."""
    prior = beliefs(*batch, 3, scale=0.05).to(dtype)
    values = torch.stack([random_numbers(STEPS, *batch).abs(), random_numbers(STEPS, *batch, seed=1)], dim=-1).to(dtype)
    values[2], values[4, ..., 0] = torch.nan, torch.nan
    controls = [0.3 * random_numbers(STEPS - 1, *batch, size, seed=2).to(dtype)]
    if size == 2:
        controls.append(0.1 + random_numbers(STEPS - 1, *batch, 1, seed=3).abs().to(dtype))
    return prior, values, controls, [5.0 * random_numbers(STEPS, *batch, 2, seed=4).to(dtype)]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "space", "models"),
    [
        pytest.param(filters.UnscentedKalmanFilter, None, robot, id="ukf, noisy controls"),
        pytest.param(filters.UnscentedKalmanFilter, filters.SE2("left"), pose, id="ukf, SE(2)"),
        pytest.param(filters.ExtendedKalmanFilter, filters.SE2("left"), pose, id="ekf, SE(2)"),
    ],
)
def test_compiled_filter_equals_filter_and_can_be_smoothed(make, space, models):
    bayes, (motion, see) = make(space), models()
    run = filters.compile_filter(bayes, motion, see)
    prior, values, controls, landmarks = drawn(torch.float64, 2 if models is robot else 3, 2)
    found = run(prior, values, controls, landmarks)
    expected = bayes.filter(prior, motion, see, values, controls, landmarks)
    assert_same_track(found, expected, 3e-12)
    assert is_one_function(run)
    smoothed, other = bayes.smooth(found), bayes.smooth(expected)
    assert_close(smoothed.mean, other.mean, 1e-10)
    assert_close(smoothed.covariance, other.covariance, 1e-10)
    # Landmarks of all elements alike.
    alike = [landmarks[0][:, 0]]
    assert_same_track(
        run(prior, values, controls, alike), bayes.filter(prior, motion, see, values, controls, alike), 3e-12
    )


@pytest.mark.slow
def test_compiled_filter_in_float32_goes_on_with_roots():
    ukf, (motion, see) = filters.UnscentedKalmanFilter(), robot()
    single = [
        type(model)(model.function, filters.Diagonal(model.noise.variance().float()), additive=model.additive)
        for model in (motion, see)
    ]
    single[1] = filters.MeasurementModel(see.function, single[1].noise, residual=see.residual)
    given = drawn(torch.float32, 2)
    run = filters.compile_filter(ukf, *single)
    found, expected = run(*given), ukf.filter(given[0], *single, *given[1:])
    assert_same_track(found, expected, 1e-4)
    assert is_one_function(run)


@pytest.mark.slow
def test_robust_weights_and_gates_are_compiled():
    ukf, (motion, see) = filters.UnscentedKalmanFilter(iterations=1), robot()
    prior, values, controls, landmarks = drawn(torch.float64, 2)
    values[5] = tensor(300.0, 0.1)
    for options in ({"gate": 0.999}, {"robust": "student_t"}):
        run = filters.compile_filter(ukf, motion, see, **options)
        found = run(prior, values, controls, landmarks)
        assert_same_track(found, ukf.filter(prior, motion, see, values, controls, landmarks, **options), 1e-11)
        assert is_one_function(run)


@pytest.mark.slow
def test_a_sequence_that_fails_raises_or_holds_as_filter_does():
    motion, see = bent_motion(2), bent_measurement(2, 2)
    prior, values = beliefs(3, 2), random_numbers(STEPS, 3, 2)
    values[4, 1] = torch.inf
    run = filters.compile_filter(filters.UnscentedKalmanFilter(), motion, see)
    with pytest.raises(filters.FilterError, match=r"step 4 of 9: update failed for batch elements \(1,\)"):
        run(prior, values)
    hold = filters.UnscentedKalmanFilter(on_failure="hold")
    found = filters.compile_filter(hold, motion, see)(prior, values)
    assert_same_track(found, hold.filter(prior, motion, see, values))
    assert not found.healthy[4, 1]
    broken = filters.Gaussian(prior.mean, factor=prior.factor).where(
        torch.tensor([True, False, True]), filters.Gaussian(prior.mean, -prior.covariance)
    )
    with pytest.raises(filters.FilterError, match="step 0 of 9"):
        run(broken, values)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["large batch", "many states", "special function"])
def test_what_is_no_small_arithmetic_is_a_loop_around_compiled_steps(case, caplog):
    size, batch = (24, 2) if case == "many states" else (2, 200 if case == "large batch" else 3)
    motion, see = bent_motion(size), bent_measurement(size, 2)
    if case == "special function":
        noise = filters.Diagonal(tensor(0.1, 0.1))
        see = filters.MeasurementModel(lambda x: torch.special.i0(x), noise)
    ukf = filters.UnscentedKalmanFilter(iterations=1)
    prior, values = beliefs(batch, size, scale=0.1), random_numbers(4, batch, 2)
    run = filters.compile_filter(ukf, motion, see)
    with caplog.at_level(logging.INFO, "sigmaslam_filters"):
        assert_same_track(run(prior, values), ukf.filter(prior, motion, see, values), 1e-11)
    assert run._steps
    assert ("a loop around compiled steps" in caplog.text) == (case != "large batch")


def test_arguments_that_do_not_fit_are_refused_before_anything_is_compiled():
    run = filters.compile_filter(filters.KalmanFilter(), *linear())
    with pytest.raises(ValueError, match=r"values \(T, \.\.\., m\)"):
        run(beliefs(3), torch.zeros(0, 2, dtype=torch.float64))
    with pytest.raises(ValueError, match="need motion inputs of length 1"):
        run(beliefs(3), random_numbers(2, 2), [random_numbers(2, 1)])
    with pytest.raises(ValueError, match="has 2 components, the value has 3"):
        run(beliefs(3), random_numbers(2, 3))
    assert not run._scalar_steps


UNARY = """abs neg sqrt rsqrt reciprocal sin cos tan asin acos atan sinh cosh tanh asinh atanh exp exp2 expm1 log log2
log10 log1p erf erfc floor ceil trunc round sign"""
BINARY = "add sub mul div hypot atan2 pow remainder fmod maximum minimum copysign"
COMPARISONS = "eq ne lt le gt ge logical_and logical_or logical_xor"


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_every_operation_is_that_of_torch(dtype):
    def step(state: Tensor, other: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        one = [getattr(torch, name)(x) for name in UNARY.split()]
        two = [getattr(torch, name)(x, y) for name in BINARY.split()]
        two += [x.clamp(-0.3, 0.3), x.clamp_min(0.1), x.clamp_max(0.1), torch.addcmul(x, x, y, value=0.7)]
        two += [torch.sub(x, y, alpha=0.1), torch.where(x > y, x, 0.1 / y), (x > 0.1).to(dtype) * y, x**3]
        flags = [getattr(torch, name)(x, y) for name in COMPARISONS.split()]
        flags += [x.isnan(), x.isinf(), x.isfinite(), x.signbit(), ~(x > 0) & (y > 0) | (x > y)]
        count = (torch.stack(flags, dim=-1).sum(dim=-1) + 2) * 3
        return state + x, other - x, torch.stack([*one, *two], dim=-1), torch.stack(flags, dim=-1), count

    x, y = 0.8 * random_numbers(7, 2).to(dtype).clamp(-1.2, 1.2), random_numbers(7, 2, seed=1).to(dtype)
    x[0, 0], x[1, 0], y[2, 1], x[3, 0], y[4, 0] = torch.nan, torch.inf, torch.nan, 0.0, x[4, 0]
    state = random_numbers(2, seed=2).to(dtype)
    scalar = ScalarStep(step, [state[0], state[0], x[0, 0], y[0, 0]])
    steps = [CompiledStep(scalar.source, range(5), scalar.adjoint_source)]
    plan = Plan(steps, torch.zeros(7).long(), torch.arange(7), [2], scalar.outputs)
    states, _, numbers, flags, counts = run_sequence(plan, [state, state], [[x, y]])
    tolerance = 1e-13 if dtype == torch.float64 else 1e-5
    for k in range(7):
        state, _, *expected = step(state, state, x[k], y[k])
        torch.testing.assert_close(states[k], state, rtol=tolerance, atol=tolerance, equal_nan=True)
        torch.testing.assert_close(numbers[k], expected[0], rtol=tolerance, atol=tolerance, equal_nan=True)
        assert torch.equal(flags[k], expected[1])
        assert torch.equal(counts[k], expected[2])


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (lambda state, x: (state + torch.special.i0(x), x + 1.0), "no form"),
        (lambda state, x: (state + x.to(torch.float16).to(x), x + 1.0), "float16"),
        (lambda state, x: (state + (x if x > 0 else -x), x + 1.0), "no arithmetic"),
    ],
)
def test_a_step_that_is_no_arithmetic_by_element_is_refused(step, message):
    with pytest.raises(ScalarStepError, match=message):
        ScalarStep(step, [tensor(1.0)[0], tensor(2.0)[0]])


# Where each is differentiable: what they are asked of lies between -1 and 1, and apart from zero.
DIFFERENTIABLE = """abs neg reciprocal sin cos tan asin acos atan sinh cosh tanh exp expm1 erf floor round sign square
sinc"""
POSITIVE = "sqrt rsqrt log log1p"
DIFFERENTIABLE_BY_BOTH = "add sub mul div hypot atan2 maximum minimum copysign"


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_every_derivative_is_that_of_torch(dtype):
    def step(state: Tensor, other: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
        one = [getattr(torch, name)(x) for name in DIFFERENTIABLE.split()]
        one += [getattr(torch, name)(x.abs()) for name in POSITIVE.split()]
        two = [getattr(torch, name)(x, y) for name in DIFFERENTIABLE_BY_BOTH.split()]
        two += [x.clamp(-0.3, 0.3), x.clamp_min(0.1), x.clamp_max(0.1), torch.addcmul(x, x, y, value=0.7)]
        two += [torch.sub(x, y, alpha=0.1), torch.where(x > y, x * y, 0.1 / y), x**3, x.abs() ** 0.3]
        two += [torch.remainder(x, 0.4), torch.fmod(x, 0.4)]
        return state * torch.sin(x) + other, other + state * y, torch.stack([*one, *two], dim=-1)

    x, y = (0.9 * random_numbers(6, 2, seed=seed).to(dtype).tanh() for seed in range(2))
    state = random_numbers(2, seed=2).to(dtype)
    given = [each.clone().requires_grad_() for each in (state, state, x, y)]
    scalar = ScalarStep(step, [state[0], state[0], x[0, 0], y[0, 0]])
    steps = [CompiledStep(scalar.source, range(3), scalar.adjoint_source)]
    plan = Plan(steps, torch.zeros(6).long(), torch.arange(6), [2], scalar.outputs)
    found = run_sequence(plan, given[:2], [given[2:]])
    first, second, rows = given[0], given[1], []
    for k in range(6):
        first, second, numbers = step(first, second, given[2][k], given[3][k])
        rows.append((first, second, numbers))
    weights = [random_numbers(*each.shape, seed=k).to(dtype) for k, each in enumerate(found)]
    gradients = [
        torch.autograd.grad(sum((a * w).sum() for a, w in zip(results, weights, strict=True)), given)
        for results in (found, [torch.stack(each) for each in zip(*rows, strict=True)])
    ]
    for a, b in zip(*gradients, strict=True):
        assert_close(a, b, 1e-12 if dtype == torch.float64 else 1e-4)


def test_what_has_no_derivative_is_said():
    step = ScalarStep(lambda x, y: (torch.remainder(y, x), x + 1.0), [tensor(1.0)[0], tensor(2.0)[0]])
    with pytest.raises(ScalarStepError, match=r"no derivative of aten\.remainder"):
        step.adjoint_source([True, True])

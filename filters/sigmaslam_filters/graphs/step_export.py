"""A filter's step as an ONNX graph: predict, update or both, of any filter and model, checked against torch."""

import logging
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.fx.experimental.proxy_tensor import make_fx

from sigmaslam_filters.bayes import BayesFilter
from sigmaslam_filters.core.noise_covariance import as_noise
from sigmaslam_filters.core.plain_factors import traced_for_export
from sigmaslam_filters.core.tensors import Inputs, as_inputs
from sigmaslam_filters.core.transforms import Taylor
from sigmaslam_filters.gaussian_belief import Gaussian
from sigmaslam_filters.graphs.exact_operators import ExactOperators
from sigmaslam_filters.graphs.graph_file import simplify, strip_origins
from sigmaslam_filters.models import AnyMeasurement, AnyMotion, NonlinearModel, several
from sigmaslam_filters.robust import Robust

_OPSET = 20
# Largest difference of graph and torch, relative to an output's largest value; more than this is a wrong graph.
TOLERANCES = {torch.float64: 1e-9, torch.float32: 1e-4}
# Batches and numbers of measurements that the graph is traced with, unlike any size of a model; and checked with.
_TRACED = 131, 137
_CHECKED = (1, 1), (3, 4), (8, 2)
_MISSING = 0.2


class ExportError(Exception):
    """A step cannot be written as a graph, or its graph does something else."""


@dataclass(frozen=True, slots=True, eq=False)
class StepExample:
    """Arguments of one step, of which the graph takes its sizes, names and dtype, and the check its numbers.

    Attributes:
        belief: without a batch, or with one dimension of it; the graph's batch is free.
        value: (m,) what was measured or, of several measurements of the model at one time, (l, m), of which the graph
            leaves the number free; behind the belief's batch. None: the graph predicts only.
        motion_inputs: what `predict` passes on to the motion's function, in its order, by names for the graph; without
            names they are motion_input_0, motion_input_1, ...
        measurement_inputs: the same of `update`: (·) behind the belief's batch or, for each of several measurements,
            (l, ·). One without the belief's batch is for all.
    """

    belief: Gaussian
    value: Tensor | None = None
    motion_inputs: Inputs = ()
    measurement_inputs: Inputs = ()

    def named(self, kind: Literal["motion", "measurement"]) -> Mapping[str, Tensor]:
        """Inputs of a model by their names."""
        given: Inputs = getattr(self, f"{kind}_inputs")
        if isinstance(given, Mapping):
            return given
        return {f"{kind}_input_{k}": each for k, each in enumerate(as_inputs(given))}


def export_step(
    bayes: BayesFilter,
    motion: AnyMotion | None,
    measurement: AnyMeasurement | None,
    example: StepExample,
    path: str | Path,
    *,
    gate: float | None = None,
    robust: Robust | None = None,
) -> float:
    """Writes a step of a filter as an ONNX graph, for any batch, or as a C++ header, in the dtype of the example.

    The graph's inputs are mean (b, p), covariance (b, n, n), the motion's inputs, value (b, m) or (b, l, m), and the
    measurement's inputs; outputs are posterior_mean, posterior_covariance, healthy (b,) and, with a measurement,
    log_likelihood, nis and count. In float32, and with form="qr", beliefs are held by roots: root (b, n, n) and
    posterior_root are lower triangular. A component of the value that is NaN is missing; where all are, the step only
    predicts. Nothing is raised in a graph: an element that fails is held, and `healthy` says so.

    A header (a path that ends in .hpp) has `predict` and `update` of one filter apart, in a namespace of the file's
    name, for as many measurements as the example has: C++17 without a heap or anything to link. Several sensors are a
    graph or a header each, called in the order of their events.

    Args:
        bayes: any filter. iterations="auto" always computes the second linearisation, and takes it where it should.
        motion: None for a graph that updates only.
        measurement: None for a graph that predicts only.
        example: see there.
        path: the file to write; its folder must exist.
        gate, robust: as `update`; each of several measurements is a block.
    Returns:
        The largest difference from torch, on arguments drawn at random about the example, in batches of other sizes and
        with missing components; relative to an output's largest value.
    Raises:
        ExportError: the models use something that ONNX or ONNX Runtime lacks, or the graph differs from torch by more
            than `TOLERANCES`. Nothing is written.
        ValueError: the example does not fit the models, or `path` ends in neither .onnx nor .hpp.
    """
    path = Path(path)
    if path.suffix not in (".onnx", ".hpp"):
        raise ValueError(f"{path}: give a name that ends in .onnx or .hpp")
    step = _Step(bayes, motion, measurement, _complete(example), gate, robust)
    # In place only when it is right: a graph that was there stays until then.
    path.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=path.parent) as folder:
        written = Path(folder) / path.name
        if path.suffix == ".hpp":
            difference = _difference(step, path.name, _header(step, written), [(1, step.count), (8, step.count)])
        else:
            _write(step, written)
            difference = _difference(step, path.name, _session(step, written), _CHECKED)
        if not difference <= (tolerance := TOLERANCES[example.belief.mean.dtype]):
            raise ExportError(
                f"{path.name} differs from torch by {difference:.2e}, more than {tolerance:.0e}: not written. "
                "Constants of the models may have lost digits: make them tensors of the belief's dtype"
            )
        written.replace(path)
    return difference


class _Step(nn.Module):
    """predict and update between named arrays."""

    def __init__(
        self,
        bayes: BayesFilter,
        motion: AnyMotion | None,
        measurement: AnyMeasurement | None,
        example: StepExample,
        gate: float | None,
        robust: Robust | None,
    ) -> None:
        super().__init__()
        if motion is None and measurement is None:
            raise ValueError("a step needs a motion, a measurement, or both")
        if (measurement is None) != (example.value is None):
            raise ValueError("a measurement needs a value in the example, and a value a measurement")
        self.bayes = replace(bayes, on_failure="hold") if bayes.on_failure == "raise" else bayes
        self.motion, self.measurement, self.example = motion, measurement, example
        self.gate, self.robust = gate, robust
        self.by_root = bayes.goes_on_with_roots(example.belief)
        self.is_stack = example.value is not None and example.value.ndim == 3

    @property
    def count(self) -> int:
        """How many measurements the example has."""
        return self.example.value.shape[1] if self.is_stack and self.example.value is not None else 1

    @property
    def arguments(self) -> dict[str, Tensor]:
        """The example by the names of the graph's inputs."""
        example, belief = self.example, self.example.belief
        held = {"root": belief.factor} if self.by_root else {"covariance": belief.covariance}
        named = {"mean": belief.mean, **held, **example.named("motion")}
        if example.value is not None:
            named["value"] = example.value
        for name, given in example.named("measurement").items():
            if name in named and named[name] is not given:
                raise ValueError(f"{name!r} names two inputs of the graph: give one of them another name")
            named[name] = given
        return named

    @property
    def differentiates(self) -> bool:
        """Whether a model is linearised by automatic differentiation."""
        models = [model for model in (self.motion, self.measurement) if isinstance(model, NonlinearModel)]
        return isinstance(self.bayes.transform, Taylor) and any(model.jacobian is None for model in models)

    @property
    def outputs(self) -> list[str]:
        """Names of what comes out."""
        held = "posterior_root" if self.by_root else "posterior_covariance"
        more = [] if self.measurement is None else ["log_likelihood", "nis", "count"]
        return ["posterior_mean", held, "healthy", *more]

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        """The step in torch."""
        named = dict(zip(self.arguments, given, strict=True))
        if self.by_root:
            belief = Gaussian(named["mean"], factor=named["root"], factor_is_lower=True)
        else:
            belief = Gaussian(named["mean"], named["covariance"])
        healthy = torch.ones_like(belief.mean[..., 0], dtype=torch.bool)
        if self.motion is not None:
            moved = self.bayes.predict(belief, self.motion, *(named[name] for name in self.example.named("motion")))
            belief, healthy = moved.belief, healthy & moved.healthy
        if self.measurement is None:
            return belief.mean, belief.held, healthy
        value, measurement = named["value"], self.measurement
        inputs = [named[name] for name in self.example.named("measurement")]
        if self.is_stack:
            measurement = several(measurement, value.shape[-2])
            inputs = [self._for_each(one) for one in inputs]
            value = value.flatten(-2)
        seen = self.bayes.update(belief, measurement, value, *inputs, gate=self.gate, robust=self.robust)
        count = torch.as_tensor(seen.count).expand(healthy.shape)
        healthy = healthy & seen.healthy
        return seen.belief.mean, seen.belief.held, healthy, seen.log_likelihood, seen.nis, count

    def _for_each(self, given: Tensor) -> Tensor:
        """An input that is the same for all measurements of a step gets a dimension for them."""
        batched, each = self.axes(given)
        return given.unsqueeze(1) if batched and not each else given

    def axes(self, given: Tensor) -> tuple[bool, bool]:
        """Whether an input has the batch as its first dimension, and the number of measurements as its second."""
        value = self.example.value
        batched = given.ndim > 0 and given.shape[:1] == self.example.belief.batch_shape
        if given is value:
            return batched, self.is_stack
        # The belief and the motion's inputs have no such dimension, whatever their sizes are.
        seen = any(given is one for one in self.example.named("measurement").values())
        each = self.is_stack and batched and seen and value is not None and given.shape[:2] == value.shape[:2]
        return batched, each and given.ndim > 2

    def free(self) -> tuple[dict[int, Any] | None, ...]:
        """Which dimensions of each input the graph leaves free."""
        batch, count = torch.export.Dim("batch", min=1), torch.export.Dim("count", min=1)
        dimensions: list[dict[int, Any]] = []
        for given in self.arguments.values():
            batched, each = self.axes(given)
            dimensions.append({**({0: batch} if batched else {}), **({1: count} if each else {})})
        return tuple(dimensions)

    def resized(self, batch: int, count: int, generator: torch.Generator | None = None) -> list[Tensor]:
        """The arguments for another batch and number of measurements: elements of the example, at random if drawn."""
        sizes = [batch, count]
        first = self.example.belief.mean.shape[0]
        picks = []
        for size, there in zip(sizes, (first, self.count), strict=True):
            if generator is None:
                picks.append(torch.arange(size) % there)
            else:
                picks.append(torch.randint(there, (size,), generator=generator))
        found = []
        for given in self.arguments.values():
            batched, each = self.axes(given)
            one = given[picks[0]] if batched else given
            found.append(one[:, picks[1]] if each else one)
        return found


def _complete(example: StepExample) -> StepExample:
    """The example with a batch dimension."""
    belief = example.belief
    if len(belief.batch_shape) > 1:
        raise ValueError(f"the example's belief has the batch {tuple(belief.batch_shape)}: one dimension at most")
    if len(belief.batch_shape) == 0:
        value = None if example.value is None else example.value[None]
        motion, measurement = (
            {name: given[None] for name, given in inputs.items()}
            for inputs in (example.named("motion"), example.named("measurement"))
        )
        belief = belief.expand((1,))
        example = replace(example, belief=belief, value=value, motion_inputs=motion, measurement_inputs=measurement)
    if example.value is not None and example.value.ndim not in (2, 3):
        raise ValueError(f"value (m,) or (l, m) behind the belief's batch expected, got {tuple(example.value.shape)}")
    return example


def _write(step: _Step, path: Path) -> None:
    try:
        import onnxscript  # noqa: F401 - only the exporter needs it
    except ImportError as error:
        raise ExportError("writing a graph needs onnx and onnxscript: pip install 'sigmaslam[train]'") from error
    traced = tuple(step.resized(*_TRACED))
    module: nn.Module = _Traced(step).eval()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        try:
            if step.differentiates:
                # The exporter cannot trace derivatives; once they are arithmetic it can.
                module = make_fx(module, tracing_mode="symbolic", _allow_non_fake_inputs=True)(*traced)
            program = torch.onnx.export(
                module,
                traced,
                dynamo=True,
                input_names=list(step.arguments),
                output_names=step.outputs,
                dynamic_shapes=(step.free(),) if isinstance(module, _Traced) else step.free(),
                opset_version=_OPSET,
                verbose=False,
                optimize=False,
            )
        except torch.onnx.errors.OnnxExporterError as error:
            reason = str(error.__cause__ or error).strip().splitlines()[0]
            raise ExportError(
                f"this step cannot be written as a graph: {reason}. Write the models' functions with arithmetic, "
                "sine, cosine, roots and arc tangents"
            ) from error
    assert program is not None
    simplify(program.model)
    program.save(path, external_data=False)
    strip_origins(path)


class _Traced(nn.Module):
    """The step, in operators that a graph has."""

    def __init__(self, step: _Step) -> None:
        super().__init__()
        self.step = step

    def forward(self, *given: Tensor) -> tuple[Tensor, ...]:
        """As the step."""
        with traced_for_export(), ExactOperators():
            return self.step(*given)


def _session(step: _Step, path: Path) -> Callable[[Mapping[str, Tensor]], dict[str, Tensor]]:
    """Runs a graph."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # ONNX Runtime has a class of errors for each code
        reason = str(error).strip().splitlines()[0]
        raise ExportError(f"ONNX Runtime cannot run this step in {step.example.belief.mean.dtype}: {reason}") from error

    def run(named: Mapping[str, Tensor]) -> dict[str, Tensor]:
        found = session.run(None, {name: each.numpy() for name, each in named.items()})
        return dict(zip(step.outputs, map(torch.as_tensor, found), strict=True))

    return run


def _header(step: _Step, path: Path) -> Callable[[Mapping[str, Tensor]], dict[str, Tensor]]:
    """Writes and runs a header."""
    from sigmaslam_filters.compiler.header_export import write_header  # brings the compiler, as torch.onnx does
    from sigmaslam_filters.compiler.scalar_step import ScalarStepError

    one = [each[0] if step.axes(each)[0] else each for each in step.arguments.values()]
    named = dict(zip(step.arguments, one, strict=True))
    measurement = None
    if step.measurement is not None:
        inputs = {name: named[name] for name in step.example.named("measurement")}
        sensor, value = step.measurement, named["value"]
        if step.is_stack:
            sensor, value = several(sensor, step.count), value.flatten()
            inputs = {name: each if step.axes(step.arguments[name])[1] else each[None] for name, each in inputs.items()}
        measurement = sensor, value, inputs
    motion = None
    if step.motion is not None:
        motion = step.motion, {name: named[name] for name in step.example.named("motion")}
    try:
        return write_header(path, step.bayes, step.example.belief[0], motion, measurement, step.gate, step.robust)
    except (ScalarStepError, ValueError, RuntimeError) as error:
        raise ExportError(f"this step cannot be written as a header: {error}") from error


def _difference(
    step: _Step, name: str, run: Callable[[Mapping[str, Tensor]], dict[str, Tensor]], sizes: Sequence[tuple[int, int]]
) -> float:
    """Largest difference from torch of what was written, on random arguments for batches and counts."""
    generator = torch.Generator().manual_seed(0)
    largest = 0.0
    for batch, count in sizes:
        given = _moved(step, step.resized(batch, count, generator), generator)
        found = run(dict(zip(step.arguments, given, strict=True)))
        with torch.no_grad():
            expected = dict(zip(step.outputs, step(*given), strict=True))
        mean_scale = float(expected["posterior_mean"].abs().max())
        for output, there in expected.items():
            a, b = found[output].double(), there.double()
            if a.shape != b.shape:
                raise ExportError(f"{name}: {output} is {tuple(a.shape)}, in torch {tuple(b.shape)}")
            scale = max(1.0, mean_scale) if output == "posterior_mean" else float(b.abs().max())
            if output in ("log_likelihood", "nis"):
                scale = max(1.0, scale)
            off = float((a - b).abs().max()) / max(scale, float(np.finfo(float).tiny))
            largest = max(largest, off) if np.isfinite(off) else np.inf
    return largest


def _moved(step: _Step, given: list[Tensor], generator: torch.Generator) -> list[Tensor]:
    """Arguments about those given: another mean, another covariance, noise in the value, and components missing."""
    named = dict(zip(step.arguments, given, strict=True))

    def normal(like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=generator, dtype=torch.float64).to(like.dtype)

    name = "root" if step.by_root else "covariance"
    root = named[name] if step.by_root else Gaussian(named["mean"], named[name]).factor
    named["mean"] = step.bayes.linearisation.retract(named["mean"], (root @ (0.3 * normal(root[..., :1]))).squeeze(-1))
    # A lower triangle times another is one.
    mixed = root @ (torch.eye(root.shape[-1], dtype=root.dtype) + 0.2 * normal(root).tril())
    named[name] = mixed if step.by_root else mixed @ mixed.mT
    if step.measurement is not None:
        value, measurement = named["value"], step.measurement
        variance = as_noise(measurement.noise).variance()
        if variance.shape[-1] == value.shape[-1]:
            value = value + variance.sqrt().expand(value.shape) * normal(value)
        missing = torch.rand(value.shape, generator=generator) < _MISSING
        named["value"] = torch.where(missing, torch.nan, value)
    return [each.contiguous() for each in named.values()]

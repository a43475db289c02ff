"""The compiled estimator against the modules that it is made from; `test_estimator_export` does so with the graphs."""

import logging
from pathlib import Path

import numpy as np
import pytest

import sigmaslam.estimation
from release.view_source import write_views
from sigmaslam.compiled import tell_slow
from sigmaslam.estimation import estimator_graphs
from sigmaslam.estimation.estimator_graphs import open_step
from sigmaslam.inference.backends import load_step
from sigmaslam_models.estimator.estimator_export import estimator_graphs as traced_modules
from sigmaslam_models.estimator.graph_examples import frame_example, window_example

FRAME_STEPS = ("frame_predict", "frame_robust", "frame_gated")
WINDOW_STEPS = ("window_eliminate", "window_gate")
OTHER_STEPS = ("pose_predict", "inertial_predict", "window_condition")


@pytest.fixture(scope="module", autouse=True)
def _compiled():
    pytest.importorskip("sigmaslam.estimation._estimator", reason="installed without a compiler")


@pytest.fixture(scope="module")
def inputs():
    return {name: module.inputs for name, module in traced_modules().items()}


def feeds(name, inputs):
    """Few and many views, one pair of poses and a full window."""
    example, sizes = (
        (frame_example, ((1, 2), (6, 211), (7, 40))) if name in FRAME_STEPS else (window_example, ((2, 3), (7, 120)))
    )
    for seed, (keyframes, count) in enumerate(sizes, start=5):
        values = example(seed, keyframes, count, *inputs[name])
        yield {key: value.numpy() for key, value in zip(inputs[name], values, strict=True)}


@pytest.mark.parametrize("name", [*FRAME_STEPS, *WINDOW_STEPS])
@pytest.mark.parametrize(
    ("unscented", "tolerance"),
    # Derivatives are differences over a spread of 1e-6, which is what rounding is multiplied by.
    [(1.0, 1e-10), (0.0, 1e-4)],
)
def test_compiled_step_equals_torch(name, unscented, tolerance, inputs):
    for feed in feeds(name, inputs):
        feed["unscented"] = np.array(unscented)
        found, expected = open_step(name)(feed), open_step(name, "torch")(feed)
        assert len(found) == len(expected)
        for a, b in zip(found, expected, strict=True):
            assert (a.shape, a.dtype) == (b.shape, b.dtype)
            np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance * max(1.0, float(np.abs(b).max())))


@pytest.mark.parametrize("name", OTHER_STEPS)
def test_compiled_prediction_and_condition_equal_torch(name):
    module = traced_modules()[name]
    for values in (module.traced, module.checked):
        feed = {key: value.numpy() for key, value in zip(module.inputs, values, strict=True)}
        for a, b in zip(open_step(name)(feed), open_step(name, "torch")(feed), strict=True):
            assert (a.shape, a.dtype) == (b.shape, b.dtype)
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12 * float(np.abs(b).max()))


def test_pose_that_is_known_exactly_is_predicted():
    module = traced_modules()["pose_predict"]
    feed = {key: value.numpy().copy() for key, value in zip(module.inputs, module.traced, strict=True)}
    feed["covariance"][:6] = feed["covariance"][:, :6] = 0.0
    for a, b in zip(open_step("pose_predict")(feed), open_step("pose_predict", "torch")(feed), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("name", [*FRAME_STEPS, *WINDOW_STEPS])
def test_compiled_step_repeats_to_the_bit(name, inputs):
    feed = next(feeds(name, inputs))
    for a, b in zip(open_step(name)(feed), open_step(name)(feed), strict=True):
        assert a.tobytes() == b.tobytes()


def test_gated_step_stops_where_it_confirms_the_inliers(inputs):
    step, feed = open_step("frame_gated"), list(feeds("frame_gated", inputs))[1]
    whole = step(feed)
    stopped = step({**feed, "inliers": whole[0]})
    assert len(stopped) == 5 < len(whole)
    contradicted = step({**feed, "inliers": ~whole[0]})
    for some in (stopped, contradicted):
        for a, b in zip(some, whole, strict=False):
            assert a.tobytes() == b.tobytes()
    assert len(contradicted) == len(whole)


@pytest.mark.parametrize("name", FRAME_STEPS)
def test_rows_of_the_dependence_are_as_good_as_a_copy_of_them(name, inputs):
    feed = list(feeds(name, inputs))[1]
    count = len(feed["dependence"])
    rows = np.random.default_rng(3).permutation(2 * count)[:count]
    table = np.full((2 * count, *feed["dependence"].shape[1:]), np.nan)
    table[rows] = feed["dependence"]
    for a, b in zip(open_step(name)(feed), open_step(name)({**feed, "dependence": table, "rows": rows}), strict=True):
        assert a.tobytes() == b.tobytes()


@pytest.mark.long
def test_view_source_is_that_of_the_modules():
    written = Path(sigmaslam.estimation.__file__).with_name("views.inc").read_text()
    assert write_views() == written, "run python -m release.view_source and compile again"


def test_graphs_serve_without_a_compiler(monkeypatch, caplog):
    monkeypatch.setattr(estimator_graphs, "_compiled", None)
    tell_slow.cache_clear()
    with caplog.at_level(logging.WARNING):
        steps = [open_step(name) for name in ("frame_robust", "frame_gated")]
    assert steps == [load_step("frame_robust"), load_step("frame_gated")]
    assert len(caplog.records) == 1

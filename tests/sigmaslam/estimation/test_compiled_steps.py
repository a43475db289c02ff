"""The compiled steps of the estimator against the torch modules, on their examples and on what a tracker asks for."""

from __future__ import annotations

from importlib.resources import files
from typing import Any

import numpy as np
import pytest

from tests.support.estimates import Demo

torch = pytest.importorskip("torch")

from sigmaslam.estimation import estimator_graphs, linearised_views  # noqa: E402
from sigmaslam.estimation.estimator_graphs import COMPILED  # noqa: E402
from sigmaslam.inference.backends import load_step  # noqa: E402
from sigmaslam.slam.tracker import StereoTracker, TrackerConfig  # noqa: E402
from sigmaslam_models.estimator import estimator_export  # noqa: E402
from sigmaslam_models.estimator.view_source import view_source  # noqa: E402

pytestmark = pytest.mark.skipif(not linearised_views.IS_COMPILED, reason="installed without a compiler")


def assert_agree(name: str, found: list[np.ndarray], wanted: list[np.ndarray]) -> None:
    """To the tolerance of the graphs, of an output's largest number.

    A slope of the likelihood is what is left of large terms that cancel: its unit is its standard deviation.
    """
    names = estimator_export.estimator_graphs()[name].outputs
    by_name = dict(zip(names, wanted, strict=True))
    assert len(found) == len(wanted)
    for output, one, other in zip(names, found, wanted, strict=True):
        assert one.shape == other.shape
        one, other = one.astype(float), other.astype(float)
        if output in ("score", "vector"):
            scale = np.sqrt(np.diag(by_name["information"]) + 1.0)
            one, other = one / scale, other / scale
            assert np.abs(one - other).max() < 1e-7, output
            continue
        largest = max(float(np.abs(other).max(initial=0.0)), 1e-300)
        assert np.abs(one - other).max(initial=0.0) <= estimator_export.ESTIMATOR_TOLERANCE * largest, output


@pytest.mark.parametrize("name", sorted(COMPILED))
@pytest.mark.parametrize("example", ["traced", "checked"])
def test_examples_agree_with_torch(name: str, example: str):
    graph = estimator_export.estimator_graphs()[name]
    arguments = getattr(graph, example)
    with torch.no_grad():
        wanted = graph.module(*arguments)
    wanted = [each.numpy() for each in (wanted if isinstance(wanted, tuple) else (wanted,))]
    feed = {key: value.numpy().copy() for key, value in zip(graph.inputs, arguments, strict=True)}
    assert_agree(name, COMPILED[name](feed), wanted)


@pytest.mark.long
def test_what_a_tracker_asks_for_agrees_with_the_graphs(demo: Demo, monkeypatch: pytest.MonkeyPatch):
    camera, frames, _ = demo
    asked: list[tuple[str, dict[str, Any], list[np.ndarray]]] = []

    def recorded(name: str) -> Any:
        def step(feed: dict[str, Any]) -> list[np.ndarray]:
            kept = {key: np.array(value) for key, value in feed.items()}
            asked.append((name, kept, COMPILED[name](feed)))
            return asked[-1][2]

        return step

    monkeypatch.setattr(estimator_graphs, "COMPILED", {name: recorded(name) for name in COMPILED})
    compiled, tracker = [], StereoTracker(camera, config=TrackerConfig(keyframe_ratio=0.95), threads=1)
    for frame in frames[:12]:
        compiled.append(tracker.step(frame.left, frame.right, frame.timestamp))
    assert {name for name, *_ in asked} == set(COMPILED)
    for name, feed, found in asked[::3]:
        assert_agree(name, found, load_step(name)(feed))
    # Without a compiler the graphs serve, and say the same.
    monkeypatch.setattr(estimator_graphs, "IS_COMPILED", False)
    tracker = StereoTracker(camera, config=TrackerConfig(keyframe_ratio=0.95), threads=1)
    for frame, estimate in zip(frames[:12], compiled, strict=True):
        other = tracker.step(frame.left, frame.right, frame.timestamp)
        assert other.status == estimate.status
        assert np.allclose(other.T_world_camera, estimate.T_world_camera, rtol=0.0, atol=1e-8)


def test_views_of_pairs_that_are_not_there_are_refused():
    shapes = {"pairs": (2, 210), "calibration": (12,), "intrinsics": (5,), "landmarks": (1, 6), "own": (1, 6, 6)}
    given = [np.ones(shape) for shape in shapes.values()]
    with pytest.raises(IndexError, match="pair of poses"):
        linearised_views._views.see_views(given[0], np.array([2]), *given[1:], np.zeros((1, 3, 2)))
    with pytest.raises(ValueError, match="size"):
        linearised_views._views.see_views(given[0], np.array([0, 1]), *given[1:], np.zeros((1, 3, 2)))


@pytest.mark.long
def test_the_source_is_what_torch_writes():
    assert (files("sigmaslam.estimation") / "views.inc").read_text() == view_source()

"""The example of a robot in a rendered room: stereo landmarks with covariance, wheel odometry, the unscented filter."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from sigmaslam.geometry.camera import RectifiedStereo
from sigmaslam_synthetic.render_sequence import write_sequence
from sigmaslam_synthetic.simulation import Recipe

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.timeout(600)]

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "localise_rendered_robot.py"
CAMERA = RectifiedStereo(230.0, 230.0, 159.5, 119.5, 0.11, 320, 240)


@pytest.fixture(scope="module")
def example():
    specification = importlib.util.spec_from_file_location("localise_rendered_robot", EXAMPLE)
    module = importlib.util.module_from_spec(specification)
    sys.modules[specification.name] = module
    specification.loader.exec_module(module)
    yield module
    del sys.modules[specification.name]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("render") / "room"
    write_sequence(out, Recipe("room", 31, seed=7, motion="planar", width=240, height=180))
    return out


@pytest.mark.long
def test_places_before_the_robot_are_as_uncertain_as_they_are_wrong(example):
    """Of many measurements of one point, mean and covariance are those of (9.34)-(9.36)."""
    generator = np.random.default_rng(0)
    point, covariance = np.array([0.5, -0.2, 3.0]), np.diag([0.2, 0.2, 0.3]) ** 2
    measured = generator.multivariate_normal(CAMERA.project(point), covariance, 200_000)
    expected = np.array([3.0, -0.5])
    many = np.broadcast_to(covariance, (len(measured), 3, 3))
    places, spread = example.reproject(CAMERA, measured, many, np.tile(expected, (len(measured), 1)))
    error = np.std(places, axis=0) / np.sqrt(len(places))
    # Without the second derivatives the mean is off by many of its standard errors.
    assert (np.abs(places.mean(axis=0) - expected) < 4 * error).all()
    naive = example.on_floor(CAMERA.triangulate(measured)).mean(axis=0)
    assert abs(naive[0] - expected[0]) > 8 * error[0]
    np.testing.assert_allclose(np.cov(places.T), spread[0], rtol=0.05, atol=1e-5)


@pytest.mark.long
def test_known_places_are_where_the_render_has_them(example, folder):
    """A landmark of the render is at the same place, whichever frame it is seen from."""
    render = example.Render.of(folder)
    with np.load(folder / "landmarks.npz") as content:
        tracks = {key: content[f"track_{key}"] for key in ("landmark", "frame", "left", "left_visible")}
    seen = {}
    for frame in (0, 10):
        rows = (tracks["frame"] == frame) & tracks["left_visible"]
        places = render.places(frame, tracks["left"][rows])
        seen[frame] = dict(zip(tracks["landmark"][rows].tolist(), places, strict=True))
    both = np.array([np.concatenate([seen[0][name], seen[10][name]]) for name in seen[0].keys() & seen[10].keys()])
    off = np.linalg.norm(both[:, :2] - both[:, 2:], axis=1)
    off = off[np.isfinite(off)]
    assert len(off) > 20
    assert np.median(off) < 0.005


@pytest.mark.long
def test_a_robot_among_rendered_landmarks_is_localised(example, folder):
    found = example.localise(folder)
    render = example.Render.of(folder)
    frames = np.array([0, *(k for k in range(5, len(render.seconds), 5) if k % 20)])
    robot = example.WheeledRobot("cartesian", 0.0)
    steps = example.odometry(render, frames, robot, np.random.default_rng(0))
    heading = np.concatenate([[0.0], np.cumsum(steps[:, 1])])
    middle = heading[:-1] + 0.5 * steps[:, 1]
    wheels = np.cumsum(steps[:, :1] * np.column_stack([np.cos(middle), np.sin(middle)]), axis=0)
    alone = np.sqrt(np.mean(np.sum((wheels - render.poses[frames[1:], :2]) ** 2, axis=1)))
    assert found["position_rmse"] < 0.5 * alone
    assert found["sightings"] > 100
    # Errors of neighbouring poses are the same: the mean has hardly more degrees of freedom than one of them.
    assert found["nees_mean"] < chi2.ppf(0.999, 3)

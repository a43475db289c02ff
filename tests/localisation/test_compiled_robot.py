"""Steps of robots as machine code are the steps of torch."""

from __future__ import annotations

import numpy as np
import pytest

from sigmaslam_localisation import compiled_robot
from sigmaslam_localisation.localise import FilterName
from sigmaslam_localisation.robots import RobotEstimate, localise_robots
from tests.support.wheeled_world import World, drive

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.timeout(600)]


def estimates(filter_name: FilterName = "ukf") -> list[RobotEstimate]:
    """First and second pass, and the smoothed one, of a robot that sees two landmarks at a time, some of them wrong."""
    recording = drive(World(seconds=10.0, delay=0.1, outliers=0.2, seed=4))
    first, second = localise_robots([recording], filter_name, lag=2.0)
    assert second[0].smoothed is not None
    return [first[0], second[0], second[0].smoothed]


@pytest.mark.slow
@pytest.mark.parametrize("filter_name", ["ukf", "ekf"])
def test_compiled_steps_are_those_of_torch_and_are_kept(filter_name, monkeypatch, tmp_path):
    expected = estimates(filter_name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(compiled_robot, "SHORTEST", 1)
    monkeypatch.setattr(compiled_robot, "WIDTHS", (0, 2))  # a program for eight takes a minute
    compiled = estimates(filter_name)
    for found, other in zip(compiled, expected, strict=True):
        for name in ("pose", "covariance", "innovation", "nis", "weight", "scale"):
            np.testing.assert_allclose(getattr(found, name), getattr(other, name), rtol=1e-7, atol=1e-9)
        assert found.delay == other.delay
    kept = sorted((tmp_path / "sigmaslam").iterdir())
    assert len(kept) == 2
    monkeypatch.setattr("sigmaslam_filters.compiler.scalar_step.ScalarStep", None)  # what is kept is not traced again
    np.testing.assert_array_equal(estimates(filter_name)[1].pose, compiled[1].pose)


@pytest.mark.long
def test_without_a_compiler_torch_goes_on_and_says_so(monkeypatch, caplog):
    expected = estimates()

    def missing() -> None:
        raise OSError("no compiler")

    monkeypatch.setattr("sigmaslam_filters.compiler.scalar_sequence.load_driver", missing)
    monkeypatch.setattr(compiled_robot, "SHORTEST", 1)
    for found, other in zip(estimates(), expected, strict=True):
        np.testing.assert_array_equal(found.pose, other.pose)
    assert "not compiled" in caplog.text

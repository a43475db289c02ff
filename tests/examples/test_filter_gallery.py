"""The gallery's examples are right where their answer is known, and each has its place on the page."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.examples import EXAMPLES, load_example

pytest.importorskip("torch")
PAGE = Path(__file__).parents[2] / "docs" / "filters.md"


def test_every_example_has_its_row_and_picture():
    text = PAGE.read_text()
    names = {path.stem for path in (EXAMPLES / "filters").glob("*.py")} - {"gallery"}
    assert len(names) == 12
    for name in names:
        assert f"(../examples/filters/{name}.py)" in text
        picture = PAGE.parent / "images" / "filters" / f"{name}.png"
        assert f"(images/filters/{name}.png)" in text
        assert picture.stat().st_size < 40_000


@pytest.mark.parametrize(
    "name",
    ["irregular_times", "missing_data", "delayed_measurements", "outliers_and_gates", "fixed_lag"],
)
@pytest.mark.long
def test_short_examples_are_as_good_as_their_models(name):
    found = load_example(name).run()
    if name in ("irregular_times", "missing_data"):
        assert 0.5 < found["sigmas"] < 1.5
    if name == "missing_data":
        assert found["components measured"] == 2 * 100 - 20 - 2 * 15
    if name == "delayed_measurements":
        right, *others = found.values()
        assert right < 0.7 * min(others)
    if name == "outliers_and_gates":
        plain, *others = found.values()
        assert max(others) < 0.1 < plain
    if name == "fixed_lag":
        filtered, lagged, smoothed = found.values()
        assert smoothed <= 1.02 * lagged < 0.6 * filtered


@pytest.mark.long
def test_an_attitude_s_error_is_what_its_covariance_says():
    found = load_example("quaternions").run()
    assert 1.5 < found["NEES"] < 5.0
    assert found["rms at the end [rad]"] < 0.05


@pytest.mark.long
def test_two_motions_are_better_than_either_alone():
    both, calm, wild = load_example("many_targets").run().values()
    assert both < 0.95 * min(calm, wild)


@pytest.mark.long
def test_particles_follow_what_a_gaussian_cannot():
    by_ukf, by_particles = load_example("particles_beside_ukf").run().values()
    assert by_particles < 5.5 < by_ukf

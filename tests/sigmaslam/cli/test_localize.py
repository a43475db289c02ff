"""`sigmaslam localize` on a robot's CSV files."""

import csv
import json
import shutil

import numpy as np
import pytest

from tests.support.commands import assert_refused, run_here

pytest.importorskip("torch")

from tests.support.wheeled_world import LANDMARKS, World, drive, write_csv_folder

pytestmark = [pytest.mark.usefixtures("one_thread"), pytest.mark.timeout(300)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_csv_folder(tmp_path_factory.mktemp("robot"), drive(World(seconds=10.0)))


@pytest.mark.long
def test_a_robot_is_localised_and_everything_is_written(folder, tmp_path):
    out = tmp_path / "out"
    result = run_here("localize", folder, "--out", out)
    assert result.returncode == 0, result.stderr
    names = {"innovations.csv", "report.html", "run.json", "trajectory.csv", "trajectory_first_pass.csv"}
    assert names <= {path.name for path in out.iterdir()} <= names | {"map.png"}
    with (out / "trajectory.csv").open() as file:
        rows = list(csv.DictReader(file))
    numbers = np.array([[float(row[key]) for key in ("time", "x", "y", "cov_xx", "belief")] for row in rows])
    assert np.isfinite(numbers).all()
    assert (np.diff(numbers[:, 0]) >= 0).all()
    run = json.loads((out / "run.json").read_text())
    (summary,) = run["robots"].values()
    assert summary["position_rmse"] < 0.1
    assert summary["sightings"] == sum(int(row["sightings"]) for row in rows) > 0
    page = (out / "report.html").read_text()
    assert "position rmse" in page
    assert "http://" not in page.replace("http://www.w3.org", "").replace("http://purl.org", "")
    assert "contradict" not in result.stdout


@pytest.mark.long
def test_ranges_in_millimetres_are_told_of(folder, tmp_path):
    wrong = shutil.copytree(folder, tmp_path / "robot")
    head, *rows = (wrong / "sightings.csv").read_text().splitlines()
    cells = [row.split(",") for row in rows]
    lines = [head, *(f"{time},{landmark},{1000 * float(away)},{bearing}" for time, landmark, away, bearing in cells)]
    (wrong / "sightings.csv").write_text("\n".join(lines) + "\n")
    result = run_here("localize", wrong, "--out", tmp_path / "out")
    assert "sightings contradict controls, start or map: are all in seconds, metres, radians" in result.stdout


def test_wrong_options_are_refused(folder, tmp_path):
    out = tmp_path / "out"
    assert_refused(run_here("localize", folder, "--out", out, "--start", "1,2"), "--start 1,2", "X,Y,HEADING")
    assert_refused(run_here("localize", folder, "--out", out, "--start", "0,0,nan"), "--start 0,0,nan", "X,Y,HEADING")
    assert_refused(run_here("localize", folder, "--out", out, "--robot", "3"), "leave out --robot")
    assert_refused(run_here("localize", tmp_path / "nowhere", "--out", out), "nowhere", "is not there")
    assert_refused(run_here("localize", folder, "--out", folder), "not an empty folder")
    assert not out.exists()


@pytest.mark.long
def test_a_map_that_is_not_there_is_found(folder, tmp_path):
    unmapped, out = tmp_path / "robot", tmp_path / "out"
    unmapped.mkdir()
    for name in ("controls.csv", "sightings.csv", "truth.csv"):
        (unmapped / name).write_text((folder / name).read_text())
    assert_refused(run_here("localize", unmapped, "--out", out), "landmarks.csv")
    result = run_here("localize", unmapped, "--out", out, "--map", "unknown")
    assert result.returncode == 0, result.stderr
    with (out / "landmarks.csv").open() as file:
        found = {row["landmark"]: (float(row["x"]), float(row["y"])) for row in csv.DictReader(file)}
    seen = np.loadtxt(folder / "sightings.csv", delimiter=",", skiprows=1)[:, 1]
    assert set(found) == {f"{name:g}" for name in seen}
    for name, place in found.items():
        assert np.hypot(*(np.array(place) - LANDMARKS[int(name)])) < 0.5


@pytest.mark.long
def test_filters_are_compared_on_the_same_recording(folder, tmp_path):
    out = tmp_path / "out"
    result = run_here("localize", folder, "--out", out, "--compare")
    assert result.returncode == 0, result.stderr
    with (out / "comparison.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["filter"] for row in rows] == ["ukf", "ekf", "iterated"]
    for row in rows:
        run = json.loads((out / row["filter"] / "run.json").read_text())
        assert run["filter"] == row["filter"]
        (summary,) = run["robots"].values()
        for label in ("position_rmse", "heading_rmse", "nees_mean", "nis_per_dof"):
            assert float(row[label]) == summary[label]
        assert float(row["cpu_seconds"]) > 0
    # Three filters, not one under three names.
    assert len({row["position_rmse"] for row in rows}) == 3

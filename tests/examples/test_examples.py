"""The examples find what is known of the data that they run on."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from sigmaslam.geometry.se3 import se3_inverse, se3_log
from sigmaslam.readers.trajectory_files import read_kitti
from tests.support.examples import EXAMPLES, load_example, run_notebook

# What a stranger opens first.
FIRST = ("localise_robot", "match_two_images", "own_frontend", "track_folder", "train_for_my_scene")


def squared_sigmas(estimate, truth: np.ndarray) -> float:
    """Squared error of a pose by its covariance, which is in the camera's own frame; of 6 degrees of freedom."""
    error = se3_log(se3_inverse(truth) @ estimate.T_world_camera)
    return float(error @ np.linalg.solve(estimate.covariance, error))


def test_an_example_says_how_to_run_it_and_stands_in_the_list():
    listed = (EXAMPLES / "README.md").read_text()
    for path in EXAMPLES.rglob("*.py"):
        name = path.relative_to(EXAMPLES).as_posix()
        assert f"python examples/{name}" in path.read_text(), f"{name} does not say how to run it"
        assert f"({name})" in listed, f"{name} is not in examples/README.md"


@pytest.mark.parametrize("name", FIRST)
def test_the_first_examples_are_short(name: str):
    assert len(next(EXAMPLES.rglob(f"{name}.py")).read_text().splitlines()) <= 60


def test_matches_of_a_rectified_pair_lie_in_one_row(demo_sequence: Path):
    left, right = (demo_sequence / f"image_{eye}" / "000000.png" for eye in (0, 1))
    matches = load_example("match_two_images").run(left, right)
    assert len(matches.probability) > 100
    rows = matches.keypoints1[:, 1] - matches.keypoints0[:, 1]
    inside = np.abs(rows) < 3.0 * np.sqrt(matches.covariance[:, 1, 1])
    assert matches.probability[inside].sum() > 0.95 * matches.probability.sum()


@pytest.mark.long
def test_the_folder_s_poses_are_within_their_covariance_of_the_truth(demo_sequence: Path):
    example = load_example("track_folder")
    estimates, truth = list(example.run(demo_sequence)), read_kitti(demo_sequence / "poses.txt")
    assert len(estimates) == len(truth)
    for estimate, pose in zip(estimates[1:], truth.poses[1:], strict=True):
        assert squared_sigmas(estimate, pose) < chi2.ppf(0.999, 6)
        position, rotation = example.three_sigma(estimate)
        assert (np.abs(estimate.T_world_camera[:3, 3] - pose[:3, 3]) < position).all()
        # A turn of the axes keeps the sum of the variances.
        np.testing.assert_allclose(np.sum((position / 3.0) ** 2), np.trace(estimate.covariance[:3, :3]))
        assert rotation.shape == (3,)


@pytest.mark.long
def test_corners_of_one_s_own_track_the_demo(demo_sequence: Path):
    estimates, truth = load_example("own_frontend").run(demo_sequence), read_kitti(demo_sequence / "poses.txt")
    assert all(estimate.status == "tracking" for estimate in estimates[1:])
    errors = [estimate.T_world_camera[:3, 3] for estimate in estimates] - truth.positions
    assert np.linalg.norm(errors, axis=1).max() < 0.02 * truth.path_length
    assert np.median([squared_sigmas(*each) for each in zip(estimates[1:], truth.poses[1:], strict=True)]) < 12.0


@pytest.mark.slow
def test_a_short_training_moves_the_weights_and_keeps_the_features(demo_sequence: Path, tmp_path: Path):
    pytest.importorskip("torch")
    import cv2
    from safetensors.numpy import load_file

    from sigmaslam.inference.onnx_graph import shipped_weights

    example = load_example("train_for_my_scene")
    weights = example.run(tmp_path / "features")
    image = cv2.imread(str(demo_sequence / "image_0" / "000000.png"), cv2.IMREAD_GRAYSCALE)
    shipped = shipped_weights("features.safetensors")
    before, after = load_file(shipped), load_file(weights)
    assert before.keys() == after.keys()
    assert any((before[name] != after[name]).any() for name in before)
    # Places come from a detector that is not trained; the ranking moves a little.
    places = [{tuple(point) for point in example.features_of(path, image).keypoints} for path in (shipped, weights)]
    assert len(places[0] & places[1]) > 0.7 * len(places[0])


@pytest.mark.slow
def test_robust_weights_help_the_robots(real_data: Path):
    pytest.importorskip("torch")
    example = load_example("localise_robot")
    folder = real_data / "mrclam" / "MRCLAM_Dataset6"
    plain, _ = example.localise(folder, 300.0)
    robust, heading = example.localise(folder, 300.0, robust="student_t")
    assert plain.shape == heading.shape == (5,)
    assert robust.mean() < plain.mean()
    assert robust.max() < 0.5
    assert heading.max() < 0.35


@pytest.mark.slow
def test_the_notebook_runs_and_its_errors_are_inside_three_sigma(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MPLBACKEND", "Agg")
    plots = pytest.importorskip("matplotlib.pyplot")
    plots.switch_backend("Agg")
    names = run_notebook("demo_run")
    assert names["inside"].mean() > 0.95
    assert names["error"].shape == names["sigma"].shape == (40, 3)
    assert len(names["points"].points) > 100
    assert names["figure"].axes
    plots.close("all")


def test_notebooks_are_stored_without_outputs():
    for path in EXAMPLES.glob("*.ipynb"):
        cells = json.loads(path.read_text())["cells"]
        assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in cells), path.name
        assert re.search(r"^# ", "".join(cells[0]["source"])), f"{path.name} has no title"

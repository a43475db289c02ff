"""Networks of one's own from a folder are used; those it lacks are what ships, and what is wrong is named."""

import hashlib
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from typer.testing import CliRunner

import sigmaslam
from sigmaslam.cli.commands import app
from sigmaslam.errors import InputError
from sigmaslam.frontend.build import build_frontend, own_networks
from sigmaslam.frontend.learned import LearnedDetector
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.inference.networks import NETWORKS, network_path, networks_in, open_graph
from sigmaslam.inference.onnx_graph import OnnxGraph, shipped_weights
from sigmaslam.inference.weight_manifest import MANIFEST_NAME
from sigmaslam.readers import open_sequence
from sigmaslam_benchmarks.tracking.features import write_features
from sigmaslam_models.graph_export import update_manifest
from sigmaslam_synthetic.rendering.textures import dead_leaves
from tests.support.commands import assert_refused, run_here

DEMO = Path(__file__).resolve().parents[3] / "synthetic" / "sigmaslam_synthetic" / "demo"
PAIR = [str(DEMO / "image_0" / f"00000{k}.png") for k in (0, 1)]


def rename(name: str, path: Path, old: str, new: str) -> None:
    """A shipped graph with another name for an input or output."""
    model = onnx.load(shipped_weights(name))
    for each in [*model.graph.input, *model.graph.output]:
        each.name = new if each.name == old else each.name
    graphs = [model.graph]
    for graph in graphs:
        for node in graph.node:
            graphs += [each.g for each in node.attribute if each.HasField("g")]
            for names in (node.input, node.output):
                for k, each in enumerate(names):
                    names[k] = new if each == old else each
    onnx.save(model, path)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Features of other weights: those that ship, but every descriptor turned round, and every sigma twice as large.

    Turned in both images, descriptors match as before.
    """
    folder = tmp_path_factory.mktemp("graphs")
    model = onnx.load(shipped_weights("features.onnx"))
    for output, factor in (("descriptors", -1.0), ("sigma", 2.0)):
        for node in model.graph.node:
            for k, each in enumerate(node.output):
                node.output[k] = f"{output}_as_shipped" if each == output else each
            for k, each in enumerate(node.input):
                node.input[k] = f"{output}_as_shipped" if each == output else each
        constant = onnx.numpy_helper.from_array(np.array(factor, np.float32), f"{output}_factor")
        model.graph.initializer.append(constant)
        model.graph.node.append(onnx.helper.make_node("Mul", [f"{output}_as_shipped", constant.name], [output]))
    onnx.save(model, folder / "features.onnx")
    update_manifest(folder, ["features.onnx"])
    return folder


@pytest.fixture
def image() -> np.ndarray:
    return dead_leaves((160, 192), np.random.default_rng(3))


def test_features_come_from_the_folder_and_the_rest_from_the_package(folder: Path, image: np.ndarray):
    shipped, own = LearnedDetector(100)(image), LearnedDetector(100, weights=folder)(image)
    np.testing.assert_array_equal(own.keypoints, shipped.keypoints)
    np.testing.assert_array_equal(own.descriptors, -shipped.descriptors)
    np.testing.assert_array_equal(own.sigma, 2.0 * shipped.sigma)
    assert networks_in(folder) == ("features",)
    assert network_path("features", folder) == folder / "features.onnx"
    assert network_path("scorer", folder) == shipped_weights("scorer.onnx")
    ConfidenceEstimator(weights=folder)


@pytest.mark.long
def test_a_copy_of_what_ships_matches_as_it_does(tmp_path: Path, image: np.ndarray):
    for name in NETWORKS:
        shutil.copy(shipped_weights(f"{name}.onnx"), tmp_path)
    moved = np.roll(image, 5, axis=1)
    expected = sigmaslam.match_images(image, moved, max_keypoints=100)
    found = sigmaslam.match_images(image, moved, max_keypoints=100, weights=str(tmp_path))
    for name in ("keypoints1", "probability", "covariance"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


@pytest.mark.long
def test_match_says_other_covariances_with_other_weights(folder: Path, image: np.ndarray, tmp_path: Path):
    for k, each in enumerate((image, np.roll(image, 5, axis=1))):
        cv2.imwrite(str(tmp_path / f"{k}.png"), each)
    run_here("images", "match", tmp_path / "0.png", tmp_path / "1.png", "--out", tmp_path / "shipped.npz")
    run_here(
        "images", "match", tmp_path / "0.png", tmp_path / "1.png", "--out", tmp_path / "own.npz", "--weights", folder
    )
    shipped, own = np.load(tmp_path / "shipped.npz"), np.load(tmp_path / "own.npz")
    assert len(own["covariance"]) > 20
    assert not np.array_equal(own["probability"], shipped["probability"])


@pytest.mark.long
def test_track_uses_them_and_run_json_names_folder_and_hash(folder: Path, tmp_path: Path):
    run_here("track", DEMO, "--out", tmp_path / "run", "--weights", folder, "--frames", "3")
    run = json.loads((tmp_path / "run" / "run.json").read_text())
    digest = hashlib.sha256((folder / "features.onnx").read_bytes()).hexdigest()
    assert run["weights"] == {"folder": str(folder), "sha256": {"features.onnx": digest}}
    assert run["weights_sha256"]["features.onnx"] == digest
    shipped = hashlib.sha256(shipped_weights("scorer.onnx").read_bytes()).hexdigest()
    assert run["weights_sha256"]["scorer.onnx"] == shipped


@pytest.mark.long
def test_resume_wants_the_same_weights(folder: Path, tmp_path: Path):
    out = tmp_path / "run"
    run_here("track", DEMO, "--out", out, "--weights", folder, "--frames", "3")
    run = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps({**run, "ended": "interrupted"}))
    assert_refused(run_here("track", DEMO, "--out", out, "--frames", "3", "--resume"), "had another weights")


def test_the_tracker_takes_a_folder_as_text(folder: Path):
    camera = open_sequence(DEMO).camera
    sigmaslam.StereoTracker(camera, weights=str(folder))
    with pytest.raises(InputError, match=r"weights .* are for a front-end by name"):
        sigmaslam.StereoTracker(camera, build_frontend("klt", 100), weights=folder)


def test_every_shipped_network_passes_its_own_check(tmp_path: Path):
    for name in NETWORKS:
        shutil.copy(shipped_weights(f"{name}.onnx"), tmp_path)
        assert open_graph(name, tmp_path).inputs == OnnxGraph(shipped_weights(f"{name}.onnx")).inputs


@pytest.mark.long
def test_a_graph_with_other_inputs_is_refused_when_it_is_opened(tmp_path: Path):
    # The two verifiers differ in the number of columns alone.
    shutil.copy(shipped_weights("verifier.onnx"), tmp_path / "place_verifier.onnx")
    with pytest.raises(InputError, match=r"place_verifier\.onnx: takes columns tensor\(float\) \(any, \d+\).*export"):
        open_graph("place_verifier", tmp_path)
    rename("features.onnx", tmp_path / "features.onnx", "count", "number")
    with pytest.raises(InputError, match=r"features\.onnx: takes .*number.*and not .*count"):
        open_graph("features", tmp_path)
    rename("features.onnx", tmp_path / "features.onnx", "sigma", "scale")
    with pytest.raises(InputError, match=r"features\.onnx: gives .*scale, and not .*sigma"):
        open_graph("features", tmp_path)


def test_a_graph_that_is_not_the_manifest_s_is_refused(folder: Path, tmp_path: Path):
    shutil.copy(folder / MANIFEST_NAME, tmp_path)
    shutil.copy(shipped_weights("features.onnx"), tmp_path)
    with pytest.raises(InputError, match=r"features\.onnx: is not the file that was exported"):
        open_graph("features", tmp_path)


@pytest.mark.parametrize(
    ("files", "frontend", "backend", "message"),
    [
        ([], "learned", "onnx", "holds none of features.onnx, scorer.onnx, verifier.onnx, place_verifier.onnx"),
        (["notes.txt"], "sift", "onnx", "holds none of scorer.onnx, verifier.onnx, place_verifier.onnx: give"),
        (["features.onnx"], "orb", "onnx", "holds none of scorer.onnx"),
        (["features.safetensors"], "learned", "onnx", "holds features.safetensors, but no features.onnx: .*export RUN"),
        (["features.onnx"], "learned", "torch", "holds features.onnx, but no features.safetensors"),
        (["features.onnx"], "klt", "onnx", "front-end klt has no networks"),
    ],
)
def test_a_folder_without_use_is_refused(files: list[str], frontend: str, backend: str, message: str, tmp_path: Path):
    for name in files:
        (tmp_path / name).touch()
    with pytest.raises(InputError, match=message):
        own_networks(frontend, tmp_path, backend)


@pytest.mark.parametrize("words", [["track", str(DEMO)], ["match", *PAIR]], ids=lambda words: words[0])
@pytest.mark.parametrize(
    ("name", "message"),
    [("nowhere", "does not exist: give one that `sigmaslam train export"), ("file", "is no folder")],
)
def test_commands_refuse_it_before_they_write(words: list[str], name: str, message: str, tmp_path: Path):
    (tmp_path / "file").touch()
    out = tmp_path / "out.npz"
    result = CliRunner().invoke(app, [*words, "--out", str(out), "--weights", str(tmp_path / name)])
    assert isinstance(result.exception, InputError)
    assert message in str(result.exception)
    assert not out.exists()


def test_the_benchmark_takes_a_folder(tmp_path: Path):
    with pytest.raises(InputError, match=r"holds none of features\.onnx"):
        write_features(tmp_path / "page.md", tmp_path, [tmp_path], [], "", [])

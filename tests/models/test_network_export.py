import json
import shutil
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from sigmaslam.errors import InputError
from sigmaslam.inference.onnx_graph import OnnxGraph, shipped_weights
from sigmaslam.inference.weight_manifest import read_manifest
from sigmaslam_models import network_export
from sigmaslam_models.extractor import BLOBS, FeatureExtractor, find_blobs
from sigmaslam_models.feature_network import FeatureNetwork
from sigmaslam_models.network_export import (
    export_features,
    export_scoring,
    feature_difference,
    load_network,
    load_scorer,
    load_verifier,
)
from sigmaslam_models.scorer_network import MatchScorer
from sigmaslam_models.torch_runtime import TorchFeatures, open_network
from sigmaslam_models.verifier_network import PLACE_COLUMNS, VERIFIER_COLUMNS, MatchVerifier
from sigmaslam_synthetic.rendering.textures import dead_leaves


def untrained_networks() -> dict[str, torch.nn.Module]:
    """What judges matches, by name."""
    return {
        "scorer": MatchScorer(),
        "verifier": MatchVerifier(VERIFIER_COLUMNS),
        "place_verifier": MatchVerifier(PLACE_COLUMNS),
    }


def shipped(name: str) -> Path:
    path = shipped_weights(name)
    if not path.is_file():
        pytest.skip(f"{name} is not in models/sigmaslam_weights")
    return path


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """A network that was never trained."""
    torch.manual_seed(0)
    path = tmp_path / "random.safetensors"
    save_file({k: v.contiguous() for k, v in FeatureNetwork().state_dict().items()}, path)
    return path


def noisy_texture(height: int, width: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    grey = dead_leaves((height, width), rng) / 255.0 + 0.02 * rng.standard_normal((height, width))
    return grey.clip(0, 1).astype(np.float32)[None, None]


def assert_same_features(found: list[np.ndarray], expected: list[np.ndarray]) -> None:
    """Round-off may swap keypoints of nearly equal score: they are paired by place."""
    distance = np.linalg.norm(expected[0][:, None] - found[0][None], axis=2)
    distance = distance[expected[1] > 0]
    nearest = distance.argmin(axis=1)
    common = distance.min(axis=1) < 1.0
    assert common.mean() > 0.98
    assert distance.min(axis=1)[common].max() < 1e-4
    kept = np.flatnonzero(expected[1] > 0)[common]
    np.testing.assert_allclose(found[2][nearest[common]], expected[2][kept], atol=1e-4)
    np.testing.assert_allclose(found[1], expected[1], atol=1e-4)
    np.testing.assert_allclose(found[3][nearest[common]], expected[3][kept], rtol=1e-3)


def feed(image: np.ndarray, count: int) -> dict[str, np.ndarray]:
    return {"image": image, "count": np.array(count, np.int64)}


@pytest.mark.long
def test_features_of_other_weights_are_exported_without_a_trace(weights, tmp_path, monkeypatch: pytest.MonkeyPatch):
    """A trace takes a minute of CPU, and all of it where machines are shared."""
    monkeypatch.setattr(torch.onnx, "export", None)
    assert export_features(weights, tmp_path / "features.onnx") <= 1e-4
    assert_equal_torch(tmp_path / "features.onnx", weights)
    assert export_features(shipped("features.safetensors"), tmp_path / "same.onnx") <= 1e-4
    assert (tmp_path / "same.onnx").read_bytes() == shipped("features.onnx").read_bytes()


@pytest.mark.slow
def test_traced_features_equal_torch_at_other_sizes_and_counts(weights, tmp_path, monkeypatch: pytest.MonkeyPatch):
    """As where the network is no longer that of the graph that ships."""
    monkeypatch.setattr(network_export, "_with_weights", lambda name, weights: lambda path: path.write_bytes(b""))
    assert export_features(weights, tmp_path / "features.onnx") <= 1e-4
    assert_equal_torch(tmp_path / "features.onnx", weights)


def assert_equal_torch(path: Path, weights: Path) -> None:
    """At sizes and counts of which none was traced (256x320, 512) or checked by the export (192x416, 700)."""
    graph, twin = OnnxGraph(path), TorchFeatures(weights)
    for height, width, count in ((96, 96, 4), (96, 96, 1152), (128, 224, 333), (480, 640, 1024), (160, 1248, 2048)):
        given = feed(noisy_texture(height, width, 3), count)
        found = graph(given)
        assert [len(values) for values in found] == [count] * 4
        assert_same_features(found, twin(given))


@pytest.mark.parametrize("name", ["scorer", "verifier", "place_verifier"])
def test_shipped_scorer_and_verifiers_equal_torch(name):
    """On numbers of matches that the export neither traced (300) nor checked (77)."""
    graph, twin = OnnxGraph(shipped(f"{name}.onnx")), open_network(name)
    shipped(f"{name}.safetensors")
    inputs = network_export._scoring_graphs(*untrained_networks().values())[name].inputs
    example = {
        "scorer": network_export._matches_example,
        "verifier": partial(network_export._columns_example, columns=VERIFIER_COLUMNS),
        "place_verifier": partial(network_export._columns_example, columns=PLACE_COLUMNS),
    }[name]
    for seed, count in ((5, 1), (6, 13), (7, 1500)):
        given = {key: value.numpy() for key, value in zip(inputs, example(seed, count), strict=True)}
        for a, b in zip(graph(given), twin(given), strict=True):
            assert len(a) == count
            np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_scorer_and_verifiers_of_a_run_are_exported_with_their_card(tmp_path):
    run, out = tmp_path / "run", tmp_path / "out"
    run.mkdir()
    torch.manual_seed(0)
    networks = untrained_networks()
    for name, network in networks.items():
        save_file({k: v.contiguous() for k, v in network.state_dict().items()}, run / f"{name}.safetensors")
    shutil.copy(shipped("matching.json"), run)
    differences = export_scoring(run, out)
    assert set(differences) == set(networks)
    assert max(differences.values()) <= 1e-4
    files = [f"{name}.{kind}" for name in networks for kind in ("onnx", "safetensors")]
    assert {path.name for path in out.iterdir()} == {*files, "matching.json", "matching.md", "manifest.json"}
    assert set(read_manifest(out / "manifest.json")) == set(files)
    for name in networks:
        OnnxGraph(out / f"{name}.onnx")
    for name in networks:
        assert (out / f"{name}.safetensors").read_bytes() == (run / f"{name}.safetensors").read_bytes()
    card = json.loads((out / "matching.json").read_text())
    assert card["onnx_minus_torch"] == differences
    assert f"| scorer.onnx | {differences['scorer']:.1e} |" in (out / "matching.md").read_text()


def test_shipped_features_equal_the_shipped_weights_in_torch():
    path = shipped("features.onnx")
    weights = shipped("features.safetensors")
    for height, width, count in ((160, 224, 300), (96, 352, 64)):
        given = feed(noisy_texture(height, width, 4), count)
        assert_same_features(OnnxGraph(path)(given), TorchFeatures(weights)(given))


def test_shipped_features_of_given_blobs_are_those_of_its_own():
    image = noisy_texture(160, 224, 4)
    graph = OnnxGraph(shipped("features.onnx"))
    blobs = find_blobs(torch.from_numpy(image), torch.tensor(320))
    assert tuple(graph.optional) == BLOBS
    given = dict(zip(BLOBS, (each.numpy() for each in blobs), strict=True))
    assert_same_features(graph(feed(image, 320) | given), graph(feed(image, 320)))


def test_shipped_weights_describe_a_texture():
    """Trained ones: the best keypoints have distinct descriptors, qualities that differ and sigmas of about a pixel."""
    path = shipped("features.safetensors")
    _, scores, descriptors, sigma = TorchFeatures(path)(feed(noisy_texture(192, 256, 5), 200))[:4]
    assert (scores > 0).all()
    assert scores.max() > 2 * scores.min()
    cosine = descriptors @ descriptors.T - 2 * np.eye(len(descriptors))
    assert np.median(cosine) < 0.5
    assert ((sigma > 0.05) & (sigma < 10)).all()


def test_loaded_network_is_the_saved_one(weights):
    torch.manual_seed(0)
    expected = FeatureNetwork().eval()
    image, count = torch.from_numpy(noisy_texture(96, 96, 0)), torch.tensor(32)
    with torch.no_grad():
        found = FeatureExtractor(load_network(weights))(image, count)
        for a, b in zip(found, FeatureExtractor(expected)(image, count), strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0)
    assert not load_network(weights).training


def test_weights_with_missing_keys_are_refused(tmp_path):
    state = FeatureNetwork().state_dict()
    del state["judge.bias"]
    path = tmp_path / "partial.safetensors"
    save_file({k: v.contiguous() for k, v in state.items()}, path)
    with pytest.raises(InputError, match=r"(?s)partial\.safetensors.*judge\.bias"):
        load_network(path)


def test_weights_of_another_shape_are_refused(tmp_path):
    path = tmp_path / "other.safetensors"
    state = FeatureNetwork().state_dict() | {"judge.bias": torch.zeros(3)}
    save_file({k: v.contiguous() for k, v in state.items()}, path)
    with pytest.raises(InputError, match=r"(?s)other\.safetensors.*size mismatch for judge\.bias"):
        load_network(path)


@pytest.mark.parametrize(
    "content", [b"", b"no weights at all, but a few bytes", b"\x10\0\0\0\0\0\0\0{not json at all}"]
)
def test_a_file_that_holds_no_weights_is_refused(tmp_path, content):
    path = tmp_path / "broken.safetensors"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"broken\.safetensors"):
        load_network(path)


@pytest.mark.parametrize(
    "load", [load_network, load_scorer, load_verifier, partial(load_verifier, columns=PLACE_COLUMNS)]
)
def test_missing_weights_are_named(load):
    with pytest.raises(InputError, match=r"nowhere\.safetensors does not exist"):
        load(Path("nowhere.safetensors"))


@pytest.mark.parametrize("load", [load_scorer, load_verifier])
def test_weights_of_the_features_are_refused_by_scorer_and_verifier(weights, load):
    with pytest.raises(InputError, match=r"random\.safetensors does not hold the weights of this network"):
        load(weights)


@pytest.mark.parametrize("output", range(4))
def test_an_output_that_is_off_shows_in_the_difference(output):
    """Of two keypoints that swap their places nothing is seen."""
    rng = np.random.default_rng(0)
    expected = [100 * rng.random((20, 2)), rng.random(20), rng.random((20, 8)), rng.random(20)]
    swapped = [np.concatenate([values[1::-1], values[2:]]) for values in expected]
    assert feature_difference(swapped, expected) == 0.0
    found = [values.copy() for values in swapped]
    found[output][7] += 2e-3
    assert feature_difference(found, expected) == pytest.approx(2e-3)
    assert feature_difference([values[:15] for values in expected], expected) == np.inf


def test_a_broken_graph_is_refused(tmp_path):
    path = tmp_path / "broken.onnx"
    path.write_bytes(b"no graph")
    with pytest.raises(InputError, match=r"broken\.onnx"):
        OnnxGraph(path)
    with pytest.raises(InputError, match=r"missing\.onnx does not exist"):
        OnnxGraph(tmp_path / "missing.onnx")

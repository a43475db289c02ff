"""Other people's graphs: inputs and outputs recognised, images padded, what is not understood named."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from sigmaslam.errors import FrameError, InputError
from sigmaslam_benchmarks.matching import LearnedExtractor, PeerExtractor, compare, load_extractor
from sigmaslam_benchmarks.matching.peer_extractors import recognise_outputs

KEYPOINTS = np.array([[5.0, 6.0], [100.0, 40.0], [20.0, 30.0], [7.0, 8.0], [90.0, 99.0]], np.float32)
SCORES = np.array([0.2, 0.5, 0.9, 0.0, 0.3], np.float32)
DESCRIPTORS = 3.0 * np.random.default_rng(0).standard_normal((5, 8)).astype(np.float32)
NAMES = ("keypoints", "scores", "descriptors")


def write_graph(
    path: Path,
    size: Sequence[int | str] = (1, 1, "height", "width"),
    names: Sequence[str] = NAMES,
    batched: bool = False,
    outputs: Sequence[np.ndarray] = (KEYPOINTS, SCORES, DESCRIPTORS),
    inputs: Sequence[str] = ("picture",),
) -> Path:
    """A graph that gives constants, whatever it is shown; the scores are times the mean of the image's maximum."""
    arrays = [array[None] if batched else array for array in outputs]
    constants = [numpy_helper.from_array(array, f"{name}_constant") for name, array in zip(names, arrays, strict=True)]
    nodes = [helper.make_node("ReduceMax", [inputs[0]], ["level"], keepdims=0)]
    for name in names:
        kind = "Mul" if name == names[1] else "Identity"
        given = [f"{name}_constant", "level"] if kind == "Mul" else [f"{name}_constant"]
        nodes.append(helper.make_node(kind, given, [name]))
    graph = helper.make_graph(
        nodes,
        "peer",
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, size) for name in inputs],
        [helper.make_tensor_value_info(n, TensorProto.FLOAT, a.shape) for n, a in zip(names, arrays, strict=True)],
        constants,
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), path)
    return path


def image(height: int = 100, width: int = 110) -> np.ndarray:
    return np.full((height, width), 255, np.uint8)


@pytest.mark.parametrize("names", [NAMES, ("kpts", "score", "descs"), ("3", "1", "2")])
@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize("size", [(1, 1, "h", "w"), (1, 3, "h", "w"), ("b", 1, 128, 160)])
def test_a_peer_gives_its_best_keypoints_with_unit_descriptors(tmp_path: Path, size, batched, names):
    extractor = load_extractor(str(write_graph(tmp_path / "peer.onnx", size, names, batched)))
    assert isinstance(extractor, PeerExtractor)
    keypoints, descriptors = extractor(image())
    # Best first, without the one of score zero.
    order = [2, 1, 4, 0]
    np.testing.assert_array_equal(keypoints, KEYPOINTS[order])
    expected = DESCRIPTORS / np.linalg.norm(DESCRIPTORS, axis=1, keepdims=True)
    np.testing.assert_allclose(descriptors, expected[order], rtol=1e-5)


def test_a_peers_best_are_kept_and_those_in_the_padding_are_not(tmp_path: Path):
    path = str(write_graph(tmp_path / "peer.onnx"))
    np.testing.assert_array_equal(load_extractor(path, 2)(image())[0], KEYPOINTS[[2, 1]])
    # The image of 96 rows ends above (90, 99), that of 100 columns left of (100, 40).
    np.testing.assert_array_equal(load_extractor(path)(image(96, 100))[0], KEYPOINTS[[2, 0]])


def test_grey_values_are_between_zero_and_one(tmp_path: Path):
    extractor = PeerExtractor(write_graph(tmp_path / "peer.onnx"), 1024)
    # The scores are times the largest grey value: of a black image they are all zero.
    assert len(extractor(np.zeros((100, 110), np.uint8))[0]) == 0
    # Of one whose grey is 51 of 255 a fifth.
    grey = extractor._graph({"picture": extractor._pad(np.full((100, 110), 51, np.uint8))})
    np.testing.assert_allclose(grey[1], 0.2 * SCORES, rtol=1e-6)


def test_an_image_larger_than_a_fixed_size_is_refused(tmp_path: Path):
    extractor = load_extractor(str(write_graph(tmp_path / "peer.onnx", (1, 1, 96, 160))))
    assert len(extractor(image(96, 160))[0]) > 0
    with pytest.raises(FrameError, match=r"peer\.onnx takes images of 160x96, this one is 110x100"):
        extractor(image())


@pytest.mark.long
def test_a_peer_that_is_too_small_for_a_set_is_left_out_there(tmp_path: Path, real_data: Path):
    graph = str(write_graph(tmp_path / "peer.onnx", (1, 1, 64, 64)))
    notes: list[str] = []
    found = compare(["orb", graph], ["middlebury"], real_data, notes.append)
    assert found[graph] == {}
    assert list(found["orb"]) == ["middlebury"]
    assert f"middlebury: left out {graph}" in notes[1]


def test_a_graph_of_ours_is_told_from_a_peer_by_its_inputs(tmp_path: Path):
    graph = write_graph(tmp_path / "ours.onnx", inputs=("image", "count"))
    assert isinstance(load_extractor(str(graph)), LearnedExtractor)


@pytest.mark.parametrize(
    ("size", "inputs"), [((1, 2, 96, 96), ("a",)), ((2, 1, 96, 96), ("a",)), ((1, 96, 96), ("a",)), ((1, 1), "ab")]
)
def test_inputs_that_are_no_single_image_are_listed(tmp_path: Path, size, inputs):
    graph = write_graph(tmp_path / "peer.onnx", size, inputs=inputs)
    with pytest.raises(InputError, match=r"(?s)inputs are a \(.*outputs are keypoints \(5, 2\), scores \(5\)"):
        load_extractor(str(graph))


def test_outputs_that_tell_nothing_are_listed(tmp_path: Path):
    graph = write_graph(tmp_path / "peer.onnx", names=("x", "y", "z"), outputs=(DESCRIPTORS, SCORES, DESCRIPTORS))
    with pytest.raises(InputError, match=r"peer\.onnx.*x \(5, 8\), y \(5\), z \(5, 8\)"):
        load_extractor(str(graph))(image())


@pytest.mark.parametrize(
    "found",
    [
        {"keypoints": KEYPOINTS, "scores": SCORES[:4], "descriptors": DESCRIPTORS},
        {"keypoints": KEYPOINTS, "scores": SCORES},
        {"keypoints": DESCRIPTORS, "scores": SCORES, "descriptors": DESCRIPTORS},
        {"a": KEYPOINTS, "b": SCORES, "c": SCORES, "d": DESCRIPTORS},
    ],
)
def test_outputs_that_do_not_fit_together_are_refused(found: dict[str, np.ndarray]):
    with pytest.raises(InputError, match="cannot be understood"):
        recognise_outputs(found, Path("peer.onnx"))


def test_names_decide_where_shapes_are_the_same_and_further_outputs_are_ignored():
    found = {"sigma": SCORES + 1, "scores": SCORES[None], "x": KEYPOINTS[None], "descriptors": DESCRIPTORS[None]}
    keypoints, scores, descriptors = recognise_outputs(found, Path("peer.onnx"))
    np.testing.assert_array_equal(keypoints, KEYPOINTS)
    np.testing.assert_array_equal(scores, SCORES)
    np.testing.assert_array_equal(descriptors, DESCRIPTORS)


def test_a_single_keypoint_and_none_are_understood():
    for count in (1, 0):
        found = {"k": KEYPOINTS[:count], "s": SCORES[:count], "d": DESCRIPTORS[:count]}
        assert [len(array) for array in recognise_outputs(found, Path("peer.onnx"))] == [count] * 3

"""The page of the graphs that ship: what each takes and gives, read from the files, and a short text of ours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import onnx

from sigmaslam.errors import InputError

PAGE_COMMAND = "sigmaslam export --page docs/onnx.md"


@dataclass(frozen=True, slots=True)
class GraphText:
    """What a file cannot say.

    Attributes:
        purpose: what it does, and when it is called.
        meanings: of inputs and outputs, by name, with units and frames.
    """

    purpose: str
    meanings: Mapping[str, str] = field(default_factory=dict)


_PLACE = {
    "columns": "what is known of each match, `sigmaslam.frontend.verifier_inputs`",
    "axes": "its columns: the unit vectors in the second image along which the errors are independent",
    "probability": "that the match is right",
    "covariance": "of its place in the second image, pixels squared",
}

# In the order in which a frame meets them.
TEXTS: Mapping[str, GraphText] = {
    "pose_predict": GraphText(
        "Prediction: constant velocity over a real time step, unscented (9.37). Once a frame, before it is matched.",
        {
            "pose": "T_reference_camera, metres",
            "twist": "velocity of the camera in its own frame, m/s and rad/s",
            "covariance": "of pose (perturbed from the left: translation, rotation) and twist",
            "step": "seconds",
            "densities": "of the white acceleration: m^2/s^3, rad^2/s^3",
            "predicted_pose": "T_reference_camera after the step",
            "predicted_covariance": "of it and of the twist",
        },
    ),
    "features": GraphText(
        "Keypoints with descriptors of one image, best first. Of the left image of a keyframe, and of each image that "
        "`sigmaslam match` is given.",
        {
            "image": "grey values in [0, 1]; H and W are multiples of 32",
            "count": "N, keypoints asked for, from 4 to H W / 8",
            "keypoints": "(u, v), pixels",
            "scores": "0 where the image has fewer keypoints",
            "descriptors": "unit vectors; a dot product near 1 is a match",
            "sigma": "standard deviation of a keypoint's place per axis, pixels",
        },
    ),
    "scorer": GraphText(
        "Which putative matches of two images are right, from their neighbours. After descriptors are compared.",
        {
            "points0": "(u, v) in the first image, pixels",
            "points1": "(u, v) in the second image, pixels",
            "side": "what the matcher knows of each, `sigmaslam.frontend.scorer_inputs.side_information`",
            "near": "rows of the nearest matches, `sigmaslam.frontend.scorer_inputs.nearest_matches`",
            "logit": "of the probability that the match is right",
        },
    ),
    "verifier": GraphText(
        "Probability and covariance of a match between two images, from their aligned patches. After the scorer.",
        _PLACE,
    ),
    "place_verifier": GraphText(
        "The same for a place that was found without features, by aligning patches. For loops and relocalisation too.",
        _PLACE,
    ),
    "stereo_transfer": GraphText(
        "Measurement update: what is expected of every landmark in every view, its slope, and the error of the slope, "
        "by sigma points (Table 9.2). Once for each linearisation of a frame update and of the window.",
        {
            "relative": "T_view_host of each pair of poses, metres",
            "spread": "lower root of the covariance of relative pose (6) and calibration (3)",
            "pair": "the row of `relative` of each measurement",
            "calibration": "what the disparity is off by: constant, with x^2, with x y; pixels",
            "intrinsics": "fx, fy, cx, cy, fx times baseline; pixels and pixel metres",
            "landmarks": "u, v, disparity and its offset in the hosting keyframe, pixels",
            "landmark_spread": "lower root of their covariance",
            "mean": "expected u, v, disparity in the view, pixels",
            "slope": "of the mean along the columns of both roots",
            "left": "covariance of what the slope leaves, pixels squared",
            "in_front": "1 where the landmark is in front of the view, else 0",
        },
    ),
}


def graph_page(folder: Path, command: str) -> str:
    """Markdown page of all graphs in a folder.

    Args:
        folder: with .onnx files; those of which nothing is known here come last.
        command: that makes the page.
    Raises:
        InputError: there are none, or one cannot be read.
    """
    paths = {path.stem: path for path in sorted(folder.glob("*.onnx"))}
    if not paths:
        raise InputError(f"{folder} has no .onnx files: give the folder that `sigmaslam export` wrote")
    names = [*(name for name in TEXTS if name in paths), *(name for name in paths if name not in TEXTS)]
    lines = [
        "# Graphs",
        "",
        f"Made by `{command}` from the files in `models/weights`.",
        "They are plain ONNX, which any runtime takes; ours is `sigmaslam.inference.OnnxGraph`, on the CPU. Beside",
        "them run numpy and OpenCV: image pyramids and following keypoints, choosing among matches, the algebra of the",
        "window, and loops. `sigmaslam export --check` compares every graph with torch.",
        "",
        "| order | graph | opset | nodes | kB |",
        "|---|---|---|---|---|",
    ]
    sections: list[str] = []
    for order, name in enumerate(names, 1):
        model = _load(paths[name])
        opset = next(each.version for each in model.opset_import if each.domain == "")
        size = paths[name].stat().st_size / 1000
        lines.append(f"| {order} | [{name}.onnx](#{name}onnx) | {opset} | {len(model.graph.node)} | {size:.0f} |")
        sections += _section(name, model, TEXTS.get(name, GraphText("No text yet: `models/graph_page.py`.")))
    return "\n".join([*lines, *sections]) + "\n"


def _section(name: str, model: onnx.ModelProto, text: GraphText) -> list[str]:
    rows = ["", f"## {name}.onnx", "", text.purpose, "", "| | name | type | shape | meaning |", "|---|---|---|---|---|"]
    for way, values in (("in", model.graph.input), ("out", model.graph.output)):
        for value in values:
            tensor = value.type.tensor_type
            kind = onnx.helper.tensor_dtype_to_np_dtype(tensor.elem_type).name
            lengths = [_length(each) for each in tensor.shape.dim]
            shape = ", ".join(lengths) + ("," if len(lengths) == 1 else "")
            rows.append(f"| {way} | `{value.name}` | {kind} | ({shape}) | {text.meanings.get(value.name, '')} |")
    return rows


def _length(dimension: onnx.TensorShapeProto.Dimension) -> str:
    """A length, or the name of one that is free; the exporter's own names say nothing."""
    name = dimension.dim_param.replace("*", " ")
    if not name:
        return str(dimension.dim_value)
    return "N" if name.startswith("u") and name[1:].isdigit() else name


def _load(path: Path) -> onnx.ModelProto:
    try:
        return onnx.load(path)
    except Exception as error:  # of the parser of protocol buffers, which raises its own
        raise InputError(f"{path} is no ONNX graph ({error}): export it again with `sigmaslam export`") from error

"""The page of the graphs that ship: what each takes and gives, read from the files, and a short text of ours."""

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

_SCENE = {
    "intrinsics": "fx, fy, cx, cy, fx times baseline; pixels and pixel metres",
    "depth": "of the scene, metres: the scale of what a slope is taken over",
    "unscented": "1 to linearise by sigma points, 0 by first derivatives",
    "anchors": "of each pair of poses, the one that landmarks are anchored to",
    "views": "of each pair of poses, the one that sees them",
    "pair": "the pair that a view belongs to",
    "common": "how errors of place that all views of a landmark share enter a view",
    "poses": "T_world_camera, metres",
    "calibration": "errors of the stereo calibration, `sigmaslam.estimation.state_layout`",
    "estimate": "landmarks in their anchors: u, v, disparity, its offset, two errors of place; pixels",
    "covariance": "of the landmarks given poses and calibration, pixels squared",
    "measurement": "(u, v, disparity), pixels; NaN for a missing disparity",
    "noise": "covariance of a view's own errors, pixels squared",
}
_VIEWS = {
    "dependence": "how a landmark moves with the state: calibration (12), then six for each pose, the frame's last",
    "factor": "of the state's prior covariance, factor factor^T; poses perturbed from the left: translation, rotation",
}
_STEP = {
    "offset": "the state where it is linearised, from the prior's mean",
    "spread": "covariance that sigma points are drawn from",
    "moved": "landmarks from where the state has them",
    "scale": "how much smaller than claimed the variances are by which views are told to agree",
    "offset_after": "the state after the step",
    "spread_after": "its covariance",
    "moved_after": "the landmarks' moves",
    "usable": "how many views are in front of the camera and anywhere near",
}
_WINDOW = {
    "owner": "the landmark that a view sees",
    "spread": "covariance of calibration and poses, which sigma points are drawn from",
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
    "inertial_predict": GraphText(
        "Prediction by an inertial sensor, unscented. Once a frame in place of `pose_predict`, where gravity is known.",
        {
            "pose": "T_keyframe_camera, metres",
            "velocity": "of the sensor in the keyframe's frame, m/s",
            "gravity": "in the keyframe's frame, m/s^2",
            "mounting": "T_camera_imu",
            "covariance": "of pose (perturbed from the left), velocity, gravity, biases, delay, mounting",
            "seconds": "since the last frame",
            "turn": "R_start_end of the preintegrated samples",
            "velocity_change": "of them, in the sensor's frame at the start, m/s",
            "position_change": "likewise, metres",
            "slope": "derivatives of (turn, velocity, position) by gyro bias, accelerometer bias, delay",
            "noise": "covariance of (turn, velocity, position)",
            "walk": "power spectra of the biases' random walks, gyro and accelerometer",
            "predicted_pose": "T_keyframe_camera after the step",
            "predicted_velocity": "likewise",
            "predicted_covariance": "of the state after the step",
            "carried": "covariance of the state before with the state after",
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
    "frame_predict": GraphText(
        "Where a frame should see the window's landmarks, by sigma points. Before its landmarks are looked for.",
        _SCENE
        | _VIEWS
        | {
            "mean": "expected (u, v, disparity), pixels",
            "views_covariance": "of the mean, without the measurement's noise, pixels squared",
            "in_front": "whether the landmark is in front of the camera",
        },
    ),
    "frame_robust": GraphText(
        "Update of a frame's pose (Table 9.2), one linearisation with a robust loss that narrows. Twice a frame.",
        _SCENE | _VIEWS | _STEP | {"gated": "1 to weigh residuals by what the prior expects of them: the first time"},
    ),
    "frame_gated": GraphText(
        "Update of a frame's pose, one linearisation with a gate and weights of a Student-t. At most thrice a frame, "
        "until the same views pass; the last call is the gate alone.",
        _SCENE
        | _VIEWS
        | _STEP
        | {
            "noise_scale": "what the variances of all views are multiplied by; 0 to find it",
            "freedom": "of the Student-t",
            "prior": "how considered errors of the calibration enter the state",
            "agree": "whether a view passes the gate",
            "count": "how many do",
            "squared": "lengths of the whitened residuals",
            "noise_scale_found": "to be given to the next call",
            "common_after": "how considered errors enter the state after the step",
            "information": "of all views about the state",
            "scores": "slope of each view's log-likelihood by the frame's pose",
            "score": "slope of all views' by the state",
            "prior_cost": "squared length of the step in units of the prior",
        },
    ),
    "window_eliminate": GraphText(
        "What the views of a window say of its state, every landmark solved for it (Schur's complement). For each "
        "linearisation of the window, after a new keyframe.",
        _SCENE
        | _WINDOW
        | {
            "measured": "landmarks as first measured in their anchor keyframes, pixels",
            "variance": "of them, pixels squared",
            "freedom": "of the Student-t",
            "information": "of the views about the state",
            "vector": "slope of their log-likelihood by the state, at the posterior",
            "covariance_after": "of the landmarks given the state",
            "dependence": "how they move with the state",
            "step": "to their best places if the state stays",
        },
    ),
    "window_condition": GraphText(
        "Posterior of the window's state from its prior and what the views say. After `window_eliminate`.",
        {
            "factor": "of the prior covariance, factor factor^T; state is 12 + 6 poses",
            "information": "of the likelihood",
            "vector": "slope of the log-likelihood at the prior's mean",
            "common": "how considered errors enter the state",
            "mean": "of the state, from the prior's mean",
            "covariance": "of the state",
            "common_after": "how considered errors enter it afterwards",
        },
    ),
    "window_gate": GraphText(
        "Which views fit the window's posterior. After the last `window_condition`.",
        _SCENE | _WINDOW | {"agree": "whether a view's residual is within what 99.9 % are"},
    ),
}


_PROVIDERS = (
    "",
    "## Execution providers",
    "",
    "`track`, `match` and `export --check` have `--provider cpu|cuda|openvino`. It moves the four networks (features,",
    "scorer, both verifiers); the estimator's graphs are float64 and small, and stay on the CPU. The package of the",
    "provider takes the place of `onnxruntime`: `onnxruntime-gpu` or `onnxruntime-openvino`. Operators that a",
    "provider lacks run on the CPU; a provider that does not start is an error.",
    "",
    "`sigmaslam export --check --provider openvino` compares the networks with the CPU. With onnxruntime-openvino",
    "1.24.1, OpenVINO on the CPU, two shared cores; CPU time of all threads, the median of nine calls:",
    "",
    "| network | largest difference | CPU provider | OpenVINO |",
    "|---|---|---|---|",
    "| features, 416 x 192, 700 keypoints | 6.0e-07 | 8.5 ms | 27 ms |",
    "| scorer, 77 matches | 1.4e-05 | 0.32 ms | 0.97 ms |",
    "| verifier, 77 matches | 8.4e-07 | 0.05 ms | 0.09 ms |",
    "| place_verifier, 77 matches | 2.7e-07 | 0.04 ms | 0.08 ms |",
    "",
    "There OpenVINO gains nothing. With it `match` runs, `track` does not: the estimator's graphs need the float64",
    "cosine of ONNX Runtime 1.29, and 1.24.1 is the newest build with OpenVINO. CUDA was not tried, for want of a GPU.",
)


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
        f"Made by `{command}` from the files in `models/sigmaslam_weights`.",
        "They are ONNX; the estimator's use one operator that ONNX Runtime alone has, `com.microsoft.Inverse`. We run",
        "them by `sigmaslam.inference.OnnxGraph`, on ONNX Runtime 1.29 or later. Beside them run numpy and OpenCV:",
        "image pyramids and following keypoints, choosing among matches, which keyframes and landmarks are kept, and",
        "loops.",
        "`sigmaslam export --check` compares every graph with torch;",
        "`examples/run_one_frame.py` runs a frame by them without the package, `examples/run_one_frame.cpp` in C++ by",
        "ONNX Runtime's C API, with the same result.",
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
        sections += _section(
            name, model, TEXTS.get(name, GraphText("No text yet: `models/sigmaslam_models/graph_page.py`."))
        )
    return "\n".join([*lines, *_PROVIDERS, *sections]) + "\n"


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

"""Our features beside SIFT, ORB and other people's networks: time on one thread, and scores on real images."""

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_write_text
from sigmaslam.inference.networks import network_path, networks_in
from sigmaslam.inference.onnx_graph import OnnxGraph, shipped_weights
from sigmaslam_benchmarks.filters.speed import Contender, Timing, time_interleaved
from sigmaslam_benchmarks.matching import check_sets, compare, format_scores, load_extractor
from sigmaslam_benchmarks.matching.extractors import CLASSICAL, MAX_KEYPOINTS
from sigmaslam_benchmarks.matching.sets import ALL
from sigmaslam_benchmarks.tracking.page import fill_page, write_page

ROUNDS = 15
"""At least so many rounds, in each of which every extractor is timed."""
_HEIGHT, _WIDTH = 480, 640
_SESSIONS = 3
_SEED = 0
# Sets whose tables are beside the page.
_BESIDE = ("middlebury", "churchill", "kitti", "euroc", "kitti_tracks")


@dataclass(frozen=True, slots=True)
class Cost:
    """What an extractor costs.

    Attributes:
        name: as it was given.
        timing: CPU seconds an image.
        loading: seconds to make a session of its graph, None for what is no graph.
        parameters: numbers in the network, fixed filters among them; None for what has none.
        keypoints: that it gave.
    """

    name: str
    timing: Timing
    loading: float | None
    parameters: int | None
    keypoints: int


def write_features(
    path: Path,
    data: Path,
    weights: Sequence[Path],
    peers: Sequence[Path],
    command: str,
    sets: Sequence[str] = ALL,
    rounds: int = ROUNDS,
    note: Callable[[str], None] = lambda text: None,
) -> str:
    """Times and scores everyone, writes the page, and the scores beside it as .json; returns the page.

    Notes in the page are kept.

    Args:
        weights: ours, .onnx, .safetensors or the folder of an export; the shipped graph if there are none.
        peers: .onnx graphs of other people.
        sets: to be scored.
        rounds: of timing.
    Raises:
        InputError: a file or set cannot be used.
    """
    names = [str(_features_of(each)) for each in weights or [shipped_weights("features.onnx")]]
    names += [*CLASSICAL, *map(str, peers)]
    if len(set(names)) < len(names):
        raise InputError(f"an extractor is given twice among {', '.join(names)}: leave one out")
    check_sets(sets, data)
    note("timing")
    costs = measure_costs(names, rounds)
    reference = str(peers[0]) if peers else "orb"
    scores = compare(names, sets, data, note)
    atomic_write_text(path.with_suffix(".json"), _public(json.dumps(scores, indent=1)) + "\n")
    packages = ("onnxruntime", "opencv-python-headless", "numpy")
    page = fill_page(
        "features",
        command,
        versions=", ".join(f"{name} {version(name)}" for name in packages),
        size=f"{_WIDTH}x{_HEIGHT}",
        keypoints=f"{MAX_KEYPOINTS:,}",
        rounds=rounds,
        reference=Path(reference).name,
        costs=cost_rows(costs, reference),
        scores=format_scores(scores, _BESIDE),
    )
    return write_page(path, _public(page))


def _features_of(weights: Path) -> Path:
    """The graph in a folder; a file is what it is."""
    if not weights.is_dir():
        return weights
    networks_in(weights, names=("features",))
    return network_path("features", weights)


def _public(text: str) -> str:
    """Where the package lies is nobody's business."""
    return text.replace(str(shipped_weights("features.onnx")), "ours (shipped)")


def measure_costs(names: Sequence[str], rounds: int) -> list[Cost]:
    """Times the extractors in turn on one image, each in one thread."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        image = photograph_like((_HEIGHT, _WIDTH))
        extractors = {name: load_extractor(name) for name in names}
        _use_one_torch_thread()
        keypoints = {name: extractor(image)[0] for name, extractor in extractors.items()}
        contenders = [Contender(name, partial(extractor, image)) for name, extractor in extractors.items()]
        timings = time_interleaved(contenders, rounds)
    finally:
        cv2.setNumThreads(threads)
    return [
        Cost(name, timings[name], _loading_time(name), count_parameters(name), len(keypoints[name])) for name in names
    ]


def _use_one_torch_thread() -> None:
    """Of weights that run in torch; who has not imported it does not now."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


def cost_rows(costs: Sequence[Cost], reference: str) -> list[list[str]]:
    """Cells of the table of times, parameters and loading."""
    base = next(cost.timing for cost in costs if cost.name == reference)
    rows = []
    for cost in costs:
        low, middle, high = np.percentile(1e3 * np.array(cost.timing.seconds), [25, 50, 75])
        ratio = cost.timing.ratio(base)
        rows.append(
            [
                cost.name,
                f"{middle:.1f} ({low:.1f} - {high:.1f})",
                "1" if cost.name == reference else f"x{ratio[0]:.2f} ({ratio[1]:.2f} - {ratio[2]:.2f})",
                str(cost.keypoints),
                "" if cost.loading is None else f"{1e3 * cost.loading:.0f}",
                "" if cost.parameters is None else f"{cost.parameters:,}",
            ]
        )
    return rows


def photograph_like(shape: tuple[int, int]) -> np.ndarray:
    """(H, W) uint8 dead leaves, whose statistics are those of photographs, with a lens's blur and a sensor's noise."""
    from sigmaslam_synthetic.rendering.textures import dead_leaves

    rng = np.random.default_rng(_SEED)
    image = cv2.GaussianBlur(dead_leaves(shape, rng).astype(np.float32), (0, 0), 0.7)
    return np.round(np.clip(image + 3.0 * rng.standard_normal(shape), 0, 255)).astype(np.uint8)


def count_parameters(name: str) -> int | None:
    """Numbers in a network: those of weights that are trained, or all real constants of a graph."""
    path = Path(name)
    if path.suffix == ".safetensors":
        from sigmaslam_models.network_export import load_network

        return sum(parameter.numel() for parameter in load_network(path).parameters())
    if path.suffix == ".onnx":
        import onnx

        real = (onnx.TensorProto.FLOAT, onnx.TensorProto.FLOAT16, onnx.TensorProto.DOUBLE)
        graph = onnx.load(path, load_external_data=False).graph
        return sum(int(np.prod(tensor.dims)) for tensor in graph.initializer if tensor.data_type in real)
    return None


def _loading_time(name: str) -> float | None:
    """Median seconds to make a session of a graph, the file being in the cache."""
    if Path(name).suffix != ".onnx":
        return None
    seconds = []
    for _ in range(_SESSIONS):
        start = time.perf_counter()
        OnnxGraph(Path(name))
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))

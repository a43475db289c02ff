"""What a training run exports, and the graphs of a folder compared with torch."""

from pathlib import Path

from sigmaslam.errors import InputError, SigmaSlamError
from sigmaslam.files import atomic_write_bytes, atomic_write_json, atomic_write_text, make_folder
from sigmaslam_models.estimator.estimator_export import ESTIMATOR_TOLERANCE, estimator_graphs
from sigmaslam_models.graph_export import graph_difference, relative_difference, update_manifest
from sigmaslam_models.model_card import card_page, read_card
from sigmaslam_models.network_export import NETWORK_TOLERANCE, export_features, feature_difference, network_graphs


def export_run(
    weights: Path, card: Path, out: Path, scores: dict[str, dict[str, float]] | None = None
) -> dict[str, float]:
    """Graph, weights and card of a run of `sigmaslam train`, into one folder; the estimator's graphs hold no weights.

    Args:
        weights: safetensors file of a training run.
        card: its JSON card; the difference found here is added to the copy in `out`.
        scores: of these weights on real sets, by set, for the card.
        out: folder that gets features.onnx, features.safetensors, and features.json and .md.
    Returns:
        Largest difference of the graph from torch.
    """
    content = read_card(card)
    if scores is not None:
        content["metrics_on_real_sets"] = scores
    make_folder(out)
    content["onnx_minus_torch"] = {"features": export_features(weights, out / "features.onnx")}
    atomic_write_bytes(out / "features.safetensors", weights.read_bytes())
    atomic_write_json(out / "features.json", content)
    atomic_write_text(out / "features.md", card_page(content))
    update_manifest(out, ["features.safetensors", "features.onnx"])
    return content["onnx_minus_torch"]


def check_graphs(folder: Path) -> dict[str, float]:
    """Compares every graph of a folder with torch, on inputs that are the same each time, and returns the differences.

    Args:
        folder: with the graphs and the weights, as `sigmaslam train export` writes it and as it ships.
    Raises:
        InputError: a file is missing or not the one of the manifest, or there is a graph of which torch knows nothing.
        SigmaSlamError: a graph differs from torch by more than its tolerance.
    """
    present = {path.stem for path in folder.glob("*.onnx")}
    graphs = estimator_graphs() | network_graphs(folder)
    if not present or present - graphs.keys():
        strangers = ", ".join(f"{name}.onnx" for name in sorted(present - graphs.keys())) or "no .onnx file"
        raise InputError(
            f"{folder}: {strangers}, but only what `sigmaslam train export` writes can be compared with torch"
        )
    differences = {}
    for name in sorted(present):
        compare = feature_difference if name == "features" else relative_difference
        differences[name] = graph_difference(graphs[name], folder / f"{name}.onnx", compare)
        tolerance = ESTIMATOR_TOLERANCE if name in estimator_graphs() else NETWORK_TOLERANCE
        if not differences[name] <= tolerance:
            raise SigmaSlamError(
                f"{folder / name}.onnx differs from torch by {differences[name]:.2e}, more than {tolerance:.0e}: "
                "reinstall the package, or export it again"
            )
    return differences

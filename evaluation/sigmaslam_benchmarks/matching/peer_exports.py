"""EdgePoint2 and XFeat as graphs of a free size, from checkouts of the user: their code and weights stay there.

    python -m sigmaslam_benchmarks.matching.peer_exports edgepoint2 CHECKOUT --out edgepoint2_s64.onnx
    python -m sigmaslam_benchmarks.matching.peer_exports xfeat CHECKOUT --out xfeat.onnx
    sigmaslam benchmark features --peer edgepoint2_s64.onnx --peer xfeat.onnx --out features.md

EdgePoint2 is `noahzhy/EdgePoint2` (MIT), the submodel S64. XFeat is `verlab/accelerated_features` (Apache 2.0) at
commit c58e74f, which holds the trained network as weights/xfeat.onnx; the graph there takes images of 640x640 alone.
"""

import argparse
import importlib
import sys
from pathlib import Path
from typing import Any

import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn
from torch.nn import functional

from sigmaslam.errors import InputError
from sigmaslam.files import atomic_path
from sigmaslam_benchmarks.matching.klt_tracks import TRACKED_KEYPOINTS

_OPSET = 20
_SIZE_MULTIPLE = 32
_TRACED = (4 * _SIZE_MULTIPLE, 5 * _SIZE_MULTIPLE)
# Widths of the submodel S64, from the authors' edgepoint2.py.
_EDGEPOINT2_S64 = {"c1": 8, "c2": 8, "c3": 24, "c4": 32, "cdesc": 64, "cdetect": 8}
_EDGEPOINT2_BORDER = 4
_XFEAT_CELL = 8
_WINDOW = 5  # side of the non-maximum suppression of both, pixels


class EdgePoint2Extractor(nn.Module):
    """The authors' network with the selection of their edgepoint2.py, but for their threshold of the score: the best
    keypoints are kept, however many the network is sure of.

    Shapes:
        image (1, 1, H, W) float32 in [0, 1], H and W multiples of 32 -> keypoints (N, 2), scores (N,), descriptors
        (N, 64).
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Keypoints in pixels, best first; of score zero there is none."""
        descriptors, response = self.network(image)
        # Scores of peaks are positive, whatever the sign of the network's.
        keypoints, scores = _best(response, response.sigmoid() * _inner(response, _EDGEPOINT2_BORDER))
        size = torch.tensor([image.shape[3], image.shape[2]], dtype=image.dtype)
        return keypoints, scores, _sample(descriptors, 2.0 * (keypoints + 0.5) / size - 1.0, "bilinear")


class XFeatExtractor(nn.Module):
    """The authors' network with the selection and sampling of their `detectAndCompute`, but for their threshold of the
    keypoints' probability: the best are kept.

    Shapes:
        as of `EdgePoint2Extractor`.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Keypoints in pixels, best first; of score zero there is none."""
        descriptors, logits, reliability = self.network(image)
        response = functional.pixel_shuffle(logits.softmax(1)[:, : _XFEAT_CELL**2], _XFEAT_CELL)
        height, width = image.shape[2:]
        # The authors normalise places as of corners that are aligned, and sample as of corners that are not.
        rows, columns = (2.0 * torch.arange(length) / (length - 1) - 1.0 for length in (height, width))
        grid = torch.stack(torch.meshgrid(rows, columns, indexing="ij")[::-1], dim=-1)[None]
        sure = functional.grid_sample(reliability, grid, mode="bilinear", align_corners=False)
        keypoints, scores = _best(response, response * sure)
        places = 2.0 * keypoints / torch.tensor([width - 1, height - 1], dtype=image.dtype) - 1.0
        return keypoints, scores, _sample(functional.normalize(descriptors, dim=1), places, "bicubic")


def _best(response: Tensor, score: Tensor) -> tuple[Tensor, Tensor]:
    """Peaks of a map (1, 1, H, W) as places (N, 2) in pixels, and what another map (1, 1, H, W) scores there (N,)."""
    peak = response == functional.max_pool2d(response, _WINDOW, 1, _WINDOW // 2)
    scores, index = torch.where(peak, score, 0.0).flatten().topk(TRACKED_KEYPOINTS)
    width = response.shape[3]
    rows = torch.div(index, width, rounding_mode="floor")
    return torch.stack([index - rows * width, rows], dim=1).to(response.dtype), scores


def _inner(response: Tensor, border: int) -> Tensor:
    """1 inside the border of a map (1, 1, H, W), 0 on it."""
    height, width = response.shape[2:]
    rows, columns = torch.arange(height), torch.arange(width)
    inside = ((rows >= border) & (rows < height - border))[:, None] & (columns >= border) & (columns < width - border)
    return inside.to(response.dtype)


def _sample(field: Tensor, places: Tensor, mode: str) -> Tensor:
    """Unit vectors (N, C) of a map (1, C, H, W) at places (N, 2) in [-1, 1]."""
    sampled = functional.grid_sample(field, places[None, :, None], mode=mode, align_corners=False)
    return functional.normalize(sampled[0, :, :, 0].T, dim=1)


def load_edgepoint2(checkout: Path) -> EdgePoint2Extractor:
    """The submodel S64 of a checkout of EdgePoint2.

    Raises:
        InputError: it is none.
    """
    module = _module(checkout, "model.model")
    network = module.EdgePoint2(**_EDGEPOINT2_S64)
    weights = _existing(checkout / "weights" / "S64.pth")
    network.load_state_dict(torch.load(weights, "cpu", weights_only=True))
    return EdgePoint2Extractor(network.eval())


def load_xfeat(checkout: Path) -> XFeatExtractor:
    """The network of a checkout of XFeat with the weights of its graph.

    Raises:
        InputError: it is none, or its graph is of another network.
    """
    module = _module(checkout, "modules.model")
    path = _existing(checkout / "weights" / "xfeat.onnx")
    network = module.XFeatModel().eval()
    graph = onnx.load(path).graph
    constants = {each.name: torch.from_numpy(numpy_helper.to_array(each).copy()) for each in graph.initializer}
    folded = [[constants[name] for name in node.input[1:]] for node in graph.node if node.op_type == "Conv"]
    convolutions = _in_order(network)
    if [each[0].shape for each in folded] != [each.weight.shape for each, _ in convolutions]:
        raise InputError(f"{path} holds another network than {checkout / 'modules' / 'model.py'}: check out c58e74f")
    with torch.no_grad():
        for (weight, bias), (convolution, normalisation) in zip(folded, convolutions, strict=True):
            convolution.weight.copy_(weight)
            if normalisation is None:
                convolution.bias.copy_(bias)
            else:
                # The graph's weights contain the normalisation: what is left of it adds the bias.
                normalisation.running_var.fill_(1.0 - normalisation.eps)
                normalisation.running_mean.copy_(-bias)
    return XFeatExtractor(network)


def _in_order(network: nn.Module) -> list[tuple[Any, Any]]:
    """Convolutions as they run, each with the batch normalisation that follows it or None."""
    ran: list[nn.Module] = []
    hooks = [
        each.register_forward_hook(lambda module, *_: ran.append(module))
        for each in network.modules()
        if isinstance(each, nn.Conv2d | nn.BatchNorm2d)
    ]
    with torch.inference_mode():
        network(torch.zeros(1, 1, *_TRACED))
    for hook in hooks:
        hook.remove()
    follows = [*ran[1:], None]
    return [
        (module, after if isinstance(after, nn.BatchNorm2d) else None)
        for module, after in zip(ran, follows, strict=True)
        if isinstance(module, nn.Conv2d)
    ]


def export_peer(extractor: nn.Module, out: Path) -> None:
    """Writes an extractor as a graph that `sigmaslam benchmark features --peer` takes, of images from 64x64 pixels.

    Args:
        extractor: as of `EdgePoint2Extractor`.
        out: .onnx file.
    """
    height, width = (torch.export.Dim(name, min=2, max=128) for name in ("height", "width"))
    program = torch.onnx.export(
        extractor.eval(),
        (torch.zeros(1, 1, *_TRACED),),
        dynamo=True,
        verbose=False,
        opset_version=_OPSET,
        input_names=["image"],
        output_names=["keypoints", "scores", "descriptors"],
        dynamic_shapes=({2: _SIZE_MULTIPLE * height, 3: _SIZE_MULTIPLE * width},),
    )
    assert program is not None
    with atomic_path(out) as path:
        program.save(path, include_initializers=True, external_data=False)


LOADERS = {"edgepoint2": load_edgepoint2, "xfeat": load_xfeat}


def main() -> None:
    """Exports one peer."""
    parser = argparse.ArgumentParser(
        prog="python -m sigmaslam_benchmarks.matching.peer_exports",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("peer", choices=LOADERS)
    parser.add_argument("checkout", type=Path, help="folder of the authors' repository")
    parser.add_argument("--out", type=Path, required=True, help=".onnx file to write")
    options = parser.parse_args()
    try:
        export_peer(LOADERS[options.peer](options.checkout), options.out)
    except InputError as error:
        raise SystemExit(str(error)) from None


def _module(checkout: Path, name: str) -> Any:
    """A module of the authors, imported from their folder; nobody else finds it under its name."""
    _existing(checkout.joinpath(*name.split(".")).with_suffix(".py"))
    package = name.partition(".")[0]
    sys.path.insert(0, str(checkout))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(checkout))
        for each in [each for each in sys.modules if each.partition(".")[0] == package]:
            del sys.modules[each]


def _existing(path: Path) -> Path:
    if not path.is_file():
        raise InputError(f"{path} is missing: give the folder of a checkout that the docstring of this module names")
    return path


if __name__ == "__main__":
    main()

"""The graphs' torch twins behind the same call: the back end that the package registers for `--backend torch`."""

from collections.abc import Mapping
from inspect import signature
from pathlib import Path

import numpy as np
import torch
from torch import nn

from sigmaslam.inference.networks import WeightsFolder, network_path
from sigmaslam_models.estimator.frame_update import FrameViews, GatedStep, PredictViews, RobustStep
from sigmaslam_models.estimator.inertial_prediction import InertialPredict
from sigmaslam_models.estimator.pose_prediction import Predict
from sigmaslam_models.estimator.window_solution import Condition, EliminateLandmarks, GateWindow, WindowViews
from sigmaslam_models.extractor import FeatureExtractor
from sigmaslam_models.network_export import load_network, load_scorer, load_verifier
from sigmaslam_models.scorer_network import ScoredMatches
from sigmaslam_models.verifier_network import PLACE_COLUMNS, VERIFIER_COLUMNS, MatchCovariance


class TorchModule:
    """A module that is called with arrays named as its arguments; `fields` name those of `*views`."""

    def __init__(self, module: nn.Module, fields: tuple[str, ...] = ()) -> None:
        self._module = module.eval()
        arguments = signature(module.forward).parameters.values()
        self._names = [*(each.name for each in arguments if each.kind is not each.VAR_POSITIONAL), *fields]

    def __call__(self, feed: Mapping[str, np.ndarray]) -> list[np.ndarray]:
        """Outputs in the order of the module."""
        with torch.inference_mode():
            outputs = self._module(*(torch.from_numpy(np.asarray(feed[name])) for name in self._names))
        return [value.numpy() for value in (outputs if isinstance(outputs, tuple) else (outputs,))]


class TorchFeatures(TorchModule):
    """The feature extractor from its weights."""

    def __init__(self, weights: Path) -> None:
        super().__init__(FeatureExtractor(load_network(weights)))


def open_network(name: str, weights: WeightsFolder = None) -> TorchModule:
    """A network by its name, of a folder or the one that ships."""
    path = network_path(name, weights, "torch")
    if name == "features":
        return TorchFeatures(path)
    if name == "scorer":
        return TorchModule(ScoredMatches(load_scorer(path)))
    columns = PLACE_COLUMNS if name == "place_verifier" else VERIFIER_COLUMNS
    return TorchModule(MatchCovariance(load_verifier(path, columns)))


def open_step(name: str) -> TorchModule:
    """A step of the filter by the name of its graph."""
    module, fields = {
        "pose_predict": (Predict, ()),
        "inertial_predict": (InertialPredict, ()),
        "frame_predict": (PredictViews, FrameViews._fields),
        "frame_robust": (RobustStep, FrameViews._fields),
        "frame_gated": (GatedStep, FrameViews._fields),
        "window_eliminate": (EliminateLandmarks, WindowViews._fields),
        "window_gate": (GateWindow, WindowViews._fields),
        "window_condition": (Condition, ()),
    }[name]
    return TorchModule(module(), fields)

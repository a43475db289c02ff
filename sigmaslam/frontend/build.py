"""The front-ends by name."""

from __future__ import annotations

from functools import partial

from sigmaslam.errors import InputError
from sigmaslam.frontend.classical import OrbDetector, SiftDetector
from sigmaslam.frontend.descriptor import DescriptorFrontend
from sigmaslam.frontend.klt import KltFrontend
from sigmaslam.frontend.learned import LearnedDetector
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.frontend.types import Frontend
from sigmaslam.inference.session import check_provider

FRONTENDS = ("learned", "sift", "orb", "klt")


def build_frontend(
    name: str, max_keypoints: int, backend: str = "onnx", threads: int = 2, provider: str = "cpu"
) -> Frontend:
    """The front-end of that name.

    Args:
        name: one of FRONTENDS.
        max_keypoints: per image.
        backend: "onnx" or "torch", of the networks.
        threads: of the feature network.
        provider: where ONNX Runtime computes them.
    Raises:
        InputError: there is no front-end of that name, or the provider is not installed.
    """
    check_provider(provider, backend)
    estimator = partial(ConfidenceEstimator, backend, provider)
    if name == "learned":
        return DescriptorFrontend(name, LearnedDetector(max_keypoints, backend, threads, provider), estimator())
    if name == "sift":
        return DescriptorFrontend(name, SiftDetector(max_keypoints), estimator())
    if name == "orb":
        return DescriptorFrontend(name, OrbDetector(max_keypoints), estimator())
    if name == "klt":
        return KltFrontend(max_keypoints)
    raise InputError(f"there is no front-end '{name}': choose one of {', '.join(FRONTENDS)}")

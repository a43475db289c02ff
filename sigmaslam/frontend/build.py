"""The front-ends by name."""

from functools import partial

from sigmaslam.errors import InputError
from sigmaslam.frontend.classical import OrbDetector, SiftDetector
from sigmaslam.frontend.descriptor import DescriptorFrontend
from sigmaslam.frontend.klt import KltFrontend
from sigmaslam.frontend.learned import LearnedDetector
from sigmaslam.frontend.match_confidence import ConfidenceEstimator
from sigmaslam.frontend.types import Frontend
from sigmaslam.inference.networks import NETWORKS, WeightsFolder, networks_in
from sigmaslam.inference.session import check_provider

FRONTENDS = ("learned", "sift", "orb", "klt")
_CONFIDENCE = tuple(name for name in NETWORKS if name != "features")
_NETWORKS = {"learned": NETWORKS, "sift": _CONFIDENCE, "orb": _CONFIDENCE, "klt": ()}


def own_networks(name: str, weights: WeightsFolder, backend: str = "onnx") -> tuple[str, ...]:
    """Which of its networks a front-end takes from a folder of weights; none without a folder.

    Args:
        name: one of FRONTENDS.
        weights: folder, as `sigmaslam train export` writes it.
        backend: "onnx" or "torch".
    Raises:
        InputError: there is no such front-end or folder, or the front-end has no use for what is in it.
    """
    if name not in _NETWORKS:
        raise InputError(f"there is no front-end '{name}': choose one of {', '.join(FRONTENDS)}")
    if weights is not None and not _NETWORKS[name]:
        raise InputError(f"--weights {weights}: the front-end {name} has no networks: leave --weights out")
    return networks_in(weights, backend, _NETWORKS[name])


def build_frontend(
    name: Frontend | str,
    max_keypoints: int,
    backend: str = "onnx",
    threads: int = 2,
    provider: str = "cpu",
    weights: WeightsFolder = None,
) -> Frontend:
    """The front-end of that name.

    Args:
        name: one of FRONTENDS; or a front-end, which is taken as it is.
        max_keypoints: per image.
        backend: "onnx" or "torch", of the networks.
        threads: of the feature network.
        provider: where ONNX Runtime computes them.
        weights: folder of networks of one's own, as `sigmaslam train export` writes it; for those that it lacks,
            the ones that ship.
    Raises:
        InputError: there is no front-end of that name, the provider is not installed, or the folder holds no network
            of this front-end, or one that does not fit.
    """
    if not isinstance(name, str):
        return name
    check_provider(provider, backend)
    own_networks(name, weights, backend)
    estimator = partial(ConfidenceEstimator, backend, provider, weights)
    if name == "learned":
        return DescriptorFrontend(
            name, LearnedDetector(max_keypoints, backend, threads, provider, weights), estimator()
        )
    if name == "sift":
        return DescriptorFrontend(name, SiftDetector(max_keypoints), estimator())
    if name == "orb":
        return DescriptorFrontend(name, OrbDetector(max_keypoints), estimator())
    return KltFrontend(max_keypoints)

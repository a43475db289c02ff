"""Stereo visual SLAM whose covariance can be believed."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sigmaslam.bodies.object_tracker import ObjectTracker
    from sigmaslam.checks.check import check_pairs
    from sigmaslam.errors import SigmaSlamError
    from sigmaslam.frontend.image_pair import Matches, match_images
    from sigmaslam.fusion.location_filter import LocationFilter
    from sigmaslam.geometry.camera import StereoCamera
    from sigmaslam.readers import open_sequence
    from sigmaslam.slam.config import TrackerConfig
    from sigmaslam.slam.estimate import Estimate
    from sigmaslam.slam.tracker import StereoTracker
else:
    from importlib import import_module

    # Loaded when asked for (PEP 562): `import sigmaslam_filters` needs neither OpenCV nor ONNX Runtime.
    _MODULES = {
        "Estimate": "slam.estimate",
        "LocationFilter": "fusion.location_filter",
        "Matches": "frontend.image_pair",
        "ObjectTracker": "bodies.object_tracker",
        "SigmaSlamError": "errors",
        "StereoCamera": "geometry.camera",
        "StereoTracker": "slam.tracker",
        "TrackerConfig": "slam.config",
        "check_pairs": "checks.check",
        "match_images": "frontend.image_pair",
        "open_sequence": "readers",
    }

    def __getattr__(name: str) -> object:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *_MODULES})


__all__ = ["Estimate", "LocationFilter", "Matches", "ObjectTracker", "SigmaSlamError", "StereoCamera"]
__all__ += ["StereoTracker", "TrackerConfig", "check_pairs", "match_images", "open_sequence"]

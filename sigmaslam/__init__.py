"""Stereo visual SLAM whose covariance can be believed."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sigmaslam.camera import StereoCamera
    from sigmaslam.config import TrackerConfig
    from sigmaslam.errors import SigmaSlamError
    from sigmaslam.estimate import Estimate
    from sigmaslam.location_filter import LocationFilter
    from sigmaslam.match import Matches, match_images
    from sigmaslam.object_tracker import ObjectTracker
    from sigmaslam.readers import open_sequence
    from sigmaslam.tracker import StereoTracker
else:
    from importlib import import_module

    # Loaded when asked for (PEP 562): `import sigmaslam.filters` needs neither OpenCV nor ONNX Runtime.
    _MODULES = {
        "Estimate": "estimate",
        "LocationFilter": "location_filter",
        "Matches": "match",
        "ObjectTracker": "object_tracker",
        "SigmaSlamError": "errors",
        "StereoCamera": "camera",
        "StereoTracker": "tracker",
        "TrackerConfig": "config",
        "match_images": "match",
        "open_sequence": "readers",
    }

    def __getattr__(name: str) -> object:
        if name not in _MODULES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)

    def __dir__() -> list[str]:
        return sorted({*globals(), *_MODULES})


__all__ = [
    "Estimate",
    "LocationFilter",
    "Matches",
    "ObjectTracker",
    "SigmaSlamError",
    "StereoCamera",
    "StereoTracker",
    "TrackerConfig",
    "match_images",
    "open_sequence",
]

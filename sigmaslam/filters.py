"""The filters under the name that they had: `sigmaslam_filters` is the package, with folders of its own."""

from sigmaslam_filters import *  # noqa: F403
from sigmaslam_filters import __all__ as __all__

"""Where calibration and poses stand in the error state of a window, and what a landmark's numbers are."""

# Errors of the calibration and of views, see `calibration_errors.ERRORS`. The measurement model knows the first ones;
# the others enter linearly. The last ones enter views alone, not the places where landmarks are seen first.
CALIBRATION_SIZE, CALIBRATION_MODELLED, VIEW_TURNS = 15, 3, 3
# They come first in the state.
CALIBRATION = slice(0, CALIBRATION_SIZE)
# Of a landmark: (u, v, disparity) in its anchor keyframe, the error that its disparities share, the two that its places
# share.
LANDMARK_SIZE = 6
# The measurement model knows the first of these numbers; the others enter the views as `common` noise.
MODELLED = 4


def pose_slice(keyframe: int) -> slice:
    """Where the pose of a keyframe of the window stands; behind the last one stands that of the frame."""
    return slice(CALIBRATION_SIZE + 6 * keyframe, CALIBRATION_SIZE + 6 * keyframe + 6)

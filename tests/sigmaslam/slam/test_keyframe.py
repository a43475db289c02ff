"""A keyframe: what is made before it is due."""

import numpy as np

from sigmaslam.frontend import StereoView
from sigmaslam.frontend.types import Features
from sigmaslam.slam.deferred import Deferred
from sigmaslam.slam.keyframe import Keyframe


def test_a_keyframe_is_prepared_once_and_one_without_disparities_needs_nothing():
    made = []

    def dense() -> np.ndarray:
        made.append(np.zeros((4, 6)))
        return made[-1]

    image, none = np.zeros((8, 12), np.uint8), np.zeros((0, 2), np.float32)
    view = StereoView(image, image, Features(none, none, none[:, 0], none[:, 0]), none[:, 0], none[:, 0])
    keyframe = Keyframe(0, 0.0, view, dense=Deferred(dense))
    assert not made
    for _ in range(2):
        keyframe.prepare_to_leave()
    assert len(made) == 1
    assert keyframe.dense is not None
    assert keyframe.dense.get() is made[0]
    Keyframe(1, 0.1, view).prepare_to_leave()

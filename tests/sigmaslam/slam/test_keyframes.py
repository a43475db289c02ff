"""Keyframes of the window: what is made before it is due."""

import numpy as np

from sigmaslam.frontend import StereoView
from sigmaslam.frontend.types import Features
from sigmaslam.slam.deferred import Deferred
from sigmaslam.slam.keyframe import Keyframe
from sigmaslam.slam.keyframes import Keyframes
from tests.support.dense_window import solved, world


def test_only_the_oldest_keyframe_is_prepared_and_only_once():
    made: list[int] = []

    def dense(number: int) -> Deferred[np.ndarray]:
        return Deferred(lambda: (made.append(number), np.full((4, 6), number))[1])

    image, none = np.zeros((8, 12), np.uint8), np.zeros((0, 2), np.float32)
    view = StereoView(image, image, Features(none, none, none[:, 0], none[:, 0]), none[:, 0], none[:, 0])
    keyframes = Keyframes(solved(world(0)), 60, 1000)
    keyframes.active = [Keyframe(number, 0.1 * number, view, dense=dense(number)) for number in range(3)]
    for _ in range(2):
        keyframes.prepare_oldest()
    assert made == [0]
    del keyframes.active[0]
    keyframes.prepare_oldest()
    assert made == [0, 1]

from pathlib import Path

import numpy as np
import pytest

from sigmaslam_synthetic.rendering.shapes import Cylinder, Ellipsoid, Panel
from sigmaslam_synthetic.worlds import street
from sigmaslam_synthetic.worlds.episode import Wish
from sigmaslam_synthetic.worlds.own import load_world

FILE = Path(__file__).resolve().parents[2] / "examples" / "detailed_street.py"


@pytest.mark.long
def test_details_come_besides_the_street_and_leave_the_preset_as_it_is():
    wish = Wish(duration=2.0)
    plain, detailed, again = (
        generate(np.random.default_rng(7), wish)
        for generate in (street.generate, load_world(str(FILE)), load_world(str(FILE)))
    )
    assert detailed.scene == again.scene
    assert street.generate(np.random.default_rng(7), wish).scene == plain.scene
    shapes = [body.shape for body in detailed.scene.bodies]
    assert sum(isinstance(each, Cylinder) and each.radius < 0.02 for each in shapes) > 20  # wires
    assert sum(isinstance(each, Panel) and each.width < 0.17 for each in shapes) > 500  # leaves
    assert sum(isinstance(each, Ellipsoid) for each in shapes) > sum(
        isinstance(body.shape, Ellipsoid) for body in plain.scene.bodies
    )
    assert max(each.specular for each in detailed.scene.materials) == 1.0
    hazes = [load_world(str(FILE))(np.random.default_rng(k), wish).scene.lights.extinction for k in range(7, 13)]
    assert 0.0 in hazes
    assert 3.912 / 3000.0 < max(hazes) < 3.912 / 150.0

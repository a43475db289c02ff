from sigmaslam_synthetic.presets import EXPOSURES, PRESETS, SENSORS
from sigmaslam_synthetic.render_choices import PRESET_NAMES, SENSOR_NAMES


def test_the_names_that_are_offered_are_those_of_the_registries():
    assert list(PRESETS) == list(PRESET_NAMES)
    assert list(SENSORS) == list(EXPOSURES) == list(SENSOR_NAMES)

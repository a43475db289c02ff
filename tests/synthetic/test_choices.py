from sigmaslam.synthetic.choices import PRESET_NAMES, SENSOR_NAMES
from sigmaslam.synthetic.presets import EXPOSURES, PRESETS, SENSORS


def test_the_names_that_are_offered_are_those_of_the_registries():
    assert list(PRESETS) == list(PRESET_NAMES)
    assert list(SENSORS) == list(EXPOSURES) == list(SENSOR_NAMES)

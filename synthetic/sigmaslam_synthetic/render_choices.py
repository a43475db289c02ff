"""What a rendered sequence can be chosen from, by name: light to import, for the command line."""

PRESET_NAMES = ("room", "street", "drone", "colon", "organ", "tool", "rubble")
SENSOR_NAMES = ("ideal", "normal", "harsh", "slow")
MOTIONS = ("normal", "stops", "rotation", "loop", "rest", "shaken", "planar")
CARRIED = ("room", "drone", "rubble")  # presets whose camera can be shaken: in a hand or on a drone
ROLLING = ("room",)  # presets with a floor that a robot can drive on
TRUTHS = ("dense", "sparse")

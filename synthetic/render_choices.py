"""What a rendered sequence can be chosen from, by name: light to import, for the command line."""

PRESET_NAMES = ("room", "street", "drone", "colon", "organ", "tool")
SENSOR_NAMES = ("ideal", "normal", "harsh")
MOTIONS = ("normal", "stops", "rotation", "loop", "rest")
TRUTHS = ("dense", "sparse")

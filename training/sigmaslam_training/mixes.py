"""What a training run can be chosen from, by name: light to import, for the command line."""

RECIPE_NAMES = ("full", "quick", "endoscope", "fine-tune")
# What the pairs of a run are made of: its sources take turns.
MIXES: dict[str, tuple[str, ...]] = {
    "leaves": ("leaves",),
    "noise": ("noise",),
    "patterns": ("patterns",),
    "scenes": ("scenes",),
    "mix": ("leaves", "scenes", "leaves", "scenes", "leaves"),
    "turned": ("turned leaves", "leaves", "turned leaves", "scenes"),
    "endoscope": ("endoscopy", "leaves", "endoscopy", "leaves"),
}

"""How cameras and things move: paths, and random ones for each kind of carrier."""

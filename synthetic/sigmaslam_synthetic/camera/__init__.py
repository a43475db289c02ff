"""The stereo pair that looks at a scene: its geometry and its sensors."""

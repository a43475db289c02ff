"""The mathematics of the back end: windows of keyframes, frames, robust weights; no images."""

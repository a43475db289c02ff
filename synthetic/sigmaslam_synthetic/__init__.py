"""Synthetic images with exact truth: textures, pairs, scenes."""

"""Displays: how rasterized channels become an image, in NumPy and in GLSL."""

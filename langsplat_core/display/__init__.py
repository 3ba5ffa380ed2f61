"""Displays: how rasterized channels become an image, on the CPU and in GLSL."""

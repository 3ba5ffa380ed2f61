"""How rasterized channels become a picture: the NumPy twin and the GLSL twin, side by side."""

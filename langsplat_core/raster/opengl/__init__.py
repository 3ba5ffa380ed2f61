"""The OpenGL rasterizer: Gaussians through the graphics pipeline."""

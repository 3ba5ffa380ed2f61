"""The CPU rasterizer: compiled kernels from projection to blending, and their gradients."""

"""`langsplat compact`: a scene with no more Gaussians than it needs."""

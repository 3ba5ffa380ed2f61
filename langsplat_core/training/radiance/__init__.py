"""3D Gaussian Splatting: Gaussians fitted to photographs."""

"""The language field: mask vectors lifted onto Gaussians, and the codec fitted to them."""

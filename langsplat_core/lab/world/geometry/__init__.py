"""Triangle meshes of simple solids."""

"""Surfaces of a scene as points, planes and meshes, and how two scenes lie to each other (Open3D)."""

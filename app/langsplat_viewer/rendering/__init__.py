"""From a scene, a camera and settings to pixels. Knows nothing of the window's state."""

"""Render requests and the renderers that draw them; nothing of the window's state."""

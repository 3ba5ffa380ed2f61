"""Colour, substance, light and the camera that sees them."""

"""Training of the small CLIP that comes with the program."""

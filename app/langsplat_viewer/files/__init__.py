"""What the window reads and writes beside scenes, and where it looks for it."""

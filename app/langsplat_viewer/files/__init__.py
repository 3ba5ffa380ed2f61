"""Files that the window reads and writes beside scenes."""

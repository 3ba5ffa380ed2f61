"""Images and films as files, with a window or without."""

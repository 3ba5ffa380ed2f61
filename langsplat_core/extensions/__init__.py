"""The project's own extensions. They come in through the entry points that any package may use."""

"""Developed photographs in bounded memory: beyond a limit they lie in files without a name, which the system
reads in where they are looked at and forgets when it needs the room."""

import tempfile

import numpy as np

from langsplat_core.arrays import Array

IN_MEMORY = 512_000_000  # bytes of photographs


class Album:
    """Keeps pictures. The files lie in the temporary folder (`TMPDIR`) and end with the process."""

    def __init__(self, in_memory: int = IN_MEMORY) -> None:
        self._left = in_memory

    def keep(self, picture: Array) -> Array:
        """The same (H, W, 3) uint8 picture, in memory as long as there is room, else in a file."""
        self._left -= picture.nbytes
        if self._left >= 0:
            return picture
        try:
            with tempfile.TemporaryFile(prefix="langsplat-") as file:
                # Written, not mapped and filled: on a full disk that would kill the process without a word.
                file.write(np.ascontiguousarray(picture).data)
                file.flush()
                return np.memmap(file, np.uint8, "c", shape=picture.shape)
        except OSError as error:
            raise OSError(error.errno, error.strerror, tempfile.gettempdir()) from error

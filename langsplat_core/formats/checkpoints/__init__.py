"""Checkpoints of other methods: read as plain data, and written where another method's tools are to go on.

Nothing in a file is ever executed, and what a file is tells what it holds. See docs/files.md for what to
give of each method and what becomes of it.
"""

from langsplat_core.formats.checkpoints.foreign import ForeignScene, read_foreign
from langsplat_core.formats.checkpoints.meanings import Leaves
from langsplat_core.formats.checkpoints.writing import write_autoencoder, write_checkpoint

__all__ = ["ForeignScene", "Leaves", "read_foreign", "write_autoencoder", "write_checkpoint"]

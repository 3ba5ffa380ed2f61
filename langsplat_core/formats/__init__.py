"""Files: scenes as PLY, compressed PLY and SOG, the language sidecar, cameras, LangSplat's features."""

from pathlib import Path

from langsplat_core.errors import FormatError
from langsplat_core.formats.ply import read_ply, write_ply
from langsplat_core.scene import Scene

__all__ = ["load_scene", "read_ply", "write_ply"]


def load_scene(path: Path | str) -> Scene:
    """Open a scene."""
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise FormatError(f"{path}: unknown kind of scene; supported: .ply")
    return Scene(read_ply(path), path=path)

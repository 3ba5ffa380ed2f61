"""How long a scene's world unit is: a comment in the header of its PLY.

    comment metres_per_unit 0.25

Other programs pass over it. Of several the last one counts, and one that is not a positive number is none. A
scene in another format has no scale.
"""

import math
import shutil
from pathlib import Path

from langsplat_core.errors import InputError
from langsplat_core.files import atomic_path
from langsplat_core.parsing.opening import open_for_reading
from langsplat_core.parsing.ply_header import read_ply_header

KEY = "metres_per_unit"


def metres_comment(metres_per_unit: float) -> str:
    """The comment that says so."""
    return f"{KEY} {float(metres_per_unit)!r}"


def metres_by_comments(comments: tuple[str, ...]) -> float | None:
    """Metres per world unit, > 0 and finite, as the header's comments say; None where they do not."""
    found = None
    for comment in comments:
        match comment.replace(":", " ").split():
            case [key, value] if key == KEY:
                found = _positive(value)
    return found


def write_metres(path: Path | str, metres_per_unit: float) -> None:
    """Say in the header of the PLY `path` how long its unit is; all else stays as it is, byte for byte.

    Raises InputError for another kind of file and a length that is not positive, FormatError for a header
    that breaks the rules.
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: only a .ply keeps a scale; make one with 'langsplat convert'")
    if not 0 < metres_per_unit < math.inf:
        raise InputError(f"{metres_per_unit:g} metres per unit: must be above 0 and finite")
    file, _ = open_for_reading(path)
    with atomic_path(path) as temporary, file, temporary.open("wb") as out:
        size = read_ply_header(file, path).size
        file.seek(0)
        *lines, last = file.read(size).splitlines(keepends=True)
        end = b"\r\n" if last.endswith(b"\r\n") else b"\n"
        out.writelines(line for line in lines if not _is_ours(line))
        out.write(b"comment " + metres_comment(metres_per_unit).encode() + end + last)
        shutil.copyfileobj(file, out)


def _is_ours(line: bytes) -> bool:
    return line.replace(b":", b" ").split()[:2] == [b"comment", KEY.encode()]


def _positive(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0 < value < math.inf else None

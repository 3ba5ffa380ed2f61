"""What every benchmark leaves behind: its table for people and its figures for programs."""

import json
from pathlib import Path
from typing import Any

from langsplat_core.io.files import atomic_path


def save_figures(out: Path, name: str, table: str, figures: Any) -> None:
    """Write `name`.md and `name`.json into the folder `out`, each whole or not at all."""
    with atomic_path(out / f"{name}.md") as path:
        path.write_text(table)
    with atomic_path(out / f"{name}.json") as path:
        path.write_text(json.dumps(figures, indent=1, default=str))

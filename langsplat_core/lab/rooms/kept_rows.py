"""Rows of a long benchmark, kept one by one, so that an interrupted run goes on where it stopped."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from langsplat_core.errors import FormatError
from langsplat_core.lab.rooms.report import Measured
from langsplat_core.lab.rooms.scoring import DirectScore, Score
from langsplat_core.training.language.codec_fit import CodecReport


class KeptRows:
    """Rows of one benchmark in a file of JSON lines; those made with other settings are passed over."""

    def __init__(self, path: Path, settings: dict[str, Any]) -> None:
        """settings: everything that a row depends on, but for its origin of masks and its name."""
        self._path, self._settings = path, json.loads(json.dumps(settings, default=str))
        self._rows: dict[tuple[str, str], Measured] = {}
        if path.exists():
            for line in path.read_text(encoding="utf-8").splitlines():
                self._read(line)

    def _read(self, line: str) -> None:
        try:
            stored = json.loads(line)
            if stored["settings"] == self._settings:
                row = _measured(stored["row"])
                self._rows[row.masks, row.name] = row
        except (ValueError, KeyError, TypeError) as error:
            raise FormatError(f"{self._path}: damaged ({error}); delete it and run again") from None

    def get(self, masks: str, name: str) -> Measured | None:
        """The row, if an earlier run has made it."""
        return self._rows.get((masks, name))

    def add(self, row: Measured) -> None:
        """Keep one more."""
        self._rows[row.masks, row.name] = row
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"settings": self._settings, "row": asdict(row)}) + "\n")


def _measured(row: dict[str, Any]) -> Measured:
    scores = tuple(Score(**score) for score in row.pop("scores"))
    direct = tuple(DirectScore(**score) for score in row.pop("direct"))
    loss, unknown = CodecReport(**row.pop("codec_loss")), tuple(row.pop("unknown"))
    return Measured(scores=scores, direct=direct, codec_loss=loss, unknown=unknown, **row)

"""Files of a report: its page and figures, and rows that are kept while a long one is measured."""

import json
import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

from langsplat_core.cli.bench import write_report
from langsplat_core.errors import FormatError
from langsplat_core.training.language.codec_fit import CodecReport
from tests.benchmarks.scoring import DirectScore, Measured, Score


class Reported(Protocol):
    """A report's command: a dataclass with the folder that it writes into."""

    @property
    def out(self) -> Path: ...


def publish(
    command: Reported,
    name: str,
    title: str,
    text: str,
    rows: Sequence[Any],
    plot: Callable[[Path], None] | None = None,
) -> None:
    """Print a report's tables, and write them as a page with title and command, beside all figures of its
    rows, dataclasses, with the settings that they belong to."""
    line = f"python -m tests.benchmarks {shlex.join(sys.argv[1:])}"
    figures = {"settings": asdict(command), "rows": [asdict(row) for row in rows]}  # type: ignore[call-overload]
    write_report(command.out, name, f"# {title}\n\n    {line}\n\n{text}", figures, plot)
    print(text)


class KeptRows:
    """Rows of a long report in a file of JSON lines, each under everything that it depends on, so that an
    interrupted run goes on where it stopped; rows of other settings are passed over."""

    def __init__(self, path: Path) -> None:
        """Raises FormatError for a damaged file."""
        self._path = path
        self._rows: dict[str, Measured] = {}
        for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
            try:
                stored = json.loads(line)
                self._rows[_text(stored["key"])] = _measured(stored["row"])
            except (ValueError, KeyError, TypeError) as error:
                raise FormatError(f"{path}: damaged ({error}); delete it and run again") from None

    def row(self, key: dict[str, Any], measure: Callable[[], Measured]) -> Measured:
        """The row of a key, measured and kept if no earlier run has done so."""
        text = _text(key)
        if text not in self._rows:
            self._rows[text] = measure()
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"key": key, "row": asdict(self._rows[text])}, default=str) + "\n")
        return self._rows[text]


def _text(key: dict[str, Any]) -> str:
    return json.dumps(key, sort_keys=True, default=str)


def _measured(row: dict[str, Any]) -> Measured:
    scores = tuple(Score(**score) for score in row.pop("scores"))
    direct = tuple(DirectScore(**score) for score in row.pop("direct"))
    loss, unknown = CodecReport(**row.pop("codec_loss")), tuple(row.pop("unknown"))
    return Measured(scores=scores, direct=direct, codec_loss=loss, unknown=unknown, **row)

"""Tables on standard output."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from rich.console import Console

from langsplat_core.config import annotations, check_settings, named_values
from langsplat_core.errors import InputError
from langsplat_core.io.files import check_output_file, check_output_folder


class OutputConsole(Console):
    """A console that leaves to `cli.run` what happens when nobody reads any more; rich's own ends with 1."""

    def on_broken_pipe(self) -> None:
        """Raise BrokenPipeError, as `print` does."""
        raise BrokenPipeError


# What is said of a command's arguments before it does anything: numbers, texts, places to write to.


@dataclass(frozen=True)
class Written:
    """Marks an argument that names what is written, so that it can be tried before the work."""

    kind: Literal["file", "folder"]


OutFile = Annotated[Path, Written("file")]
OutFolder = Annotated[Path, Written("folder")]


def check_arguments(command: object) -> None:
    """InputError, in one line, for the first argument of a command, a dataclass, that it cannot work with: a
    number outside of its range, a text that is not UTF-8, a place that cannot be written to."""
    check_settings(command)
    for option, value, hint in named_values(command):
        for text in value if isinstance(value, tuple) else (value,):
            if isinstance(text, str):
                _check_text(option, text)
        written = next((part for part in annotations(hint) if isinstance(part, Written)), None)
        if written is not None and value is not None:
            (check_output_file if written.kind == "file" else check_output_folder)(value)


def _check_text(option: str, text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError:
        plain = text[:40].encode("utf-8", "backslashreplace").decode()
        raise InputError(f"{option} {plain}: is not UTF-8; use a terminal that is set to UTF-8") from None

"""How every command ends: 0, or 2 with one line on stderr, or 130 when interrupted.

A command is a dataclass whose fields are its arguments (tyro derives the parser) and whose `run` does
the work. The viewer's program ends the same way and uses this module too.
"""

import contextlib
import io
import logging
import os
import re
import sys
import warnings
from collections.abc import Callable
from typing import Protocol

from langsplat_core import __version__
from langsplat_core.errors import LangSplatError

_FRAME = re.compile(r"[│╭╮╰╯]|─+")


class Command(Protocol):
    """Parsed arguments that know what to do."""

    def run(self) -> None:
        """Do it; raise LangSplatError for what a user can mend."""


def one_line(box: str) -> str:
    """tyro's framed complaint as one line: its title and text, without rule and hints below it."""
    title, *body = box.strip().splitlines() or [""]
    text: list[str] = []
    for line in body:
        if "──" in line:
            break
        text.append(_FRAME.sub(" ", line))
    words = " ".join(" ".join(text).split())
    heading = " ".join(_FRAME.sub(" ", title).split()).lower()
    return f"{words or heading or 'unusable arguments'} (see --help)"


def main(program: str, parser: Callable[[], Command]) -> int:  # noqa: PLR0911  one end a row
    """Parse and run; returns the exit code."""
    if sys.argv[1:] == ["--version"]:
        print(f"{program} {__version__}")
        return 0
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            command = parser()
    except LangSplatError as error:
        return _fail(program, str(error))
    except SystemExit as stop:
        if stop.code in (0, None):
            return 0
        return _fail(program, one_line(complaint.getvalue()))
    logging.basicConfig(format="%(message)s", stream=sys.stderr)
    logging.getLogger("langsplat").setLevel(logging.INFO)
    warnings.filterwarnings("ignore", module=r"(torch|transformers|huggingface_hub|numba)(\.|$)")
    try:
        command.run()
    except LangSplatError as error:
        return _fail(program, " ".join(str(error).split()))
    except BrokenPipeError:  # whoever reads has enough, as `| head` has
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # nothing more at exit either
        return 0
    except KeyboardInterrupt:
        print(f"{program}: interrupted; the same command continues where it stopped", file=sys.stderr)
        return 130
    return 0


def _fail(program: str, message: str) -> int:
    print(f"{program}: {message}", file=sys.stderr)
    return 2

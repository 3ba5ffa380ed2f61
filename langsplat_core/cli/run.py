"""How commands run: they end with 0, or with a line on stderr and 2, 130 (Ctrl-C) or 143 (SIGTERM).

A command is a dataclass whose fields are its arguments (tyro derives the parser), checked before anything is
done, and whose `run` does the work. The viewer's program ends the same way and uses this module too.
"""

import contextlib
import errno
import io
import json
import logging
import os
import re
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, is_dataclass, make_dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from tyro import constructors

from langsplat_core import __version__, registry
from langsplat_core.cli.arguments import PLACED, Runnable, check_arguments
from langsplat_core.config import annotations
from langsplat_core.errors import STRICTNESS, InputError, LangSplatError, optional_imports, printable_line
from langsplat_core.interrupts import SAID, Terminated, raised
from langsplat_core.io.files import NO_ROOM, shown

log = logging.getLogger("langsplat")
HOME = re.compile(r"^(--[\w.-]+=|)~(?=/)")  # in quotes, after = or in a file, where a shell leaves it
SHELLS = ("bash", "zsh", "fish", "tcsh")
_CONTINUES = "; the same command goes on from what was finished"
_CONFIG = (tyro.conf.CascadeSubcommandArgs, tyro.conf.DisallowNone)
ROLES = constructors.ConstructorRegistry()  # the rules for help and for names of files
_ASKED = object()  # the mark of what tyro itself is asked
_ROOM = "make room, or choose another place; what was finished is kept"

REWORDED = {  # what tyro says, with Python's types -> the same for people, in this order
    r"Missing value for argument 'command\.(\w+)'.*":
    r"\1 is missing; is there an unknown option, or a file '-NAME' in place of './-NAME'?",
    r"Error parsing (\S+): no type matching (.*?) could be instantiated from (\[.*?\])\. Got.*":
    r"\1: expected \2, got \3",
    r"Error parsing (\S+): .*? (\[.*?\]) into tuple type tuple\[typing\.Literal\[(.*?)\], .*?float.*\]":
    r"\1: expected one of \3 and a number, got \2",
    r"Error parsing (\S+): .*? (\[.*?\]) into tuple type .*float.*": r"\1: expected numbers, got \2",
    r"Error parsing (.*): Could not find valid parse for arguments: (.*)": r"\1: cannot be made of \2",
    r"invalid choice (.*) for argument '(.*)'\. Expected one of \((.*)\).": r"\2: expected one of \3, not \1",
    r"(expected PATH, got|cannot be made of) \[''\]": "an empty name; is a variable of the shell not set?",
    r", 'None'|'None', |Error parsing (?=[^ ]+:)": "",
    r"expected \{FLOAT.*?\}": "expected numbers", "expected FLOAT": "expected a number",
    r"invalid literal for int\(\) with base 10: |expected INT, got ": "expected a whole number, got ",
}  # fmt: skip


@dataclass(frozen=True)
class Verbosity:
    """Options for the amount of messages on standard error."""

    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(aliases=["-q"])] = False
    """Errors alone: no progress, notes or warnings."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(aliases=["-v"])] = False
    """Also what each step took, and what was taken from an earlier run."""
    strict: tyro.conf.FlagCreatePairsOff[bool] = False
    """Refuse files of which something would be skipped, padded, rounded or guessed, in place of saying so."""

    @property
    def level(self) -> int:
        """Level of the log; progress is shown below ERROR."""
        return logging.ERROR if self.quiet else logging.DEBUG if self.verbose else logging.INFO


class _OneLine(logging.Formatter):
    """Formatter that prints a record as one line of printable characters, as errors are printed."""

    def format(self, record: logging.LogRecord) -> str:
        return printable_line(record.getMessage(), 2000)


def one_line(box: str) -> str:
    """Return tyro's framed complaint as one line, without the hints that stand behind a rule."""
    title, *body = [line.strip(" │") for line in box.strip().splitlines()] or [""]
    said: list[str] = []
    for line in body:
        if not line or set(line) - set("─-╰╯"):
            said.append(line)
        elif said:
            break
    words = " ".join(" ".join(said).split()).replace(" (required)", "") or title.strip(" ╭╮─").lower()
    for of_tyro, plain in REWORDED.items():
        words = re.sub(of_tyro, plain, words)
    if "Perhaps you meant:" in body:
        near = dict.fromkeys(line.split()[0].strip(",") for line in body if re.match("--[a-z]", line))
        words += f"; did you mean {' or '.join(near)}?"
    return f"{words or 'unusable arguments'} (see --help)"


@ROLES.struct_rule
def _with_roles(info: constructors.StructTypeInfo) -> constructors.StructConstructorSpec | None:
    """Return the arguments that a dataclass has by tyro's own rule, each field as its role."""
    if _ASKED in info.markers or not is_dataclass(info.type):
        return None  # tyro's rules are next
    made: Any = ROLES.get_struct_spec(replace(info, markers=(*info.markers, _ASKED)))
    return replace(made, fields=tuple(map(_as_role, made.fields)))


def _as_role(field: Any) -> constructors.StructFieldSpec:
    """Return a field whose help names a role, not a type, nor an empty default, and has no line breaks."""
    said = list(annotations(field.type))
    placed, several = PLACED in said, " ..." if Ellipsis in said else ""
    role = field.name.upper() if placed else "TEXT" if str in said else None
    marks = [tyro.conf.arg(metavar=role and role + several)]
    if isinstance(field.default, bool) or field.default in (None, "", (), tyro.MISSING_NONPROP):
        marks.append(tyro.conf.arg(help_behavior_hint=""))
    marks += [part for part in said if isinstance(part, type(marks[0]))]  # also of the types in this one
    if field.name == "out":
        marks.append(tyro.conf.arg(metavar="OUT", aliases=None if placed else ["-o"]))
    typed: Any = Annotated[(field.type, *marks)]
    return replace(field, type=typed, helptext=lambda: " ".join((field.helptext() or "").split()))


@ROLES.primitive_rule
def _as_path(info: constructors.PrimitiveTypeInfo) -> constructors.PrimitiveConstructorSpec[Path] | None:
    """Return how a path is read: an empty word is refused, which `Path` takes for the folder one is in."""
    how = 1, "PATH", _path, lambda value: isinstance(value, Path), lambda value: [str(value)]
    return constructors.PrimitiveConstructorSpec(*how) if info.type is Path else None


def _path(words: list[str]) -> Path:
    if not words[0]:
        raise ValueError("an empty name; is a variable of the shell not set?")
    return Path(words[0])


def parsed(program: str, kind: Any, args: Sequence[str], description: str | None = None) -> Any:
    """Return the command of type `kind`, a dataclass or a union of subcommands, that the words `args` name.

    Sets how much is said; -v and -q may stand anywhere. SystemExit as tyro raises it, with help and
    completion scripts on stdout and complaints on stderr. InputError for completion of an unknown shell.
    """
    if len(args) > 1 and args[0].startswith("--tyro-") and args[1] not in SHELLS:
        raise InputError(f"{args[0]} {args[1]}: there is {', '.join(SHELLS)}")
    args = [HOME.sub(lambda found: f"{found[1]}{os.path.expanduser('~')}", word) for word in args]
    line = make_dataclass(
        "Line",
        [
            ("command", Annotated[kind, tyro.conf.arg(name="")]),
            ("verbosity", Annotated[Verbosity, tyro.conf.arg(name="")], Verbosity()),
        ],
        namespace={"__doc__": getattr(kind, "__doc__", None)},
    )
    found: Any = tyro.cli(
        line, prog=program, description=description, args=args, config=_CONFIG, registry=ROLES
    )
    if found.verbosity.quiet and found.verbosity.verbose:
        raise InputError("--quiet and --verbose: one says less, the other more; give one of them")
    log.setLevel(found.verbosity.level)
    STRICTNESS.on = found.verbosity.strict
    return found.command


def main(program: str, parser: Callable[[], Runnable]) -> int:
    """Parse and run; returns the exit code. All that is printed is printed in here, help and version too."""
    level = log.level
    _prepare_standard_streams()
    try:
        _run(program, parser)
        sys.stdout.flush()  # now, while what goes wrong can still be said in a line
    except (LangSplatError, OSError, MemoryError, KeyboardInterrupt) as error:
        return _ended(program, error)
    except Exception as error:
        if (line := registry.failure(error)) is None:
            raise
        if log.isEnabledFor(logging.DEBUG):
            traceback.print_exception(error)
        return _ended(program, line)
    finally:
        STRICTNESS.on = False
        log.setLevel(level)
    return 0


@optional_imports()
def _run(program: str, parser: Callable[[], Runnable]) -> None:
    if sys.argv[-1] == "--version":
        print(f"{program} {__version__}")
        return
    log.setLevel(Verbosity().level)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_OneLine())
    logging.basicConfig(handlers=[handler])
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            command = parser()
    except SystemExit as stop:
        if stop.code in (0, None):
            return
        raise InputError(one_line(complaint.getvalue())) from None
    warnings.filterwarnings("ignore", module=r"(torch|transformers|huggingface_hub|numba)(\.|$)")
    began = time.perf_counter()
    with raised(program, _CONTINUES):
        check_arguments(command)
        command.run()
    log.debug("%s %s: %.1f s", program, __version__, time.perf_counter() - began)


def _ended(program: str, error: BaseException) -> int:
    """Say in a line why a command did not come to its end; returns the exit code."""
    if isinstance(error, BrokenPipeError):  # whoever reads has enough, as `| head` has
        _drop_standard_output()
        return 0
    if isinstance(error, KeyboardInterrupt):
        number = signal.SIGTERM if isinstance(error, Terminated) else signal.SIGINT
        print(f"{program}: {SAID[number]}{_CONTINUES}", file=sys.stderr)
        return 128 + number
    message = str(error)
    if isinstance(error, OSError):
        message = _system_complaint(error)
    elif isinstance(error, MemoryError):
        message = "too little memory on this machine; ask for less, or for smaller pictures"
    print(f"{program}: {message}", file=sys.stderr)
    return 2


class _StandardError(io.FileIO):
    """Standard error that drops what cannot be written, so that the work goes on."""

    def write(self, data: Any) -> int:
        """Write `data`, or lose it; return its number of bytes."""
        with contextlib.suppress(OSError):
            return super().write(data)
        return len(data)


def _prepare_standard_streams() -> None:
    """Make writing to a closed standard output fail, to standard error never; escape what is no text."""
    for number in (1, 2):
        try:
            os.fstat(number)
        except OSError:  # closed: no file that is opened later shall take its place
            os.dup2(os.open(os.devnull, os.O_RDONLY), number)
    if sys.stdout is None:
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115  as long as the process
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    console = sys.platform == "win32" and sys.stderr is not None and sys.stderr.isatty()  # takes no bytes
    if sys.stderr is sys.__stderr__ and not console:
        encoding = "utf-8" if sys.stderr is None else sys.stderr.encoding
        raw = io.BufferedWriter(_StandardError(2, "w", closefd=False))
        sys.stderr = io.TextIOWrapper(raw, encoding, errors="backslashreplace", line_buffering=True)


def _drop_standard_output() -> None:
    """Send all further output to the null device, also what is buffered when the process ends."""
    with contextlib.suppress(OSError):  # a standard output that is no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _system_complaint(error: OSError) -> str:
    """Return the operating system's message, with the file's name where it has one."""
    reason = error.strerror or str(error) or type(error).__name__
    if isinstance(error.filename, str | bytes):
        remedy = f"; {_ROOM}" if error.errno in NO_ROOM else ""
        return f"{shown(os.fsdecode(error.filename))}: {reason}{remedy}"
    if error.errno in (*NO_ROOM, errno.EBADF):  # EBADF: of a stream that is closed
        _drop_standard_output()  # perhaps the culprit, which would complain again at exit
        return f"a file or standard output cannot be written ({reason}); {_ROOM}"
    return reason


def print_json(content: Any) -> None:
    """Print a command's result, with its arrays, as JSON for programs."""
    print(json.dumps(content, indent=1, default=np.ndarray.tolist))


def aligned(rows: Sequence[Sequence[str]], left: int = 0) -> list[str]:
    """Return lines of aligned columns: the first `left` of them flush left, the others flush right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    signs = [f"{{:{'<' if at < left else '>'}{width}}}" for at, width in enumerate(widths)]
    return ["  ".join(["", *signs]).format(*row).rstrip() for row in rows]

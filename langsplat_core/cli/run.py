"""Running of commands, each of which exits with 0, with 2 and one line on stderr, or with 130 (143) when
interrupted (terminated).

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
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import MISSING, dataclass, fields, make_dataclass
from itertools import dropwhile, pairwise, takewhile
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Literal, Protocol

import numpy as np
import tyro
from rich.console import Console
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo

from langsplat_core import __version__
from langsplat_core.arrays import number, whole_number
from langsplat_core.config import (
    CODEC_CONFIGS,
    CodecConfig,
    Positive,
    annotations,
    check_settings,
    named_values,
)
from langsplat_core.errors import InputError, LangSplatError, end, is_import, optional_imports, printable_line
from langsplat_core.io.files import NO_ROOM, check_output_file, check_output_folder, shown
from langsplat_core.progress import Terminated

log = logging.getLogger("langsplat")
COMPLETION = ("--tyro-print-completion", "--tyro-write-completion")
SHELLS = ("bash", "zsh", "fish", "tcsh")
_CONTINUES = "; the same command continues where it stopped"
_LOG_LIMIT = 2000  # characters of a warning
# What writing to an open file or standard output ends in where there is no room or no file.
_UNWRITTEN = (*NO_ROOM, errno.EBADF)
_ROOM = "make room, or choose another place; what was finished is kept"
_FRAME = re.compile(r"[│╭╮╰╯]|─+")
_RULE = re.compile(r"[\s│╰╯├┤]*(─{2,}|-{5,})[\s│╰╯├┤]*")


_Flag = Annotated[
    tyro.conf.FlagCreatePairsOff[bool], tyro.conf.create_mutex_group(required=False, title="how much is said")
]


@dataclass(frozen=True)
class Verbosity:
    """Options for the amount of messages on standard error."""

    quiet: Annotated[_Flag, tyro.conf.arg(aliases=["-q"])] = False
    """Errors alone: no progress, notes or warnings."""
    verbose: Annotated[_Flag, tyro.conf.arg(aliases=["-v"])] = False
    """Also what each step took, and what was taken from an earlier run."""

    @property
    def level(self) -> int:
        """Level of the log; progress is shown below ERROR."""
        return logging.ERROR if self.quiet else logging.DEBUG if self.verbose else logging.INFO


class _OneLine(logging.Formatter):
    """Formatter that prints a record as one line of printable characters, as errors are printed."""

    def format(self, record: logging.LogRecord) -> str:
        return printable_line(record.getMessage(), _LOG_LIMIT)


class Command(Protocol):
    """Parsed arguments of a command, with the work that they ask for."""

    def run(self) -> None:
        """Do the work; raise LangSplatError for what a user can mend."""


def named(args: Sequence[str], option: str) -> str:
    """Return the last value that `args` give for an option; "" where they give none."""
    values = [
        after if word == option else word.partition("=")[2]
        for word, after in pairwise([*args, ""])
        if word.partition("=")[0] == option
    ]
    return values[-1] if values else ""


def codec_settings(args: Sequence[str], default: CodecConfig) -> CodecConfig:
    """The default settings of the codec that `args` choose by `--codec.kind`; `default` itself where it is of
    that kind or none is chosen. InputError for an unknown kind."""
    kind = named(args, "--codec.kind") or default.kind
    if kind not in CODEC_CONFIGS:
        raise InputError(f"--codec.kind {kind}: choose one of {', '.join(CODEC_CONFIGS)}")
    return default if kind == default.kind else CODEC_CONFIGS[kind]()


def with_codec(command: type[Command], args: Sequence[str]) -> type[Command]:
    """`command` with the settings of the codec that `args` choose, where it has a field `codec`."""
    entry: Any = next((entry for entry in fields(command) if entry.name == "codec"), None)  # type: ignore[arg-type]
    if entry is None:
        return command
    default = entry.default_factory() if entry.default is MISSING else entry.default
    chosen = ("codec", CodecConfig, codec_settings(args, default))
    names = {"__doc__": command.__doc__}
    return make_dataclass(command.__name__, [chosen], bases=(command,), frozen=True, namespace=names)


def one_line(box: str) -> str:
    """tyro's framed complaint as one line: its title and text, without rule and hints below it."""
    title, *body = box.strip().splitlines() or [""]
    body = list(dropwhile(_RULE.fullmatch, body))  # below the title where the terminal has no frames
    text = takewhile(lambda line: not _RULE.fullmatch(line), body)
    words = " ".join(_FRAME.sub(" ", " ".join(text)).split())
    heading = " ".join(_FRAME.sub(" ", title).split()).lower()
    return f"{words or heading or 'unusable arguments'} (see --help)"


def parsed(program: str, kind: Any, args: Sequence[str], description: str | None = None) -> Any:
    """The command of type `kind`, a dataclass or a union of subcommands, that the words `args` name. Sets how
    much is said; -v and -q may stand anywhere. SystemExit as tyro raises it, with help and completion scripts
    on stdout and complaints on stderr. InputError for completion of an unknown shell."""
    if args and args[0] in COMPLETION and args[1:2] and args[1] not in SHELLS:
        raise InputError(f"{args[0]} {args[1]}: there is {', '.join(SHELLS)}")
    line = make_dataclass(
        "Line",
        [
            ("command", Annotated[kind, tyro.conf.arg(name="")]),
            ("verbosity", Annotated[Verbosity, tyro.conf.arg(name="")], Verbosity()),
        ],
        namespace={"__doc__": getattr(kind, "__doc__", None)},
    )
    found: Any = tyro.cli(
        line,
        prog=program,
        description=description,
        args=args,
        config=(tyro.conf.CascadeSubcommandArgs,),
        registry=_NUMBERS,
    )
    log.setLevel(found.verbosity.level)
    return found.command


_NUMBERS = ConstructorRegistry()


@_NUMBERS.primitive_rule
def _read_number(option: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """How tyro reads numbers, but for the digits of other scripts."""
    kind, read = option.type, {int: whole_number, float: number}.get(option.type)
    if read is None:
        return None
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=lambda words: read(words[0]),
        is_instance=lambda value: isinstance(value, kind) or ("~" if isinstance(value, int) else False),
        str_from_instance=lambda value: [str(value)],
    )


def main(program: str, parser: Callable[[], Command]) -> int:
    """Parse and run; returns the exit code. All that is printed is printed in here, help and version too."""
    _prepare_standard_streams()
    try:
        _run(program, parser)
        sys.stdout.flush()  # now, while what goes wrong can still be said in a line
    except (LangSplatError, OSError, MemoryError, KeyboardInterrupt) as error:
        return _ended(program, error)
    return 0


@optional_imports()
def _run(program: str, parser: Callable[[], Command]) -> None:
    if sys.argv[1:] == ["--version"]:
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
    with _signals_raise(program):
        check_arguments(command)
        command.run()
    log.debug("%s %s: %.1f s", program, __version__, time.perf_counter() - began)


def _ended(program: str, error: BaseException) -> int:
    """Say in a line why a command did not come to its end; returns the exit code."""
    if isinstance(error, BrokenPipeError):  # whoever reads has enough, as `| head` has
        _drop_standard_output()
        return 0
    if isinstance(error, KeyboardInterrupt):
        how, code = ("terminated", 143) if isinstance(error, Terminated) else ("interrupted", 130)
        print(f"{program}: {how}{_CONTINUES}", file=sys.stderr)
        return code
    if isinstance(error, OSError):
        return _fail(program, _system_complaint(error))
    if isinstance(error, MemoryError):
        return _fail(program, "too little memory on this machine; ask for less, or for smaller pictures")
    return _fail(program, str(error))


@contextlib.contextmanager
def _signals_raise(program: str) -> Iterator[None]:
    """Have SIGTERM end a command as Ctrl-C does: with what is finished kept, and a line."""

    def stop(number: int, frame: FrameType | None) -> None:
        if is_import(frame):
            end(program, number, _CONTINUES)
        raise Terminated if number == signal.SIGTERM else KeyboardInterrupt

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    own = dict.fromkeys((signal.SIGTERM, signal.SIGINT), stop)
    if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # started in a shell's background
        del own[signal.SIGINT]
    before = {number: signal.signal(number, handler) for number, handler in own.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)


class _StandardError(io.FileIO):
    """Standard error. What it does not take is lost, and the work goes on."""

    def write(self, data: Any) -> int:
        """Write `data`, or lose it; return its number of bytes."""
        try:
            return super().write(data)
        except OSError:
            return len(data)


def _prepare_standard_streams() -> None:
    """Names that cannot be encoded are printed with escapes. A closed standard output fails when it is
    written to, standard error never does, and no file that is opened later takes their place."""
    if sys.stdout is None:
        _occupy(1, os.O_RDONLY)
        sys.stdout = open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115  as long as the process
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    if sys.stderr is sys.__stderr__:
        if sys.stderr is None:
            _occupy(2, os.O_WRONLY)
        encoding = "utf-8" if sys.stderr is None else sys.stderr.encoding
        raw = io.BufferedWriter(_StandardError(2, "w", closefd=False))
        sys.stderr = io.TextIOWrapper(raw, encoding, errors="backslashreplace", line_buffering=True)


def _occupy(descriptor: int, flags: int) -> None:
    """Open the null device as a standard stream that is closed."""
    nowhere = os.open(os.devnull, flags)
    if nowhere != descriptor:
        os.dup2(nowhere, descriptor)
        os.close(nowhere)


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
    if error.errno in _UNWRITTEN:
        _drop_standard_output()  # perhaps the culprit, which would complain again at exit
        return f"a file or standard output cannot be written ({reason}); {_ROOM}"
    return reason


def _fail(program: str, message: str) -> int:
    print(f"{program}: {message}", file=sys.stderr)
    return 2


def print_json(content: Any) -> None:
    """Print what a command found, arrays too, for programs."""
    print(json.dumps(content, indent=1, default=np.ndarray.tolist))


class OutputConsole(Console):
    """A console that leaves to `main` what happens when nobody reads any more; rich's own ends with 1."""

    def on_broken_pipe(self) -> None:
        """Raise BrokenPipeError, as `print` does."""
        raise BrokenPipeError


@dataclass(frozen=True)
class OutputPath:
    """Marks an argument that names what is written, so that it can be tried before the work."""

    kind: Literal["file", "folder"]


OutFile = Annotated[Path, OutputPath("file")]
OutFolder = Annotated[Path, OutputPath("folder")]

# Arguments that several commands have.
_trained = tyro.conf.arg(help="A trained scene, *.ply with its language field beside it.")
_taught = "Your own words, as `langsplat teach --into FILE` writes them, beside those of the scene."
_encoder = tyro.conf.arg(help="Text encoder folder or hub id, in place of the one the scene names.")
AnyScene = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(help="Any readable scene.")]
TrainedScene = Annotated[tyro.conf.Positional[Path], _trained]
WrittenScene = Annotated[
    tyro.conf.Positional[Path], tyro.conf.arg(help="Scene to write: .ply, .spz or .splat.")
]
EncoderOption = Annotated[str, _encoder]
JsonOption = Annotated[bool, tyro.conf.arg(help="Print JSON, lengths in world units.")]
ScaleOption = Annotated[
    Positive | None, tyro.conf.arg(help="Metres per world unit, in place of what the scene says.")
]
WordsOption = Annotated[Path | None, tyro.conf.arg(metavar="FILE", help=_taught)]


def check_arguments(command: object) -> None:
    """InputError, in one line, for the first argument of a command, a dataclass, that it cannot work with: a
    number outside of its range, a text that is not UTF-8, a place that cannot be written to."""
    check_settings(command)
    for option, value, hint in named_values(command):
        for text in value if isinstance(value, tuple) else (value,):
            if isinstance(text, str):
                _check_text(option, text)
        written = next((part for part in annotations(hint) if isinstance(part, OutputPath)), None)
        if written is not None and value is not None:
            (check_output_file if written.kind == "file" else check_output_folder)(value)


def _check_text(option: str, text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError:
        plain = text[:40].encode("utf-8", "backslashreplace").decode()
        raise InputError(f"{option} {plain}: is not UTF-8; use a terminal that is set to UTF-8") from None

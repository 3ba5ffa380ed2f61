"""Errors a user can cause, each with a message of one line: what is wrong, and how to mend it."""

import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from types import MappingProxyType, SimpleNamespace, UnionType

LINE_LIMIT = 1000  # characters of a message: room for two long paths, not for a file's content


def printable_line(text: object, limit: int = LINE_LIMIT) -> str:
    """Return `text` as one line that a terminal may show, at most `limit` characters long.

    Runs of blanks become one blank, what cannot be printed is escaped, and a long text loses its middle.
    """
    line = " ".join(
        "".join(c if c.isprintable() or c.isspace() else repr(c)[1:-1] for c in str(text)).split()
    )
    if len(line) <= limit:
        return line
    tail = limit // 2
    return f"{line[: limit - tail - 3]}...{line[-tail:]}"


def shortened(names: Iterable[str], limit: int = 5, width: int = 200) -> str:
    """Return ``a, b, c and 4 more``, about `width` characters at most; long names lose their middle."""
    listed = sorted(names)
    rest = len(listed) - limit
    shown = printable_line(", ".join(printable_line(name, 80) for name in listed[:limit]), width)
    return shown + (f" and {rest} more" if rest > 0 else "")


def quoted(content: object, limit: int = 60) -> str:
    """Return content of a file, quoted for a message: at most `limit` characters with its escapes."""
    return printable_line(repr(content), limit)


class LangSplatError(Exception):
    """Base of every error that the command line turns into one line and exit code 2.

    `str()` of it is a `printable_line`, whatever a file brought; who quotes a file or an error shortens it.
    """

    def __str__(self) -> str:
        return printable_line(super().__str__())


class InputError(LangSplatError):
    """An argument, file or folder that cannot be used as given."""


class FormatError(InputError):
    """A file whose content breaks a rule of its format."""


def malformed(path: object, what: str, remedy: str = "copy it again, or export it anew") -> FormatError:
    """Return the error of a file that breaks a rule: its name, what is wrong, and how to mend it."""
    return FormatError(f"{path}: {what}; {remedy}")


# What a reader skips, pads, rounds or guesses is counted by it and said in one line.

Tell = Callable[[str], None]  # takes such a loss, for the line of its file
# on: by --strict, a loss is an error; said: the latest losses
STRICTNESS = SimpleNamespace(on=False, said=deque[str](maxlen=4))


def report_loss(message: str, *values: object) -> None:
    """Say in one line what a reader could not take as it was given; InputError under --strict."""
    STRICTNESS.said.append(message % values)
    if STRICTNESS.on:
        raise InputError(f"{STRICTNESS.said[-1]} (refused by --strict)")
    logging.getLogger("langsplat").warning(message, *values)


def report_losses(path: object, told: Iterable[str]) -> None:
    """Say in one line all that a reader told of a file, empty texts aside; nothing where that is none."""
    if lost := "; ".join(filter(None, told)):
        report_loss("%s: %s", path, printable_line(lost, 240))


def unread(what: str, names: Iterable[object]) -> str:
    """Return, for `report_losses`, that things of a name are passed over; "" where there are none."""
    listed = shortened(map(str, names), 3, 80)
    return listed and f"{what} {listed} not read".lstrip()


def expect(value: object, kind: type | UnionType, hint: str) -> None:
    """Raise InputError unless a value that a caller gave is of a kind."""
    if not isinstance(value, kind):
        name = kind.__name__ if isinstance(kind, type) else kind
        raise InputError(f"expected a {name}, got {type(value).__name__}; {hint}")


class BackendError(LangSplatError):
    """A rasterizer, driver or optional library that cannot be loaded on this machine."""


class EncoderError(LangSplatError):
    """A text or image encoder whose weights are absent or that does not know what was asked."""


class UnknownWordError(EncoderError):
    """Words that a text encoder was never taught."""

    def __init__(self, near: Mapping[str, Sequence[str]], remedy: str) -> None:
        """near: each unknown word and the known ones written like it, the nearest first."""
        self.near = {word: tuple(close) for word, close in near.items()}
        super().__init__(f"the encoder does not know {', '.join(map(self._said, self.near))}; {remedy}")

    def _said(self, word: str) -> str:
        close = " or ".join(map(repr, self.near[word]))
        return f"{word!r} (did you mean {close}?)" if close else repr(word)


# Optional packages: the extra of the distribution that brings each, and one line where one is missing.

EXTRAS: Mapping[str, str] = MappingProxyType({  # name as imported -> extra, as in pyproject.toml
    "torch": "train", "pycolmap": "train", "skimage": "train", "transformers": "encoders",
    "tokenizers": "encoders", "huggingface_hub": "encoders", "ftfy": "encoders", "matplotlib": "plots",
    "gsplat": "cuda", "mcp": "agents", "open3d": "geometry", "av": "phones", "pillow_heif": "phones",
    "pxr": "usd", "distributed": "dask",
})  # fmt: skip


def remedy(package: str) -> str:
    """Return the command that installs a package of `EXTRAS`."""
    return f'pip install "langsplat-viewer[{EXTRAS[package]}]"'


@contextmanager
def optional_imports(error: type[LangSplatError] = BackendError) -> Iterator[None]:
    """Turn a failed import of `EXTRAS` into `error` with the line that installs it; also a decorator."""
    try:
        yield
    except ModuleNotFoundError as missing:
        package = (missing.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        raise error(f"this needs {package}: {remedy(package)}") from None

"""Errors a user can cause. Each message is one line: what is wrong, and how to mend it."""

from collections.abc import Mapping, Sequence


class LangSplatError(Exception):
    """Base of every error that the command line turns into one line and exit code 2."""


class InputError(LangSplatError):
    """An argument, file or folder that cannot be used as given."""


class FormatError(InputError):
    """A file whose content breaks a rule of its format."""


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

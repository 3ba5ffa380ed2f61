"""Errors a user can cause. Each message is one line: what is wrong, and how to mend it."""


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

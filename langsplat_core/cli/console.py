"""Tables on standard output."""

from rich.console import Console


class OutputConsole(Console):
    """A console that leaves to `cli.run` what happens when nobody reads any more; rich's own ends with 1."""

    def on_broken_pipe(self) -> None:
        """Raise BrokenPipeError, as `print` does."""
        raise BrokenPipeError

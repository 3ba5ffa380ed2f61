"""`python -m tests.benchmarks NAME`: one report each, of those in `parse`."""

import sys
from typing import Union

from langsplat_core.cli.arguments import Runnable, check_codec
from langsplat_core.cli.run import main, parsed
from tests.benchmarks.answers import Lifting, Rooms, Verdicts
from tests.benchmarks.extensions import Changed, Clean, Maps, Meshes
from tests.benchmarks.few import Few
from tests.benchmarks.phrases import Counts, Phrases
from tests.benchmarks.scale import Formats, Scale

PROGRAM = "python -m tests.benchmarks"


def parse(args: list[str]) -> Runnable:
    """The report that the words of a command line name; SystemExit as tyro raises it."""
    about = "Measure this project where the truth is known, and at large sizes."
    check_codec(args)
    reports = (
        *(Rooms, Verdicts, Phrases, Counts, Clean, Maps, Meshes),
        *(Lifting, Scale, Changed, Formats, Few),
    )
    command: Runnable = parsed(PROGRAM, Union[(*reports,)], args, about)
    return command


if __name__ == "__main__":
    sys.exit(main(PROGRAM, lambda: parse(sys.argv[1:] or ["--help"])))

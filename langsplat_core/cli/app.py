"""`langsplat ...`: thin commands, each a dataclass of arguments and one call into the layers below."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from difflib import get_close_matches
from types import MappingProxyType

from tyro.extras import SubcommandApp

from langsplat_core.cli.bench import BenchRaster
from langsplat_core.cli.bench_endurance import BenchEndurance
from langsplat_core.cli.bench_gains import BenchGains
from langsplat_core.cli.bench_lift import BenchLift
from langsplat_core.cli.bench_load import BenchLoad
from langsplat_core.cli.bench_memory import BenchMemory
from langsplat_core.cli.bench_moving import BenchMoving
from langsplat_core.cli.bench_paper import BenchPaper
from langsplat_core.cli.bench_phrases import BenchPhrases
from langsplat_core.cli.bench_query import BenchQuery
from langsplat_core.cli.bench_steps import BenchSteps
from langsplat_core.cli.bench_verdict import BenchVerdict
from langsplat_core.cli.bench_words import BenchWords
from langsplat_core.cli.compact import Compact
from langsplat_core.cli.convert import Convert
from langsplat_core.cli.demo import DemoBuild, DemoDataset, DemoEncoder, DemoSheet
from langsplat_core.cli.describe import Describe
from langsplat_core.cli.evaluate import EvalSynthetic
from langsplat_core.cli.evaluate_labels import EvalLerfOvs, EvalOvs3d, EvalScanNet
from langsplat_core.cli.inspect import Doctor, Inspect
from langsplat_core.cli.query import QueryScene
from langsplat_core.cli.run import Command, main
from langsplat_core.cli.scale import Scale
from langsplat_core.cli.select import Select
from langsplat_core.cli.train import train_command
from langsplat_core.errors import InputError

# Options that are asked for often enough to have a short name.
ALIASES = {"--max-relevancy-error": "--codec.max-relevancy-error"}


COMMANDS: Mapping[str, type[Command]] = MappingProxyType(
    {
        "query": QueryScene,
        "describe": Describe,
        "select": Select,
        "scale": Scale,
        "convert": Convert,
        "compact": Compact,
        "inspect": Inspect,
        "doctor": Doctor,
    }
)
# Name -> what it is about, and its commands.
GROUPS: Mapping[str, tuple[str, Mapping[str, type[Command]]]] = MappingProxyType(
    {
        "demo": (
            "Make the bundled scene, its photographs and its encoder.",
            {"build": DemoBuild, "dataset": DemoDataset, "encoder": DemoEncoder, "sheet": DemoSheet},
        ),
        "eval": (
            "Measure a scene against ground truth.",
            {
                "synthetic": EvalSynthetic,
                "lerf-ovs": EvalLerfOvs,
                "3d-ovs": EvalOvs3d,
                "scannet": EvalScanNet,
            },
        ),
        "bench": (
            "Speed against error, measured in one run.",
            {
                "raster": BenchRaster,
                "endurance": BenchEndurance,
                "gains": BenchGains,
                "lift": BenchLift,
                "paper": BenchPaper,
                "load": BenchLoad,
                "moving": BenchMoving,
                "memory": BenchMemory,
                "phrases": BenchPhrases,
                "query": BenchQuery,
                "steps": BenchSteps,
                "verdict": BenchVerdict,
                "words": BenchWords,
            },
        ),
    }
)


def parse(args: list[str]) -> Command:
    """The command that the words of a command line name; SystemExit as tyro raises it, with its message on
    stderr. Raises InputError for a command that does not exist."""
    check_commands(args)
    app = SubcommandApp()
    app.command(name="train")(train_command(args))
    for name, command in COMMANDS.items():
        app.command(name=name)(command)
    for name, (about, commands) in GROUPS.items():
        group = SubcommandApp()
        for member, command in commands.items():
            group.command(name=member)(command)
        app.command(group, name=name, help=about)
    args = [ALIASES.get(word, word) for word in args]
    found: Command = app.cli(
        prog="langsplat",
        description="Train, query, convert and measure 3D Gaussian scenes with a language field.",
        args=args,
    )
    return found


def check_commands(args: Sequence[str]) -> None:
    """InputError that names a command which does not exist, and those that are written like it."""
    known: Iterable[str] = ("train", *COMMANDS, *GROUPS)
    for place, word in enumerate(args[:2]):
        if word.startswith("-"):
            return
        if word not in known:
            near = get_close_matches(word, known, n=2)
            hint = (
                f"did you mean {' or '.join(map(repr, near))}?" if near else f"there are {', '.join(known)}"
            )
            raise InputError(f"no command {' '.join(args[: place + 1])!r}; {hint}")
        if word not in GROUPS:
            return
        known = tuple(GROUPS[word][1])


def entry() -> None:
    """The `langsplat` console script."""
    args = sys.argv[1:] or ["--help"]
    sys.exit(main("langsplat", lambda: parse(args)))

"""`langsplat ...`: thin commands, each a dataclass of arguments and one call into the layers below."""

import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import make_dataclass
from difflib import get_close_matches
from importlib import import_module
from itertools import takewhile
from types import MappingProxyType
from typing import Annotated, Any, Union

import tyro

from langsplat_core.cli.run import Command, main, parsed, with_codec
from langsplat_core.errors import InputError

FLAGS = ("-q", "--quiet", "-v", "--verbose")  # may precede a command
# Name -> class, in a module beside this one that is imported when the command line needs it.
COMMANDS: Mapping[str, str] = MappingProxyType({
    "train": "train.Train", "frames": "train.Frames", "query": "query.QueryScene", "find": "find.Find",
    "changes": "find.Changes", "describe": "describe.Describe", "select": "query.Select",
    "teach": "describe.Teach", "serve": "serve.Serve", "map": "geometry.Map", "scale": "edit.Scale",
    "mesh": "geometry.Mesh", "register": "geometry.Register", "merge": "geometry.Merge",
    "transform": "edit.Transform", "crop": "edit.Crop", "clean": "edit.Clean", "export": "export.Export",
    "convert": "export.Convert", "compact": "edit.Compact", "inspect": "scenes.Inspect",
    "doctor": "scenes.Doctor", "demo": "scenes.Demo",
})  # fmt: skip
_EVALUATIONS = {"lerf-ovs": "EvalLerfOvs", "3d-ovs": "EvalOvs3d", "scannet": "EvalScanNet"}
_BENCHES = {"raster": "BenchRaster", "query": "BenchQuery"}
# Name -> what it is about, and its commands.
GROUPS: Mapping[str, tuple[str, Mapping[str, str]]] = MappingProxyType(
    {
        name: (about, {word: f"evaluate.{command}" for word, command in members.items()})
        for name, about, members in (
            ("eval", "Measure a scene against ground truth.", _EVALUATIONS),
            ("bench", "Speed against error, measured in one run.", _BENCHES),
        )
    }
)


def parse(args: list[str]) -> Command:
    """The command that the words of a command line name; SystemExit as tyro raises it, with its message on
    stderr. Raises InputError for a command that does not exist, and for an unusable `--config`."""
    before = list(takewhile(FLAGS.__contains__, args))
    args = args[len(before) :]
    check_commands(args)
    if args[:1] == ["train"]:
        from langsplat_core.cli.train import train_command, with_file

        args = with_file(args)
        commands = [_subcommand("train", train_command(args))]
    elif args and args[0] in GROUPS:
        commands = [_group(args[0], args[1:2])]
    elif args and args[0] in COMMANDS:
        commands = [_subcommand(args[0], with_codec(load_command(COMMANDS[args[0]]), args))]
    else:
        commands = [_subcommand(name, load_command(where)) for name, where in COMMANDS.items()]
        commands += [_group(name, ()) for name in GROUPS]
    about = "Train, query, convert and measure 3D Gaussian scenes with a language field."
    found = parsed("langsplat", _union(commands), [*before, *args], about)
    return getattr(found, "command", found)  # of a group


def load_command(where: str) -> type[Command]:
    """The class at a place of `COMMANDS` or `GROUPS`."""
    module, _, name = where.partition(".")
    return getattr(import_module(f"langsplat_core.cli.{module}"), name)


def _subcommand(name: str, command: type[Command]) -> Any:
    return Annotated[command, tyro.conf.subcommand(name=name)]


def _group(name: str, words: Sequence[str]) -> Any:
    """A group's commands, or only the one that `words` begins with."""
    about, members = GROUPS[name]
    named = [word for word in words if word in members] or list(members)
    made = _union([_subcommand(member, load_command(members[member])) for member in named])
    group = make_dataclass("Group", [("command", Annotated[made, tyro.conf.arg(name="")])])
    return Annotated[group, tyro.conf.subcommand(name=name, description=about)]


def _union(commands: Sequence[Any]) -> Any:
    """The union of commands; tyro asks for two subcommands at least."""
    return Union[(*commands, Annotated[None, tyro.conf.Suppress])]


def check_commands(args: Sequence[str]) -> None:
    """InputError that names a command which does not exist, and those that are written like it."""
    known: Iterable[str] = (*COMMANDS, *GROUPS)
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
    """Run the `langsplat` console script."""
    args = sys.argv[1:] or ["--help"]
    sys.exit(main("langsplat", lambda: parse(args)))

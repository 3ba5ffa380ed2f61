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

from langsplat_core import registry
from langsplat_core.cli.arguments import Runnable, with_codec
from langsplat_core.cli.run import main, parsed
from langsplat_core.errors import InputError

FLAGS = ("-q", "--quiet", "-v", "--verbose")  # may precede a command
# Name -> class, imported when the command line needs it; those of extensions follow.
CORE: Mapping[str, str] = MappingProxyType({
    "train": "train.Train", "frames": "train.Frames", "query": "query.QueryScene",
    "describe": "describe.Describe", "select": "query.Select", "teach": "describe.Teach",
    "scale": "export.SetScale", "transform": "export.Transform", "crop": "export.Crop",
    "export": "export.Export", "convert": "export.Convert",
    "inspect": "scenes.Inspect", "doctor": "scenes.Doctor", "demo": "scenes.Demo",
})  # fmt: skip


def parse(args: list[str]) -> Runnable:
    """Return the command that the words of a command line name.

    Raises SystemExit as tyro does, with its message on stderr; InputError for a command that does not exist.
    """
    before = list(takewhile(FLAGS.__contains__, args))
    args = args[len(before) :]
    check_commands(args)
    if args[:1] == ["train"]:
        from langsplat_core.cli.train import train_command

        commands = [_subcommand("train", train_command(args))]
    elif args[:1] and args[0] in command_names():
        commands = [_subcommand(args[0], with_codec(load_command(args[0]), args))]
    else:
        groups = registry.references("groups")
        named = args[:1] if args[:1] and args[0] in groups else [*CORE, *_extras(), *groups]
        commands = [_group(name, args[1:2]) if name in groups else _listed(name) for name in named]
        commands = [command for command in commands if command is not None]
    about = "Train, query, convert and measure 3D Gaussian scenes with a language field."
    found = parsed("langsplat", _union(commands), [*before, *args], about)
    return getattr(found, "command", found)  # of a group


def command_names() -> list[str]:
    """Return the names of all commands, those of groups as "group name", of the core and of extensions."""
    return [*CORE, *registry.references("commands")]


def load_command(name: str) -> type[Runnable]:
    """Return the class of a command; InputError for one of an extension that cannot be imported."""
    if name not in CORE:
        return registry.part("commands", name)
    module, _, kind = CORE[name].partition(".")
    return getattr(import_module(f"langsplat_core.cli.{module}"), kind)


def _extras() -> list[str]:
    """Return the commands of extensions that stand in no group."""
    return [name for name in registry.references("commands") if " " not in name]


def _listed(name: str) -> Any:
    """Return a subcommand for the list of all; None for one of an extension that is broken."""
    if name in CORE:
        return _subcommand(name, load_command(name))
    command = registry.parts("commands").get(name)
    return None if command is None else _subcommand(name, command)


def _subcommand(name: str, command: type[Runnable]) -> Any:
    return Annotated[command, tyro.conf.subcommand(name=name)]


def _group(name: str, words: Sequence[str]) -> Any:
    """Return a group's commands, or only the one that `words` begins with."""
    members = _members(name)
    named = [word for word in words if word in members] or members
    made = _union([_subcommand(member, load_command(f"{name} {member}")) for member in named])
    group = make_dataclass("Group", [("command", Annotated[made, tyro.conf.arg(name="")])])
    about = registry.references("groups")[name]
    return Annotated[group, tyro.conf.subcommand(name=name, description=about)]


def _members(group: str) -> list[str]:
    """Return the names of a group's commands, without the group's own."""
    return [
        name.partition(" ")[2] for name in registry.references("commands") if name.startswith(f"{group} ")
    ]


def _union(commands: Sequence[Any]) -> Any:
    """Return the union of commands; tyro asks for two subcommands at least."""
    return Union[(*commands, Annotated[None, tyro.conf.Suppress])]


def check_commands(args: Sequence[str]) -> None:
    """Raise InputError for a command that does not exist, naming those that are written like it."""
    groups = registry.references("groups")
    known: Iterable[str] = (*CORE, *_extras(), *groups)
    for place, word in enumerate(args[:2]):
        if word.startswith("-"):
            return
        if word not in known:
            near = get_close_matches(word, known, n=2)
            hint = (
                f"did you mean {' or '.join(map(repr, near))}?" if near else f"there are {', '.join(known)}"
            )
            raise InputError(f"no command {' '.join(args[: place + 1])!r}; {hint}")
        if word not in groups:
            return
        known = _members(word)


def entry() -> None:
    """Run the `langsplat` console script."""
    args = sys.argv[1:] or ["--help"]
    sys.exit(main("langsplat", lambda: parse(args)))

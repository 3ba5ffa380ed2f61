"""`langsplat ...`: thin commands, each a dataclass of arguments and one call into the layers below."""

import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import make_dataclass
from difflib import get_close_matches
from importlib import import_module
from itertools import takewhile
from types import MappingProxyType
from typing import Annotated, Any, Union, get_type_hints

import tyro

from langsplat_core import registry
from langsplat_core.cli.arguments import PLACED, Runnable, check_codec, named
from langsplat_core.cli.run import main, parsed
from langsplat_core.config import annotations
from langsplat_core.errors import InputError

FLAGS = ("-q", "--quiet", "-v", "--verbose", "--strict")  # may precede a command
# Name -> class, imported when the command line needs it; those of extensions follow.
CORE: Mapping[str, str] = MappingProxyType({
    "train": "train.Train", "query": "query.QueryScene",
    "describe": "describe.Describe", "select": "query.Select", "teach": "describe.Teach",
    "scale": "export.SetScale", "transform": "export.Transform", "crop": "export.Crop",
    "export": "export.Export", "convert": "export.Convert",
    "inspect": "scenes.Inspect", "doctor": "scenes.Doctor", "demo": "scenes.Demo",
})  # fmt: skip
HEADINGS: Mapping[str, str] = MappingProxyType({  # of `langsplat --help`, with their commands
    "begin": "demo train",
    "ask": "query describe find changes teach serve",
    "take apart, edit and join": "select crop clean compact transform scale register merge",
    "write other files": "convert export mesh map",
    "measure": "inspect eval bench doctor",
})  # fmt: skip
ABOUT = """usage: langsplat [-q | -v] [--strict] COMMAND ...    (langsplat-viewer opens a window)

-q prints errors alone, -v what each step took; --strict refuses what would be skipped, padded or guessed.
COMMAND --help lists what a command takes. OUT may also be --out OUT or -o OUT."""


def parse(args: list[str]) -> Runnable:
    """Return the command that the words name; SystemExit as of tyro, InputError for none and `--config`."""
    before = list(takewhile(FLAGS.__contains__, args))
    args = args[len(before) :]
    if args[:1] in ([], ["help"], ["-h"], ["--help"]):  # git's `--help COMMAND`, too
        args = [*args[1:], "--help"]
    if args[0] == "--help":
        print(ABOUT, *_overview(), sep="\n")
        raise SystemExit(0)
    check_commands(args)
    commands: dict[str, Any]
    groups, name = _groups(), args[0] if args else ""
    if name == "train":
        from langsplat_core.cli.train import train_command, with_file

        args = with_file(args)
        commands = {name: train_command(args)}
    elif name in command_names():
        check_codec(args)
        commands = {name: load_command(name)}
        args = _with_out(args, commands[name])
    elif name in groups:
        commands = {name: _group(name)}
    else:
        commands = _all()
    found = parsed("langsplat", _union(commands), [*before, *args])
    return getattr(found, "command", found)  # of a group


def _all() -> dict[str, Any]:
    """Return all commands and groups, but for those of extensions that are broken."""
    alone = {name: kind for name, kind in registry.parts("commands").items() if " " not in name}
    return {**{name: load_command(name) for name in CORE}, **alone, **{one: _group(one) for one in _groups()}}


def _overview() -> Iterator[str]:
    """Yield lines with the names of all commands, each with the first one of its help, under headings."""
    kinds, listed = _all(), {*" ".join(HEADINGS.values()).split()}
    for heading, names in {**HEADINGS, "from extensions": " ".join(sorted(kinds.keys() - listed))}.items():
        there = [name for name in names.split() if name in kinds]
        yield from ["", heading] if there else []
        yield from (f"  {name:<9}  {(kinds[name].__doc__ or '').partition(chr(10))[0]}" for name in there)


def _with_out(args: list[str], kind: type[Runnable]) -> list[str]:
    """Return the words of a command, what --out or -o gives at the end where its place is there."""
    hint = get_type_hints(kind, include_extras=True).get("out", Any)
    if PLACED not in annotations(hint) and not isinstance(getattr(kind, "out", None), property):
        return args
    out, rest = named(args, "-o", "--out")
    if out == "":
        raise InputError("--out: names nothing; put behind it what to write")
    return rest if out is None else [*rest, *["--"][: "--" not in rest], out]


def command_names() -> list[str]:
    """Return the names of all commands, those of groups as "group name", of the core and of extensions."""
    return [*CORE, *registry.references("commands")]


def load_command(name: str) -> type[Runnable]:
    """Return the class of a command; InputError for one of an extension that cannot be imported."""
    if name not in CORE:
        return registry.part("commands", name)
    module, _, kind = CORE[name].partition(".")
    return getattr(import_module(f"langsplat_core.cli.{module}"), kind)


def _groups() -> Mapping[str, str]:
    """Return what the commands of each group do, by its name; "" where no extension says it."""
    unsaid = {name.split(" ")[0]: "" for name in registry.references("commands") if " " in name}
    return {**unsaid, **registry.references("groups")}


def _group(name: str) -> Any:
    made = _union({member: load_command(f"{name} {member}") for member in _members(name)})
    group = make_dataclass("Group", [("command", Annotated[made, tyro.conf.arg(name="")])])
    group.__doc__ = _groups()[name]
    return group


def _members(group: str) -> list[str]:
    return [name.split(" ")[1] for name in registry.references("commands") if name.startswith(f"{group} ")]


def _union(commands: Mapping[str, Any]) -> Any:
    """Return commands as subcommands; tyro needs at least two."""
    named = (Annotated[kind, tyro.conf.subcommand(name=name)] for name, kind in commands.items())
    return Union[(*named, Annotated[None, tyro.conf.Suppress])]


def check_commands(args: Sequence[str]) -> None:
    """Raise InputError for a command that does not exist, naming those with a similar spelling."""
    groups = _groups()
    known: Iterable[str] = (*(name for name in command_names() if " " not in name), *groups)
    for place, word in enumerate(args[:2]):
        if word.startswith("-"):
            return
        if word not in known:
            near = " or ".join(map(repr, get_close_matches(word, known, n=2)))
            hint = f"did you mean {near}?" if near else f"there are {', '.join(known)}"
            raise InputError(f"no command {' '.join(args[: place + 1])!r}; {hint}")
        if word not in groups:
            return
        known = _members(word)


def entry() -> None:
    """Run the `langsplat` console script."""
    sys.exit(main("langsplat", lambda: parse(sys.argv[1:])))

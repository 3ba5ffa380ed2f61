"""Arguments that several commands have, with their types, help and checks."""

from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Protocol

import tyro

from langsplat_core import config
from langsplat_core.errors import InputError
from langsplat_core.io.files import check_output_file, check_output_folder

(PLACED,) = tyro.conf.Positional[str].__metadata__  # type: ignore[attr-defined]  # the mark that it is


class Runnable(Protocol):
    """Parsed arguments of a command, with the work that they ask for."""

    def run(self) -> None:
        """Do the work; raise LangSplatError for what a user can mend."""


@dataclass(frozen=True)
class OutputPath:
    """Marks an argument that names an output, so that it can be checked before the work."""

    kind: Literal["file", "folder"]


@dataclass(frozen=True)
class Needs:
    """Marks an argument without effect unless another field of the command, or a property, is given."""

    field: str
    said: str = ""  # how that is given; "": by the option of its name


# What these say holds in other types, too, as in `OutFile | None`.
OutFile = Annotated[Path, OutputPath("file"), tyro.conf.arg(metavar="FILE")]
OutFolder = Annotated[Path, OutputPath("folder"), tyro.conf.arg(metavar="FOLDER")]
Photographs = Annotated[Path, tyro.conf.arg(metavar="PHOTOGRAPHS")]
Texts = Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="TEXT ...")]
EncoderName = Annotated[str, tyro.conf.arg(metavar="ID|FOLDER")]

_trained = tyro.conf.arg(help="A trained scene, *.ply with its language field beside it.")
_written = tyro.conf.arg(help="Scene to write: .ply, .spz ...; or --out OUT, -o OUT.")
_taught = "Your own words, as `langsplat teach --into FILE` writes them, beside those of the scene."
_encoder = tyro.conf.arg(help="Text encoder folder or hub id, in place of the one the scene names.")
AnyScene = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(help="Any readable scene.")]
TrainedScene = Annotated[tyro.conf.Positional[Path], _trained]
WrittenScene = Annotated[tyro.conf.Positional[Path], _written]
EncoderOption = Annotated[EncoderName, _encoder]
JsonOption = Annotated[bool, tyro.conf.arg(help="Print JSON, lengths in world units.")]
_scale = tyro.conf.arg(help="Metres per world unit, in place of what the scene says.")
ScaleOption = Annotated[config.Positive | None, _scale]
WordsOption = Annotated[Path | None, tyro.conf.arg(metavar="FILE", help=_taught)]


def check_arguments(command: object) -> None:
    """Raise InputError for an argument out of its range, unused, not UTF-8, or not to be written to."""
    config.check_settings(command)
    for option, value, hint in config.named_values(command):
        for text in value if isinstance(value, tuple) else (value,):
            if isinstance(text, str) and text != text.encode("utf-8", "ignore").decode():
                plain = text[:40].encode("utf-8", "backslashreplace").decode()
                raise InputError(f"{option} {plain}: is not UTF-8; use a terminal that is set to UTF-8")
        for part in config.annotations(hint):
            if isinstance(part, OutputPath) and value is not None:
                check = check_output_file if part.kind == "file" else check_output_folder
                check(value)
            unused = isinstance(part, Needs) and not getattr(command, part.field)
            if unused and value != getattr(type(command), option[2:].replace("-", "_")):
                other = part.said or f"--{part.field.replace('_', '-')}"
                raise InputError(f"{option}: is only used with {other}; add that, or leave {option} out")


def named(args: Sequence[str], *option: str) -> tuple[str | None, list[str]]:
    """Return the last value that words give for an option, by any of its names, and the other words."""
    parser = ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument(*option, dest="value", nargs="?", const="")
    found, others = parser.parse_known_args(args)
    return found.value, others


def check_codec(args: Sequence[str], default: config.CodecKind = "codebook") -> None:
    """Raise InputError for a codec's setting among `args` that the kind which they choose has not."""
    kind = named(args, "--codec.kind")[0] or default
    own = config.CODEC_SETTINGS.get(kind, ())  # type: ignore[call-overload]  # whatever was typed
    typed = {word.partition("=")[0].replace("_", "-").replace("--max-", "--codec.max-") for word in args}
    for name in sorted(set().union(*config.CODEC_SETTINGS.values()) - {*own} if own else ()):
        if (option := f"--codec.{name.replace('_', '-')}") in typed:
            raise InputError(f"{option}: is no setting of a codec of kind {kind}; leave it out")

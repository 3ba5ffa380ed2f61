"""Extensions: the door for all that is no part of the core, the project's own as well as a stranger's.

A package adds to the program by one entry point of the group `langsplat.extensions`, which names an
`Extension`. Its parts are references, `module:NAME`, imported when they are first needed, so that a scene
opens without the code of extensions. What cannot be loaded costs one warning and is left out.
"""

import logging
import os
import traceback
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from itertools import product
from types import MappingProxyType
from typing import Any, Literal

from langsplat_core.errors import InputError, printable_line, shortened

log = logging.getLogger("langsplat")
GROUP = "langsplat.extensions"
HIDDEN = "LANGSPLAT_WITHOUT"  # environment: names of extensions, separated by commas, that are not loaded

Kind = Literal[
    "commands", "groups", "formats", "importers", "exporters", "encoders", "segmenters", "text_segmenters",
    "layouts", "mask_sources", "panels",
]  # fmt: skip
References = Mapping[str, str]
# Classes of parts by their names; commands are dataclasses with `run`, all others functions.
CLASSES: References = MappingProxyType({
    "formats": "SceneFormat", "importers": "Importer", "exporters": "Exporter", "encoders": "Family",
    "panels": "Panel",
})  # fmt: skip
# Names that are the core's own; a part of an extension that has one is left out.
OWN: References = MappingProxyType({
    "commands": "train query describe select teach scale transform crop export convert inspect doctor demo",
    "formats": ".ply .spz .splat .sog .glb .gltf", "exporters": "scene", "encoders": "clip",
    "segmenters": "sam sam2 sam2_video", "text_segmenters": "sam3 sam3_video sam3_lite_text",
    "mask_sources": "auto sam graph",
    "panels": "Search Display Camera Outline Selection Transform Record Bookmarks Notes Scene Train Timeline "
    "Messages",
})  # fmt: skip


@dataclass(frozen=True)
class Extension:
    """Named parts that a package adds to the program; each value is a reference `module:NAME`."""

    commands: References = field(default_factory=dict)  # "mesh" or "bench raster" -> dataclass with `run`
    groups: References = field(default_factory=dict)  # "bench" -> what its commands do, a sentence for --help
    formats: References = field(default_factory=dict)  # ".xyz" -> io.scenes.SceneFormat
    importers: References = field(default_factory=dict)  # method -> io.scenes.Importer
    exporters: References = field(default_factory=dict)  # word of `convert --to` -> io.scenes.Exporter
    encoders: References = field(default_factory=dict)  # `model_type` of config.json -> encoders.Family
    segmenters: References = field(default_factory=dict)  # `model_type` -> function of Weights to a Segmenter
    text_segmenters: References = field(default_factory=dict)  # `model_type` -> function to a TextSegmenter
    layouts: References = field(default_factory=dict)  # name -> semantics.weights.Layout
    mask_sources: References = field(default_factory=dict)  # `--masks.source` -> function to a MaskSource
    panels: References = field(default_factory=dict)  # title -> langsplat_viewer.panels.layout.Panel


@cache
def extensions() -> Mapping[str, Extension]:
    """Return the extensions that are installed, by the names of their entry points, sorted.

    Those that the environment variable `LANGSPLAT_WITHOUT` names are left out, and so are, with a warning,
    those that cannot be imported, parts named as one of the core, and of two of one name the second.
    """
    hidden = {name.strip() for name in os.environ.get(HIDDEN, "").split(",")}
    points: dict[str, EntryPoint] = {}
    for point in entry_points(group=GROUP):
        if points.setdefault(point.name, point) != point:
            _warn(f"extension {point.name} ({point.value})", f"{points[point.name].value} has its name")
    found: dict[str, Extension] = {}
    for name in sorted(points.keys() - hidden):
        extension = _loaded(f"extension {name}", points[name])
        if isinstance(extension, Extension):
            found[name] = extension
        elif extension is not None:
            _warn(f"extension {name}", f"its entry point is a {type(extension).__name__}, not an Extension")
    owners: dict[tuple[str, str], str] = {}
    for name, kind in product(found, (kind.name for kind in fields(Extension))):
        for one in getattr(found[name], kind):
            if _is_own(kind, one):
                _warn(f"{one!r} of extension {name}", f"the core has it among its {kind}")
            elif (owner := owners.setdefault((kind, one), name)) != name:
                has = f"extension {owner} has it among its {kind}, too"
                _warn(f"{one!r} of extension {name}", f"{has}; {HIDDEN}={owner} hides that")
    return found


def references(kind: Kind) -> References:
    """Return the references of one kind by their names, of all extensions; of two of one name the first."""
    found: dict[str, str] = {}
    for extension in extensions().values():
        found = {**getattr(extension, kind), **found}
    return {name: where for name, where in found.items() if not _is_own(kind, name)}


def _is_own(kind: str, name: str) -> bool:
    first = name.split(" ")[0] if kind in ("commands", "groups") else name  # no group has a command's name
    return first in OWN.get(kind.replace("groups", "commands"), "").split()


def part(kind: Kind, name: str) -> Any:
    """Return one part of an extension; InputError where there is none of that name or it is broken."""
    if name not in (known := references(kind)):
        raise InputError(f"no extension has {name!r} among its {kind}; known: {shortened(known) or 'none'}")
    if (found := _imported(kind, name, known[name])) is None:
        raise InputError(f"{name!r} cannot be used: its extension is broken; mend or remove it")
    return found


def parts(kind: Kind) -> Mapping[str, Any]:
    """Return all parts of one kind by their names; a broken one is left out with a warning."""
    found = {name: _imported(kind, name, where) for name, where in references(kind).items()}
    return {name: one for name, one in found.items() if one is not None}


def failure(error: Exception) -> InputError | None:
    """Return, as a line, an error that came through the code of an extension; None for any other."""
    owners = {
        where.partition(":")[0].partition(".")[0]: name
        for name, extension in extensions().items()
        for named in vars(extension).values()
        for where in named.values()
    }
    for frame, line in reversed([*traceback.walk_tb(error.__traceback__)]):  # the innermost first
        module = frame.f_globals.get("__name__", "")
        package = module.partition(".")[0]
        if package in owners and package != "langsplat_core":
            where = f"extension {owners[package]} fails in {module}, line {line}"
            remedy = f"mend that or hide it, {HIDDEN}={owners[package]}; -v prints the traceback"
            return InputError(f"{where} ({type(error).__name__}: {printable_line(error, 300)}); {remedy}")
    return None


@cache
def _imported(kind: Kind, name: str, where: str) -> Any:
    what = f"extension's {kind} {name}"
    found, wanted = _loaded(what, EntryPoint(name, where, GROUP)), CLASSES.get(kind, "function")
    classes = [one.__name__ for one in type(found).__mro__]  # by name: their modules are imported later
    fits = wanted in classes if kind in CLASSES else callable(found)
    if kind == "commands":
        fits, wanted = is_dataclass(found) and hasattr(found, "run"), "dataclass with `run`"
    if found is not None and not fits:
        _warn(what, f"{where} is no {wanted}; see docs/extensions.md")
    return found if fits else None


def _loaded(what: str, point: EntryPoint) -> Any:
    """Import what an entry point names; None, with one warning, where that fails in whatever way."""
    try:
        return point.load()
    except Exception as error:  # noqa: BLE001  a stranger's code may raise anything
        _warn(what, f"{type(error).__name__}: {error}")
        return None


def _warn(what: str, why: str) -> None:
    log.warning("%s is left out: %s", what, printable_line(why, 300))

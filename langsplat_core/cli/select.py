"""`langsplat select`: a thing taken out of a scene, or the scene without it."""

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from langsplat_core.arrays import Array
from langsplat_core.cli.checks import OutFile
from langsplat_core.cli.query import Unit, chosen, instance_json, table, unit_of
from langsplat_core.config import Count, LevelChoice, NotNegative, Positive
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import check_writable, load_scene, save_scene
from langsplat_core.io.shapes import (
    MESH_SUFFIXES,
    POINT_SUFFIXES,
    base_colours,
    check_suffix,
    write_meshes,
    write_points,
)
from langsplat_core.query.compose import Combination, Combined, combine, run_phrase
from langsplat_core.query.engine import QueryEngine, no_field
from langsplat_core.query.instances import Instance, find_instances, hulls
from langsplat_core.query.selection import grow, of_rows, shrink, union
from langsplat_core.scene import Scene
from langsplat_core.semantics.encoders import load_text_encoder

Shape = Literal["scene", "points", "hull"]


@dataclass(frozen=True)
class Select:
    """Write what a phrase names as a scene of its own, with its language field and cameras, as points or as a
    mesh; or, with --remove, the scene without it. Prints the things that were found, best first."""

    scene: tyro.conf.Positional[Path]
    """A trained scene, *.ply with its language field beside it."""
    texts: tyro.conf.Positional[tuple[str, ...]]
    """Phrases, each in quotes if it has several words."""
    out: OutFile
    """File to write: .ply, .spz or .splat for a scene, .ply for points, .ply or .obj for hulls."""
    remove: bool = False
    """Write everything else instead."""
    combine: Combination = "union"
    """What several phrases make: what any of them names, what all name, or the first without the others."""
    level: LevelChoice = "auto"
    """Semantic level; auto takes for each phrase the one with the highest score."""
    instance: tuple[Count, ...] = ()
    """Numbers of the things to take, as printed, the best is 1; all if none is given."""
    grow: NotNegative = 0.0
    """Take also what is so near along the surface: metres if the scene has a scale, else world units."""
    shrink: NotNegative = 0.0
    """Leave out what is so near to the rest along the surface, in the same unit; after growing."""
    shape: Annotated[Shape, tyro.conf.arg(name="as")] = "scene"
    """scene: Gaussians. points: their centres, with colour and relevancy. hull: a closed mesh around each."""
    scale: Positive | None = None
    """Metres per world unit, in place of what the scene says."""
    encoder: str = ""
    """Text encoder folder or hub id, in place of the one the scene names."""
    json: bool = False
    """Print JSON, lengths in world units."""

    def run(self) -> None:
        self._check()
        scene = load_scene(self.scene)
        if scene.language is None:
            raise InputError(f"{self.scene}: {no_field(scene)}")
        unit = unit_of(scene, self.scale)
        engine = QueryEngine(scene, load_text_encoder, encoder_id=self.encoder)
        answer = combine([run_phrase(engine, text, self.level).answer for text in self.texts], self.combine)
        found = find_instances(engine.surface, scene.gaussians, answer.members, answer.relevancy)
        taken = chosen(found, self.instance)
        selected = self._reshaped(
            engine, union([of_rows(i.members, len(answer.members)) for i in taken]), unit
        )
        written = self._write(engine, scene, replace(answer, members=selected))
        self._print(found, scene, unit, int(selected.sum()), written)

    def _check(self) -> None:
        """What needs no scene to be known: it should not cost the loading of one."""
        if not self.texts:
            raise InputError(
                "no phrase given; for example: langsplat select scene.ply 'red cup' --out cup.ply"
            )
        if self.shape == "scene":
            check_writable(self.out)
        else:
            check_suffix(self.out, POINT_SUFFIXES if self.shape == "points" else MESH_SUFFIXES)
        if self.shape == "hull" and self.remove:
            raise InputError(
                "--as hull is the shape of things; what is left after --remove is written as points"
            )
        if self.out.resolve() == self.scene.resolve():
            raise InputError(f"{self.out}: would replace the original scene; choose another --out")
        folder = self.out.parent
        if not folder.is_dir():
            raise InputError(f"{folder}: no such folder for {self.out.name}; make it first")

    def _reshaped(self, engine: QueryEngine, selected: Array, unit: Unit) -> Array:
        if self.grow:
            selected = grow(engine.surface, selected, self.grow / unit.length)
        if self.shrink:
            selected = shrink(engine.surface, selected, self.shrink / unit.length)
        if not selected.any():
            raise InputError(f"--shrink {self.shrink:g}: nothing is left; shrink by less")
        if self.remove and selected.all():
            raise InputError("the selection is the whole scene: nothing would be left after --remove")
        return selected

    def _write(self, engine: QueryEngine, scene: Scene, answer: Combined) -> int:
        """How many Gaussians, points or meshes."""
        rows = np.flatnonzero(~answer.members if self.remove else answer.members)
        if self.shape == "points":
            return write_points(self.out, scene.gaussians.take(rows), {"relevancy": answer.relevancy[rows]})
        if self.shape == "hull":
            things = find_instances(engine.surface, scene.gaussians, answer.members, answer.relevancy)
            meshes = hulls(things, scene.gaussians, base_colours(scene.gaussians), " ".join(self.texts))
            write_meshes(self.out, meshes)
            return len(meshes)
        save_scene(self.out, replace(scene.take(rows), path=self.out))
        return len(rows)

    def _print(
        self, found: Sequence[Instance], scene: Scene, unit: Unit, selected: int, written: int
    ) -> None:
        if self.json:
            content = {
                "phrases": list(self.texts),
                "combine": self.combine,
                "metres_per_unit": unit.length if unit.name == "m" else None,
                "instances": [instance_json(instance, k) for k, instance in enumerate(found, 1)],
                "taken": list(self.instance) or list(range(1, len(found) + 1)),
                "selected": selected,
                "as": self.shape,
                "removed": self.remove,
                "written": written,
                "out": str(self.out),
            }
            json.dump(content, sys.stdout, indent=1)
            print()
            return
        print("\n".join(table(found, unit)))
        what = {"scene": "Gaussians", "points": "points", "hull": "closed hulls"}[self.shape]
        of = f"all but the {selected} selected" if self.remove else f"of {selected} selected Gaussians"
        print(f"{self.out}: {written} {what}, {of}")

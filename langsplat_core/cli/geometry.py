"""`langsplat mesh`, `register` and `merge`: surfaces as triangles, and two scenes of one place."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from langsplat_core.cli.query import found_answer, unit_of
from langsplat_core.cli.run import OutFile
from langsplat_core.cli.teach import searchable
from langsplat_core.config import Count, LevelChoice, Positive
from langsplat_core.errors import InputError, optional_imports
from langsplat_core.geometry.merge import merge
from langsplat_core.io.cameras import numbers
from langsplat_core.io.files import write_json
from langsplat_core.io.hostile import read_json_file
from langsplat_core.io.scenes import check_keeps, check_writable, load_scene, save_scene
from langsplat_core.io.shapes import MESH_SUFFIXES, check_suffix, gltf_axes, write_meshes
from langsplat_core.progress import Progress, TerminalProgress
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import Scene
from langsplat_core.scene.transform import Similarity, similarity, transform_scene
from langsplat_core.semantics.encoders import load_text_encoder

if TYPE_CHECKING:
    from langsplat_core.geometry.registration import Registration

TRANSFORM_LIMIT = 1 << 20  # bytes of a file with a matrix


@dataclass(frozen=True)
class Mesh:
    """Write the surface of a scene, or of what a phrase names, as triangles with colours. They are fused from
    images rendered by the scene's cameras, or from around it, so that what no camera sees has none."""

    scene: tyro.conf.Positional[Path]
    """Any readable scene."""
    out: tyro.conf.Positional[OutFile]
    """File to write: .ply or .obj in world units, .glb in metres with y up."""
    phrase: str = ""
    """Of everything that this names alone; the scene then needs its language field."""
    level: LevelChoice = "auto"
    """Semantic level of the phrase."""
    resolution: Positive | None = None
    """Side of a voxel, in metres if the scene has a scale, else world units; by default 1/100 of the radius,
    but no less than 1.5 pixels of the images."""
    views: Count = 2
    """Images that must agree on a surface: more leave holes, and what is left is nearer to the truth."""
    watertight: bool = False
    """Close all holes (Poisson), and say how much of the surface is made up so."""
    encoder: str = ""
    """Text encoder folder or hub id, in place of the one the scene names."""

    @optional_imports()
    def run(self) -> None:
        from langsplat_core.geometry.mesh import close_holes, fuse

        check_suffix(self.out, MESH_SUFFIXES)
        check_keeps(self.out, self.scene)
        scene = searchable(self.scene) if self.phrase else load_scene(self.scene)
        unit = unit_of(scene)
        if self.phrase:
            engine = QueryEngine(scene, load_text_encoder, encoder_id=self.encoder)
            scene = scene.take(found_answer(engine, self.phrase, self.level).members)
        finest = None if self.resolution is None else self.resolution / unit.length
        with TerminalProgress() as progress:
            mesh, side = fuse(scene, finest, self.views, progress=progress)
            holes, made = mesh.holes(), ""
            if self.watertight:
                mesh, area = close_holes(mesh, side)
                share = 100 * area / max(float(mesh.areas().sum()), 1e-300)
                left = "" if mesh.holes() == 0 else f", {mesh.holes()} left at the border of the scene"
                made = f" closed{left}; made up: {area * unit.length**2:.3g} {unit.name}^2 ({share:.0f} %)"
            mesh = replace(mesh, name=self.phrase or self.scene.stem)
            write_meshes(self.out, [mesh], gltf_axes(scene))
        print(
            f"{self.out}: {len(mesh.triangles)} triangles, {len(mesh.vertices)} vertices, voxels of "
            f"{side * unit.length:.3g} {unit.name}; {holes} holes{made}"
        )


@dataclass(frozen=True)
class Register:
    """Find how a scene lies in the axes of another one of the same place. The exit code is 2 where their
    surfaces do not agree."""

    moving: tyro.conf.Positional[Path]
    """The scene that would be moved."""
    fixed: tyro.conf.Positional[Path]
    """The scene that stays."""
    out: OutFile | None = None
    """File for the matrix, .json, as `langsplat merge --transform` reads it."""
    scaled: bool = False
    """Units may differ in length; else they are the same, up to what both scenes say of metres."""

    @optional_imports()
    def run(self) -> None:
        with TerminalProgress() as progress:
            found = registered(load_scene(self.moving), load_scene(self.fixed), self.scaled, progress)
        if self.out is not None:
            write_json(self.out, {"matrix": found.transform.tolist()})
        rows = "; ".join(" ".join(f"{number:.9g}" for number in row) for row in found.transform)
        print(
            f"{100 * found.agreement:.0f} % of the surfaces agree, {found.rmse:.3g} units apart; scale "
            f"{found.scale:.4g}; matrix {rows}"
        )


@dataclass(frozen=True)
class Merge:
    """Write two scenes as one: Gaussians, cameras, language field, tree and taught words of both. The second
    is first laid onto the first, as `langsplat register` finds it, or as told."""

    first: tyro.conf.Positional[Path]
    """A scene; what is said of a whole scene is as here."""
    second: tyro.conf.Positional[Path]
    """The scene that is added, and moved for that."""
    out: OutFile
    """Scene to write: .ply, .spz or .splat."""
    transform: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """How the second lies in the axes of the first: .json of `langsplat register`, instead of a search."""
    as_is: bool = False
    """Both are in the same axes already: nothing is moved."""
    scaled: bool = False
    """As of `langsplat register`."""

    @optional_imports()
    def run(self) -> None:
        check_writable(self.out)
        check_keeps(self.out, self.first, self.second)
        if self.as_is and self.transform is not None:
            raise InputError("--as-is moves nothing, --transform does; give one of them")
        first, second = load_scene(self.first), load_scene(self.second)
        said = "as they were"
        if self.transform is not None:
            second, said = transform_scene(second, read_transform(self.transform)), "as told"
        elif not self.as_is:
            with TerminalProgress() as progress:
                found = registered(second, first, self.scaled, progress)
            second = transform_scene(second, similarity(found.transform))
            said = f"registered, {100 * found.agreement:.0f} % of the surfaces agree"
        scene = merge(first, second)
        save_scene(self.out, replace(scene, path=self.out))
        print(f"{self.out}: {len(scene.gaussians)} Gaussians, {len(scene.cameras)} cameras; {said}")


def registered(moving: Scene, fixed: Scene, scaled: bool, progress: Progress) -> "Registration":
    """How a scene lies in the axes of another; InputError unless renderings confirm it."""
    from langsplat_core.geometry.registration import TRUSTED, register

    found = register(moving, fixed, scaled, progress=progress)
    if not found.trusted:
        hint = "" if scaled else ", and give --scaled where their units differ"
        raise InputError(
            f"the scenes do not show one place as far as can be told: {100 * found.agreement:.0f} % of the "
            f"surfaces agree where both are seen, of {100 * TRUSTED:.0f} % at least; see that they "
            f"overlap{hint}"
        )
    return found


def read_transform(path: Path) -> Similarity:
    """The similarity in a file of `langsplat register`; InputError and FormatError name the file."""
    entry = read_json_file(path, TRANSFORM_LIMIT)
    matrix = numbers(entry if isinstance(entry, dict) else {}, "matrix", (4, 4), str(path))
    try:
        return similarity(matrix)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None

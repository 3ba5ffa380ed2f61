"""OpenUSD stages of Gaussians: a prim `ParticleField3DGaussianSplat` (OpenUSD 26.03), written by usd-core.

Beside it, under /Scene/Things, is a prim for each thing of the scene's outline and its parts: in its middle,
with its box (`extentsHint`) and labels (`SemanticsLabelsAPI:class`).

Stages are not read: usd-core's native reader gives way where a file is damaged.
Source: https://openusd.org/release/api/class_usd_vol_particle_field3_d_gaussian_splat.html
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from langsplat_core.arrays import Array
from langsplat_core.cli.arguments import AnyScene
from langsplat_core.errors import EncoderError, InputError, optional_imports
from langsplat_core.io.files import atomic_path, check_output_file
from langsplat_core.io.gltf import COEFFICIENTS, attributes_of, node_of
from langsplat_core.io.gltf import EXTENSION as KHR
from langsplat_core.io.scenes import load_scene, report_left_out
from langsplat_core.query.describe import OR, Describer
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.instances import axis_aligned_box
from langsplat_core.query.inventory import Outline, scene_outline
from langsplat_core.scene import LEVELS, Scene
from langsplat_core.semantics.encoders import load_text_encoder

SUFFIXES = (".usd", ".usda", ".usdc")
THINGS = "/Scene/Things"
LOSES = ("precision", "extra properties", "antialiasing", "cameras", "taught words")


@dataclass(frozen=True)
class Usd:
    """Write a scene as an OpenUSD stage, for Omniverse, Isaac Sim, Houdini and others that show Gaussians.

    y is up, and a unit is a metre where the scale is known. Things and their parts are prims with boxes and
    labels, and numbers of each Gaussian, -1 for none (primvars whole, part, subpart). Stages are not read.
    """

    scene: AnyScene
    out: tyro.conf.Positional[Path]
    """Stage to write: *.usdc and *.usd are binary, *.usda is text."""

    def run(self) -> None:
        if self.out.suffix.lower() not in SUFFIXES:
            raise InputError(f"{self.out}: stages are written as {', '.join(SUFFIXES)}; choose such a name")
        check_output_file(self.out)
        scene = load_scene(self.scene)
        report_left_out(self.out, scene, "stages", LOSES, self.scene.name)
        things = write_usd(self.out, scene)
        print(f"{self.out}: {len(scene.gaussians):,} Gaussians, {things} things with their parts")


@optional_imports()
def write_usd(path: Path, scene: Scene) -> int:
    """Write a stage, atomically, and return how many things it names.

    Rows keep their order, and numbers are as in a .glb: a transform stands the Gaussians upright, and a row
    that cannot be drawn has opacity 0. Without an encoder things are numbers alone, which is said.
    """
    from pxr import Gf, Kind, Sdf, Usd, UsdGeom, Vt

    stage, columns = Usd.Stage.CreateInMemory(), attributes_of(scene.gaussians)
    things: tuple[Outline, ...] = ()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/Scene").GetPrim()
    Usd.ModelAPI(root).SetKind(Kind.Tokens.assembly)
    stage.SetDefaultPrim(root)
    prim = stage.DefinePrim("/Scene/Gaussians", "ParticleField3DGaussianSplat")
    vectors, means = Vt.Vec3fArray.FromNumpy, columns["POSITION"]
    harmonics = np.stack([columns[name] for name in COEFFICIENTS if name in columns], 1)
    values: dict[str, Any] = {
        "positions": vectors(means),
        "scales": vectors(columns[f"{KHR}:SCALE"]),
        "orientations": Vt.QuatfArray.FromNumpy(columns[f"{KHR}:ROTATION"]),
        "opacities": Vt.FloatArray.FromNumpy(columns[f"{KHR}:OPACITY"]),
        "radiance:sphericalHarmonicsDegree": scene.gaussians.sh_degree,
        "extent": vectors(np.stack([means.min(0, initial=0), means.max(0, initial=0)])),
    }
    for name, value in values.items():
        prim.GetAttribute(name).Set(value)
    colours = prim.GetAttribute("radiance:sphericalHarmonicsCoefficients")
    colours.Set(vectors(harmonics.reshape(-1, 3)))
    colours.SetMetadata("elementSize", harmonics.shape[1])
    matrix = np.reshape(node_of(scene).get("matrix", np.eye(4)), (4, 4))  # of rows
    UsdGeom.Xformable(prim).AddTransformOp().Set(Gf.Matrix4d(matrix.tolist()))
    if scene.language is not None and (tree := scene.language.tree) is not None:
        for level, name in enumerate(LEVELS):
            numbers = Vt.IntArray.FromNumpy(tree.at(level).astype(np.int32))
            primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, Sdf.ValueTypeNames.IntArray)
            primvar.SetInterpolation(UsdGeom.Tokens.vertex)
            primvar.Set(numbers)
        try:
            things = scene_outline(Describer(QueryEngine(scene, load_text_encoder)))
        except EncoderError as error:
            print(f"things are numbers without labels: {error}")
        Usd.ModelAPI(UsdGeom.Scope.Define(stage, THINGS)).SetKind(Kind.Tokens.group)
        places, members = means @ matrix[:3, :3] + matrix[3, :3], tree.gaussians()
        for thing in things:
            _add(stage, THINGS, np.zeros(3), thing, lambda node: places[members[node]])
    with atomic_path(path) as temporary:
        if not stage.GetRootLayer().Export(str(temporary)):
            raise OSError(f"{path}: could not be written")
    return len(things)


def _add(stage: Any, above: str, middle: Array, thing: Outline, points_of: Callable[[int], Array]) -> None:
    """Add the prim of a thing below another, whose `middle` (3,) is known, and its parts below that."""
    from pxr import Gf, Kind, Tf, Usd, UsdGeom, UsdSemantics, Vt

    words = [] if thing.word is None else thing.word.phrase.split(OR)
    name = Tf.MakeValidIdentifier("_".join([*words[:1], LEVELS[thing.level], str(thing.node)]))
    box = axis_aligned_box(points_of(thing.node))
    prim = UsdGeom.Xform.Define(stage, f"{above}/{name}").GetPrim()
    UsdGeom.Xformable(prim).AddTranslateOp().Set(Gf.Vec3d((box.mean(0) - middle).tolist()))
    UsdGeom.ModelAPI.Apply(prim).SetExtentsHint(Vt.Vec3fArray.FromNumpy((box - box.mean(0)).astype("f4")))
    Usd.ModelAPI(prim).SetKind(Kind.Tokens.component if above == THINGS else Kind.Tokens.subcomponent)
    prim.SetCustomDataByKey("node", thing.node)  # as in the primvars
    if thing.word is not None:
        UsdSemantics.LabelsAPI.Apply(prim, "class").CreateLabelsAttr(words)
        prim.SetCustomDataByKey("probability", thing.word.probability)
    for part in thing.parts:
        _add(stage, f"{above}/{name}", box.mean(0), part, points_of)

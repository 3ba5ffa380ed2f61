"""OpenUSD stages of Gaussians: a prim `ParticleField3DGaussianSplat` (OpenUSD 26.03), written by usd-core.

Stages are not read: usd-core's native reader follows paths in a stranger's file, and gives way where it is
damaged. Source: https://openusd.org/release/api/class_usd_vol_particle_field3_d_gaussian_splat.html
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from langsplat_core.cli.arguments import AnyScene
from langsplat_core.errors import InputError, optional_imports
from langsplat_core.io.files import atomic_path, check_output_file
from langsplat_core.io.gltf import COEFFICIENTS, attributes_of, node_of
from langsplat_core.io.gltf import EXTENSION as KHR
from langsplat_core.io.scenes import load_scene, report_left_out
from langsplat_core.scene import LEVELS, Scene

SUFFIXES = (".usd", ".usda", ".usdc")
LOSES = ("precision", "extra properties", "antialiasing", "cameras", "taught words")


@dataclass(frozen=True)
class Usd:
    """Write a scene as an OpenUSD stage, for Omniverse, Isaac Sim, Houdini and others that show Gaussians.

    y is up, and a unit is a metre where the scale is known. Whole things, their parts and subparts are
    numbers of each Gaussian, -1 for none (primvars whole, part and subpart). Stages are not read.
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
        write_usd(self.out, scene)
        held = "and the numbers of its things" if scene.language and scene.language.tree else "no things"
        print(f"{self.out}: {len(scene.gaussians):,} Gaussians, {held}")


@optional_imports()
def write_usd(path: Path, scene: Scene) -> None:
    """Write a stage with one prim, atomically; rows keep their order, and numbers are as in a .glb.

    A prim's transform stands the scene upright; a row that cannot be drawn has opacity 0.
    """
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    stage, columns = Usd.Stage.CreateInMemory(), attributes_of(scene.gaussians)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    prim = stage.DefinePrim("/Scene", "ParticleField3DGaussianSplat")
    stage.SetDefaultPrim(prim)
    vectors, means = Vt.Vec3fArray.FromNumpy, columns["POSITION"]
    harmonics = np.stack([columns[name] for name in COEFFICIENTS if name in columns], 1)
    values: dict[str, Any] = {
        "positions": vectors(means),
        "scales": vectors(columns[f"{KHR}:SCALE"]),
        "orientations": Vt.QuatfArray.FromNumpy(columns[f"{KHR}:ROTATION"]),
        "opacities": Vt.FloatArray.FromNumpy(columns[f"{KHR}:OPACITY"]),
        "radiance:sphericalHarmonicsDegree": scene.gaussians.sh_degree,
        "radiance:sphericalHarmonicsCoefficients": vectors(harmonics.reshape(-1, 3)),
        "extent": vectors(np.stack([means.min(0, initial=0), means.max(0, initial=0)])),
    }
    for name, value in values.items():
        prim.GetAttribute(name).Set(value)
    if scene.language is not None and scene.language.tree is not None:
        for level, name in enumerate(LEVELS):
            numbers = Vt.IntArray.FromNumpy(scene.language.tree.at(level).astype(np.int32))
            primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, Sdf.ValueTypeNames.IntArray)
            primvar.SetInterpolation(UsdGeom.Tokens.vertex)
            primvar.Set(numbers)
    if matrix := node_of(scene).get("matrix"):
        UsdGeom.Xformable(prim).AddTransformOp().Set(Gf.Matrix4d(np.reshape(matrix, (4, 4)).tolist()))
    with atomic_path(path) as temporary:
        if not stage.GetRootLayer().Export(str(temporary)):
            raise OSError(f"{path}: could not be written")

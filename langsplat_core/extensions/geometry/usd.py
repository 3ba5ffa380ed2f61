"""OpenUSD stages of Gaussians: prims `ParticleField3DGaussianSplat` (OpenUSD 26.03), by usd-core.

A written stage has /Scene/Gaussians, upright and in metres if the scale is known, with the node of each
Gaussian at each level (primvars), and under /Scene/Things a prim for each node of the scene's outline: at its
centre, with its box (`extentsHint`) and labels (`SemanticsLabelsAPI:class`).

Only the file's own layer is read: files that it refers to are not opened, but reported. usd-core's native
reader may crash on a damaged file, so it runs in a process of its own, with bounds on time and memory.
Source: https://openusd.org/release/api/class_usd_vol_particle_field3_d_gaussian_splat.html
"""

import json
import logging
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from langsplat_core import errors
from langsplat_core.arrays import Array, logit
from langsplat_core.io import apart, hostile
from langsplat_core.io.files import TEMPORARY, atomic_path
from langsplat_core.io.gltf import COEFFICIENTS, OWN, Kept, attributes_of, node_of, placed_scene
from langsplat_core.io.gltf import EXTENSION as KHR
from langsplat_core.io.scenes import SceneFormat, companion_path
from langsplat_core.io.sidecar import SUFFIX
from langsplat_core.progress import Progress, silent
from langsplat_core.scene import LEVELS, SH_COUNTS, Gaussians, Scene

if TYPE_CHECKING:
    from langsplat_core.query.inventory import Outline

log = logging.getLogger("langsplat")
TYPE = "ParticleField3DGaussianSplat"
HARMONICS = "radiance:sphericalHarmonics"
DEGREE = f"{HARMONICS}Degree"
COLUMNS = {"positions": 3, "scales": 3, "orientations": 4, "opacities": 1, f"{HARMONICS}Coefficients": 3}
# Types of prims and attributes that are read or irrelevant; OURS: those that a companion of our files has.
KNOWN = {TYPE, "Xform", "Scope", "", "extent", DEGREE, "projectionModeHint", "sortingModeHint"}
KNOWN |= {*COLUMNS, *(f"{name}h" for name in COLUMNS)}
OURS = {*(f"primvars:{name}" for name in LEVELS), "semantics:labels:class", "extentsHint"}
Z_TO_Y = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
MEMORY, SECONDS = 3 << 30, 60  # for reading, plus 100 bytes and a microsecond per byte of the file
ALONE = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


@errors.optional_imports()
def write_usd(path: Path, scene: Scene) -> None:
    """Write a stage, atomically; rows keep their order, and numbers are as in a .glb.

    A row that cannot be drawn has opacity 0. Without an encoder nodes have no labels, which is reported.
    """
    from pxr import Gf, Kind, Sdf, Usd, UsdGeom, Vt

    from langsplat_core.query.describe import Describer
    from langsplat_core.query.engine import QueryEngine
    from langsplat_core.query.inventory import scene_outline
    from langsplat_core.semantics.encoders import load_text_encoder

    stage, columns, node = Usd.Stage.CreateInMemory(), attributes_of(scene.gaussians), node_of(scene)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, "/Scene").GetPrim()
    Usd.ModelAPI(root).SetKind(Kind.Tokens.assembly)
    stage.SetDefaultPrim(root)
    prim = stage.DefinePrim("/Scene/Gaussians", TYPE)
    prim.SetCustomDataByKey(OWN, json.dumps(node.get("extras", {OWN: {}})[OWN]))
    vectors, means = Vt.Vec3fArray.FromNumpy, columns["POSITION"]
    harmonics = np.stack([columns[name] for name in COEFFICIENTS if name in columns], 1)
    values: dict[str, Any] = {
        "positions": vectors(means),
        "scales": vectors(columns[f"{KHR}:SCALE"]),
        "orientations": Vt.QuatfArray.FromNumpy(columns[f"{KHR}:ROTATION"]),
        "opacities": Vt.FloatArray.FromNumpy(columns[f"{KHR}:OPACITY"]),
        DEGREE: scene.gaussians.sh_degree,
        f"{HARMONICS}Coefficients": vectors(harmonics.reshape(-1, 3)),
        "extent": vectors(np.stack([means.min(0, initial=0), means.max(0, initial=0)])),
    }
    for name, value in values.items():
        prim.GetAttribute(name).Set(value)
    prim.GetAttribute(f"{HARMONICS}Coefficients").SetMetadata("elementSize", harmonics.shape[1])
    matrix = np.reshape(node.get("matrix", np.eye(4)), (4, 4))  # of rows
    UsdGeom.Xformable(prim).AddTransformOp().Set(Gf.Matrix4d(matrix.tolist()))
    if scene.language is not None and (tree := scene.language.tree) is not None:
        for level, name in enumerate(LEVELS):
            numbers = Vt.IntArray.FromNumpy(tree.at(level).astype(np.int32))
            primvar = UsdGeom.PrimvarsAPI(prim).CreatePrimvar(name, Sdf.ValueTypeNames.IntArray)
            primvar.SetInterpolation(UsdGeom.Tokens.vertex)
            primvar.Set(numbers)
        Usd.ModelAPI(UsdGeom.Scope.Define(stage, "/Scene/Things")).SetKind(Kind.Tokens.group)
        points = means @ matrix[:3, :3] + matrix[3, :3], tree.gaussians()
        try:
            for thing in scene_outline(Describer(QueryEngine(scene, load_text_encoder))):
                _add(stage, "/Scene/Things", np.zeros(3), thing, points)
        except errors.LangSplatError as error:
            log.warning("%s: things are numbers without labels: %s", path.name, error)
    with atomic_path(path) as temporary:
        if not stage.GetRootLayer().Export(str(temporary)):
            raise OSError(f"{path}: could not be written")


def _add(stage: Any, above: str, middle: Array, thing: "Outline", points: tuple[Array, Any]) -> None:
    """Add a prim and those of its parts. middle: (3,) centre of `above`; points: (N, 3), and rows by node."""
    from pxr import Gf, Kind, Tf, Usd, UsdGeom, UsdSemantics, Vt

    from langsplat_core.query.describe import OR
    from langsplat_core.query.instances import axis_aligned_box

    words = [] if thing.word is None else thing.word.phrase.split(OR)
    name = Tf.MakeValidIdentifier("_".join([*words[:1], LEVELS[thing.level], str(thing.node)]))
    prim = UsdGeom.Xform.Define(stage, f"{above}/{name}").GetPrim()
    box = axis_aligned_box(points[0][points[1][thing.node]])
    UsdGeom.Xformable(prim).AddTranslateOp().Set(Gf.Vec3d((box.mean(0) - middle).tolist()))
    UsdGeom.ModelAPI.Apply(prim).SetExtentsHint(Vt.Vec3fArray.FromNumpy((box - box.mean(0)).astype("f4")))
    Usd.ModelAPI(prim).SetKind(Kind.Tokens.subcomponent if middle.any() else Kind.Tokens.component)
    prim.SetCustomDataByKey("node", thing.node)  # as in the primvars
    if thing.word is not None:
        UsdSemantics.LabelsAPI.Apply(prim, "class").CreateLabelsAttr(words)
        prim.SetCustomDataByKey("probability", thing.word.probability)
    for part in thing.parts:
        _add(stage, f"{above}/{name}", box.mean(0), part, points)


# Reading.


def read_usd(path: Path) -> Scene:
    """Return all Gaussians of a stage. InputError if it cannot be opened, else FormatError."""
    file, size = hostile.open_for_reading(path)
    file.close()
    try:
        found = apart.run(_read, path, size, progress=silent, environment=ALONE)
    except errors.LangSplatError:
        raise
    except Exception as error:  # noqa: BLE001  usd-core may raise anything, or its process end
        said = errors.printable_line(str(error).rpartition(" : ")[2], 120)
        raise errors.malformed(path, f"usd-core cannot read it ({said})") from None
    parts, kept, metres, told = found
    errors.report_losses(path, told)
    scene = placed_scene(path, parts)
    return replace(scene, metres_per_unit=metres) if kept is None else kept.given(scene)


@errors.optional_imports()
def _read(
    path: Path, size: int, progress: Progress
) -> tuple[list[Any], Kept | None, float | None, list[str]]:
    """Return the parts for `placed_scene`, properties kept by this program, metres per unit, and losses."""
    from pxr import Sdf, Work

    Work.SetConcurrencyLimit(1)  # threads count against the bound on memory
    with suppress(ImportError, ValueError):  # other systems have no such bounds, or lower ones
        import resource

        seconds = SECONDS + size // 1_000_000
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 1))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY + 100 * size,) * 2)
    layer = Sdf.Layer.OpenAsAnonymous(str(path.resolve()))
    prims, names, told, waiting = [], set[str](), list[str](), [*layer.rootPrims][::-1]
    while waiting:
        prim = waiting.pop()
        if prim.specifier != Sdf.SpecifierDef or not prim.active or prim.typeName == "PointInstancer":
            names.add(f"{prim.path}")  # prims that are not shown, or shown many times
            continue
        waiting += [*prim.nameChildren][::-1]
        names.update([prim.typeName, *prim.attributes.keys(), *prim.variantSets.keys()])
        prims += [prim] if prim.typeName == TYPE else []
    if not prims:
        raise errors.malformed(path, f"holds no {TYPE}", "meshes are not read, nor files that it refers to")
    room = hostile.Allowance(path, size, hostile.SMALL_RATIO)
    parts = [(_place(layer, prim, told), _gaussians(layer, prim, path, room, told)) for prim in prims]
    kept = None
    with suppress(msgspec.MsgspecError, LookupError, TypeError):  # custom data may be anything
        kept = msgspec.json.decode(prims[0].customData[OWN], type=Kept)
        place = parts[0][0].T.ravel().tolist()
        kept = kept if len(parts) == 1 and (kept.matrix or np.eye(4).ravel().tolist()) == place else None
    if kept is not None:
        parts, beside = [(np.eye(4), parts[0][1])], companion_path(path, SUFFIX)
        if names & OURS and not beside.exists() and not path.name.startswith(TEMPORARY):
            told.append(f"language features and labels are in {beside.name}, which is not beside it")
        names -= OURS
    top = layer.pseudoRoot
    metres = float(top.GetInfo("metersPerUnit")) if top.HasInfo("metersPerUnit") else 0
    others = sorted(errors.quoted(name) for name in names - KNOWN if not name.startswith("xformOp"))
    outside = map(errors.quoted, layer.GetCompositionAssetDependencies())
    told += [errors.unread("", others), errors.unread("what it refers to,", outside)]
    return parts, kept, metres if 0 < metres < 1e12 else None, told


def _gaussians(layer: Any, prim: Any, path: Path, room: hostile.Allowance, told: list[str]) -> Gaussians:
    """Return the Gaussians of a prim; attributes of half floats replace missing ones of floats."""
    columns = []
    for name, width in COLUMNS.items():
        held = next((prim.attributes[own] for own in (name, f"{name}h") if own in prim.attributes), None)
        values = None if held is None else held.default
        if held is not None and values is None and (times := layer.ListTimeSamplesForPath(held.path)):
            values = layer.QueryTimeSample(held.path, times[0])
            told.append(f"the first of {len(times)} moments of {name} is taken")
        if values is None:
            raise errors.malformed(path, f"{prim.path} has no {name}")
        room.take(4 * width * len(values))
        columns.append(np.asarray(values, np.float32).reshape(-1, width))
    positions, scales, orientations, opacities, harmonics = columns
    degree = prim.attributes[DEGREE].default if DEGREE in prim.attributes else 3
    rows, count = [len(column) for column in columns], len(positions)
    if rows != [*[count] * 4, count * SH_COUNTS.get(degree, -1)]:
        raise errors.malformed(
            path, f"{prim.path}: arrays of {', '.join(map(str, rows))} rows do not fit degree {degree}"
        )
    logits = logit(opacities[:, 0].astype(np.float64))
    with np.errstate(all="ignore"):  # invalid rows are not drawn
        log_scales = np.log(scales)
    sh = harmonics.reshape(count, SH_COUNTS[degree], 3)
    return Gaussians(positions, log_scales, orientations[:, [3, 0, 1, 2]], logits, sh)


def _place(layer: Any, prim: Any, told: list[str]) -> Array:
    """Return the (4, 4) matrix from a prim's axes to the world's, with y up, as usd-core computes it.

    Only the transform operations of the prims are copied into a new stage.
    """
    from pxr import Sdf, Usd, UsdGeom

    alone = Usd.Stage.CreateInMemory()
    for above in prim.path.GetPrefixes():
        own = UsdGeom.Xform.Define(alone, above)
        for attribute in layer.GetPrimAtPath(above).attributes:
            if attribute.name.startswith("xformOp"):
                if len(times := layer.ListTimeSamplesForPath(attribute.path)) > 1:
                    told.append(f"the first of {len(times)} moments of {attribute.name} is taken")
                Sdf.CopySpec(layer, attribute.path, alone.GetRootLayer(), attribute.path)
    matrix = np.array(own.ComputeLocalToWorldTransform(Usd.TimeCode.EarliestTime())).T
    return Z_TO_Y @ matrix if layer.pseudoRoot.GetInfo("upAxis") == "Z" else matrix


LOSES = ("precision", "extra properties")
USDA, USDC, USD, USDZ = (
    SceneFormat(suffix, read_usd, write, LOSES if write else (), own_companions=True, mime="model/vnd.usd")
    for suffix, write in ((".usda", write_usd), (".usdc", write_usd), (".usd", None), (".usdz", None))
)

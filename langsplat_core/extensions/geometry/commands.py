"""`langsplat mesh`, `register`, `merge` and `map`: meshes, two scenes of one place, and maps for robots."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from PIL import Image
from scipy.spatial import cKDTree

from langsplat_core.arrays import Array
from langsplat_core.cli.arguments import AnyScene, EncoderOption, Needs, OutFile, OutFolder
from langsplat_core.cli.query import Unit, found_answer
from langsplat_core.config import Coordinate, Count, LevelChoice, Positive
from langsplat_core.errors import EncoderError, InputError, malformed, optional_imports, printable_line
from langsplat_core.extensions.geometry import occupancy
from langsplat_core.extensions.geometry.mesh import check_suffix, close_holes, fuse, write_mesh
from langsplat_core.extensions.geometry.registration import TRUSTED, Registration, merge, once, register
from langsplat_core.io.files import atomic_path, write_json, write_whole
from langsplat_core.io.hostile import read_json_file
from langsplat_core.io.scenes import check_keeps, check_writable, load_scene, save_scene
from langsplat_core.progress import Progress, TerminalProgress
from langsplat_core.query.compose import check_phrase, run_phrase
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import QueryEngine, searchable
from langsplat_core.query.inventory import scene_outline
from langsplat_core.scene import LEVELS, NO_NODE, Scene
from langsplat_core.scene.surface import surface_weights
from langsplat_core.scene.transform import (
    Similarity,
    between_worlds,
    moving,
    place_scene,
    similarity,
    transform_scene,
)
from langsplat_core.semantics.encoders import load_text_encoder

TRANSFORM_LIMIT = 1 << 20  # bytes of a file with a matrix


@dataclass(frozen=True)
class WriteMesh:
    """Write the surface of a scene, or of what a phrase names, as triangles with colours.

    It is fused from images rendered by the scene's cameras, or by cameras around it, so surfaces that no
    camera sees are missing.
    """

    scene: AnyScene
    out: tyro.conf.Positional[OutFile]
    """File to write: .ply in world units, .glb in metres with y up; or --out OUT, -o OUT."""
    phrase: str = ""
    """Write only what this names; the scene then needs a language field."""
    level: Annotated[LevelChoice, Needs("phrase")] = "auto"
    """Semantic level of the phrase."""
    resolution: Positive | None = None
    """Side of a voxel, in metres if the scene has a scale, else world units; by default 1/100 of the radius,
    but no less than 1.5 pixels of the images."""
    views: Count = 2
    """Images that must agree on a surface: more leave more holes and fewer errors."""
    watertight: bool = False
    """Close all holes (Poisson), and report how much of the surface is made up."""
    encoder: Annotated[EncoderOption, Needs("phrase")] = ""

    @optional_imports()
    def run(self) -> None:
        check_suffix(self.out)
        check_keeps(self.out, self.scene)
        scene = searchable(self.scene) if self.phrase else load_scene(self.scene)
        unit = Unit(scene.metres_per_unit, scene.origin)
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
                made = f" closed; made up: {area * unit.length**2:.3g} {unit.name}^2 ({share:.0f} %)"
                if hollows := mesh.hollows():
                    made += f"; hollow pieces, surrounded by what is solid, as rooms by walls: {hollows}"
            write_mesh(self.out, mesh, scene, self.phrase or self.scene.stem)
        print(
            f"{self.out}: {len(mesh.triangles)} triangles, {len(mesh.vertices)} vertices, voxels of "
            f"{side * unit.length:.3g} {unit.name}; {holes} hole{'s' * (holes != 1)}{made}"
        )


@dataclass(frozen=True)
class Register:
    """Find the transform from a scene to another one of the same place.

    The exit code is 2 if their surfaces do not agree.
    """

    moving: tyro.conf.Positional[Path]
    """The scene that is transformed."""
    fixed: tyro.conf.Positional[Path]
    """The scene in whose axes it is placed."""
    out: OutFile | None = None
    """File for the matrix, .json, for `langsplat merge --transform`."""
    scaled: bool = False
    """Units may differ in length; else they are equal, or as metres per unit of both scenes say."""

    @optional_imports()
    def run(self) -> None:
        scene, fixed = load_scene(self.moving), load_scene(self.fixed)
        with TerminalProgress() as progress:
            found = registered(scene, fixed, self.scaled, progress)
        matrix = between_worlds(found.transform, scene.origin, fixed.origin).matrix
        if self.out is not None:
            write_json(self.out, {"matrix": matrix.tolist()})
        rows = "  ".join(" ".join(f"{number:.15g}" for number in row) for row in matrix)
        print(
            f"{100 * found.agreement:.0f} % of the surfaces agree, {found.rmse:.3g} units apart; scale "
            f"{found.transform.scale:.4g}; --matrix {rows}"
        )


@dataclass(frozen=True)
class Merge:
    """Write two scenes as one: Gaussians, cameras, language field, tree and taught words of both.

    The second is first transformed to the axes of the first, as `langsplat register` does, or as given.
    Instances that both show are kept once, from the scene that shows them in more photographs.
    """

    first: tyro.conf.Positional[Path]
    """A scene, whose axes and settings the merged one has."""
    second: tyro.conf.Positional[Path]
    """The scene that is transformed and added."""
    out: OutFile
    """Scene to write: .ply, .spz, .sog, .glb, .gltf, .usdc, .usda or .splat."""
    transform: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Transform of the second to the axes of the first, .json of `langsplat register`; default: a search."""
    as_is: bool = False
    """Both scenes have the same axes already."""
    scaled: bool = False
    """As for `langsplat register`."""
    keep_both: bool = False
    """Keep instances that both show twice."""

    @optional_imports()
    def run(self) -> None:
        check_writable(self.out, self.first, self.second)
        if self.as_is + self.scaled + (self.transform is not None) > 1:
            raise InputError("--as-is, --transform and --scaled are three ways to place it; give one of them")
        first, second = load_scene(self.first), load_scene(self.second)
        said = "as they were"
        if self.transform is not None:
            second, said = place_scene(second, read_transform(self.transform), first.origin), "as told"
        elif not self.as_is:
            with TerminalProgress() as progress:
                found = registered(second, first, self.scaled, progress)
            second = replace(transform_scene(second, found.transform), origin=first.origin)
            said = f"registered, {100 * found.agreement:.0f} % of the surfaces agree"
        scene = merge(first, second)
        if not self.keep_both:
            scene, things = once(scene, first)
            said += f"; {things} things that both show are kept once (--keep-both: twice)" if things else ""
        save_scene(self.out, replace(scene, path=self.out))
        print(f"{self.out}: {len(scene.gaussians)} Gaussians, {len(scene.cameras)} cameras; {said}")


def registered(moving: Scene, fixed: Scene, scaled: bool, progress: Progress) -> Registration:
    """Return the registration of a scene with another; InputError unless it is trusted."""
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
    """Return the similarity in a file of `langsplat register`; InputError and FormatError name the file."""
    entry = read_json_file(path, TRANSFORM_LIMIT)
    try:
        return similarity(entry["matrix"])
    except (InputError, LookupError, OverflowError, TypeError, ValueError) as error:
        raise malformed(path, f"no transform ({printable_line(error, 100)})") from None


# `langsplat map`.

OCCUPIED, FREE, UNKNOWN = 0, 254, 205  # grey values of ROS' map_server
THRESHOLDS = {"occupied_thresh": 0.65, "free_thresh": 0.196}
NO_SCALE = (
    "nobody said how long a unit of this scene is, and a map is in metres: measure something and give "
    "`langsplat scale`, or say --metres-per-unit (1 where its units are metres)"
)


@dataclass(frozen=True)
class Map:
    """Write maps of a scene for robots, with labelled voxels and poses.

    The files are an occupancy grid for Nav2 (map.pgm, map.yaml), labelled voxels (voxels.npz), a collider
    (collider.obj), and poses in front of things (goals.json).
    """

    scene: tyro.conf.Positional[Path]
    """A trained scene with its cameras; labels of voxels and goals need a language field."""
    out: tyro.conf.Positional[OutFolder]
    """Folder to write; or --out OUT, -o OUT."""
    resolution: Positive = 0.05
    """Side of a cell, metres."""
    goal: tuple[str, ...] = ()
    """Phrases, for each of which a free, reachable pose in front of it is found. The exit code is 2 if one
    has none; everything else is written."""
    robot_height: Positive = 0.5
    """Metres above which nothing is an obstacle."""
    robot_radius: Annotated[Positive, Needs("goal")] = 0.2
    """Least distance of its centre from obstacles, metres."""
    step: Positive = 0.12
    """Metres below which nothing is an obstacle; above the floor's roughness."""
    start: Annotated[tuple[Coordinate, Coordinate] | None, tyro.conf.arg(metavar="X Y"), Needs("goal")] = None
    """Position of the robot, metres on the map; by default anywhere in the largest connected free region."""
    metres_per_unit: Positive | None = None
    """In place of the scene's own."""
    encoder: EncoderOption = ""

    @optional_imports()
    def run(self) -> None:
        scene = searchable(self.scene) if self.goal else load_scene(self.scene)
        metres = self.metres_per_unit or scene.metres_per_unit
        if metres is None:
            raise InputError(f"{self.scene}: {NO_SCALE}")
        engine = None
        if scene.language is not None:
            engine = QueryEngine(scene, load_text_encoder, encoder_id=self.encoder)
            for phrase in self.goal:
                check_phrase(engine, phrase, scene.cameras[0] if scene.cameras else None)
        with TerminalProgress() as progress:
            room = occupancy.find_room(scene)
            axes = occupancy.map_axes(room, metres, scene.origin)
            voxels = occupancy.find_occupancy(scene, axes, self.resolution, progress)
            plan = occupancy.floor_map(voxels, self.step, self.robot_height)
            self.out.mkdir(parents=True, exist_ok=True)
            write_voxels(self.out / "voxels.npz", voxels, scene, engine, progress)
            write_collider(self.out / "collider.obj", voxels)
            write_grid(self.out, plan)  # the last: where it is the others are
        floor = "" if room.has_floor else " (no floor was found: the ground is nearly the lowest surface)"
        print(
            f"{self.out}: {plan.free.shape[0]} x {plan.free.shape[1]} cells of {self.resolution:g} m, "
            f"{100 * plan.free.mean():.0f} % free, {100 * plan.occupied.mean():.0f} % occupied, "
            f"{metres:g} m per unit{floor}"
        )
        if engine is not None and self.goal:
            self._write_goals(plan, voxels, engine)

    def _write_goals(
        self, plan: occupancy.FloorMap, voxels: occupancy.Occupancy, engine: QueryEngine
    ) -> None:
        answers, missing = [], []
        (self.out / "goals.json").unlink(missing_ok=True)
        where = occupancy.reachable(plan, self.robot_radius, self.start)
        scene = engine.scene
        solid = surface_weights(scene.gaussians) > 0
        for phrase in self.goal:
            result = run_phrase(engine, phrase, viewpoint=scene.cameras[0]).answer
            points = voxels.to_map.points(scene.gaussians.means[result.members & solid])
            goal = None
            if result.found and len(points):
                goal = occupancy.find_goal(plan, where, points[:, :2], self.robot_radius + self.resolution)
            if goal is None:
                missing.append(f"'{phrase}': {'no free pose' if result.found else result.verdict}")
                continue
            answers.append({"phrase": phrase, **asdict(goal), "probability": result.probability})
            pose = f"x {goal.x:.2f} y {goal.y:.2f} m, yaw {goal.yaw:.2f}"
            print(f"{phrase}: {pose}, {goal.distance:.2f} m from it")
        write_json(self.out / "goals.json", answers)
        if missing:
            raise InputError(f"no goal for {'; '.join(missing)}")


def write_grid(folder: Path, plan: occupancy.FloorMap) -> None:
    """Write `map.pgm`, whose first row has the largest y, and `map.yaml`."""
    grey = np.where(plan.occupied, OCCUPIED, np.where(plan.free, FREE, UNKNOWN)).astype(np.uint8)
    with atomic_path(folder / "map.pgm") as path:
        Image.fromarray(np.ascontiguousarray(grey.T[::-1])).save(path, "PPM")
    x, y = plan.origin
    lines = ["image: map.pgm", "mode: trinary", f"resolution: {plan.resolution}"]
    lines += [f"origin: [{x:.9g}, {y:.9g}, 0.0]", "negate: 0"]
    lines += [f"{name}: {value}" for name, value in THRESHOLDS.items()]
    write_whole(folder / "map.yaml", "\n".join(lines) + "\n")


def write_collider(path: Path, voxels: occupancy.Occupancy) -> None:
    """Write everything that is occupied as watertight triangles, a Wavefront OBJ in metres."""
    corners, triangles = occupancy.collider(voxels)
    with atomic_path(path) as temporary, temporary.open("w", encoding="ascii") as file:
        np.savetxt(file, corners, "v %.9g %.9g %.9g")
        np.savetxt(file, triangles + 1, "f %d %d %d")


def write_voxels(
    path: Path, voxels: occupancy.Occupancy, scene: Scene, engine: QueryEngine | None, progress: Progress
) -> None:
    """Write the occupied voxels, each with its whole of the tree and the word for it."""
    cells = np.argwhere(voxels.occupied)
    nodes, words = np.full(len(cells), NO_NODE), {}
    if engine is not None:
        nodes = _nodes(voxels, scene, engine, cells)
        try:
            outline = scene_outline(Describer(engine, None, progress))
        except EncoderError as error:  # goals may be in the phrasebook, but names need an encoder
            print(f"voxels have no words: {error}")
            outline = ()
        words = {int(one.node): "" if one.word is None else one.word.phrase for one in outline}
    names = np.array([words.get(int(node), "") for node in nodes], str)
    with atomic_path(path) as temporary:
        np.savez_compressed(
            temporary, cells=cells.astype(np.int32), nodes=nodes.astype(np.int32), words=names,
            origin=voxels.origin, resolution=voxels.resolution,
            to_map=moving(-scene.origin).then(voxels.to_map).matrix,
            hits=voxels.hits[tuple(cells.T)], passes=voxels.passes[tuple(cells.T)],
        )  # fmt: skip


def _nodes(voxels: occupancy.Occupancy, scene: Scene, engine: QueryEngine, cells: Array) -> Array:
    """Return the (V,) whole of the Gaussian nearest to each voxel, NO_NODE far from any."""
    whole = engine.tree.at(LEVELS.index("whole"))
    rows = np.flatnonzero((surface_weights(scene.gaussians) > 0) & (whole != NO_NODE))
    if len(rows) == 0:
        return np.full(len(cells), NO_NODE)
    means = voxels.to_map.points(scene.gaussians.means[rows])
    centres = voxels.origin + (cells + 0.5) * voxels.resolution
    gaps, nearest = cKDTree(means).query(centres, distance_upper_bound=4 * voxels.resolution, workers=-1)
    return np.append(whole[rows], NO_NODE)[np.where(np.isfinite(gaps), nearest, len(rows))]

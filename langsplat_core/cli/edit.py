"""`langsplat transform`, `crop`, `clean`, `compact` and `scale`: scenes edited by numbers.

What belongs to them goes along.
"""

import math
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro
from rich.table import Table

from langsplat_core.arrays import Array
from langsplat_core.cli.arguments import AnyScene, OutFile, WrittenScene
from langsplat_core.cli.run import OutputConsole, print_json
from langsplat_core.config import BudgetConfig, CleanConfig, Positive, Range
from langsplat_core.errors import InputError
from langsplat_core.io.ply import write_metres
from langsplat_core.io.scenes import (
    check_keeps,
    check_writable,
    load_scene,
    load_without_language,
    save_scene,
)
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.selection import above_plane, in_box, in_sphere
from langsplat_core.scene import Scene
from langsplat_core.scene.transform import (
    AXES,
    IDENTITY,
    Similarity,
    moving,
    rotating,
    scaling,
    similarity,
    transform_scene,
    turning,
)

if TYPE_CHECKING:
    from langsplat_core.compaction.clean import CleanReport
    from langsplat_core.compaction.compact import CompactReport

Coordinate = Annotated[float, Range(-1e12, 1e12)]
Point = tuple[Coordinate, Coordinate, Coordinate]
Four = tuple[Coordinate, Coordinate, Coordinate, Coordinate]
Box = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]
Axis = Literal["x", "y", "z", "-x", "-y", "-z"]
Turn = tuple[Literal["x", "y", "z"], float]


@dataclass(frozen=True)
class Transform:
    """Move, rotate and scale a whole scene, colours seen from the side, cameras and metres per unit included.

    Steps are taken in this order: --matrix, --up, --rotate, --scale, --move.
    """

    scene: AnyScene
    out: WrittenScene
    matrix: Annotated[tuple[Four, Four, Four, Four] | None, tyro.conf.arg(metavar="16 NUMBERS")] = None
    """A 4x4 matrix, row by row, as registration gives one: a rotation times a scale, and a move."""
    up: Axis | None = None
    """Turn the scene upright: what is up in it, by its cameras, becomes this axis."""
    rotate: Annotated[tyro.conf.UseAppendAction[tuple[Turn, ...]], tyro.conf.arg(metavar="AXIS DEGREES")] = ()
    """About the x, y or z axis through the origin, right-handed; may be given several times."""
    scale: Positive = 1.0
    """Factor about the origin. With the metres per unit that `langsplat inspect` prints, a unit becomes a
    metre; `langsplat scale` says how long a unit is and moves nothing."""
    move: Annotated[Point, tyro.conf.arg(metavar="X Y Z")] = (0.0, 0.0, 0.0)
    """World units."""

    def run(self) -> None:
        check_writable(self.out)
        check_keeps(self.out, self.scene)
        scene = load_scene(self.scene)
        to = self._similarity(scene)
        save_scene(self.out, replace(transform_scene(scene, to), path=self.out))
        rows = "; ".join(" ".join(f"{number:.9g}" for number in row) for row in to.matrix)
        print(f"{self.out}: {len(scene.gaussians)} Gaussians, {len(scene.cameras)} cameras; matrix {rows}")

    def _similarity(self, scene: Scene) -> Similarity:
        to = IDENTITY if self.matrix is None else similarity(np.array(self.matrix))
        if self.up is not None:
            to = to.then(turning(to.rotation @ scene.up(), AXES[self.up]))
        for axis, degrees in self.rotate:
            to = to.then(rotating(AXES[axis], degrees))
        return to.then(scaling(self.scale)).then(moving(np.array(self.move)))


@dataclass(frozen=True)
class Crop:
    """Keep the Gaussians whose centres lie in all of the given boxes, spheres and half-spaces.

    What belongs to them goes along; with --outside everything else is kept. World units.
    """

    scene: AnyScene
    out: WrittenScene
    box: Annotated[tyro.conf.UseAppendAction[tuple[Box, ...]], tyro.conf.arg(metavar="X Y Z X Y Z")] = ()
    """Two opposite corners; may be given several times, as the others."""
    sphere: Annotated[tyro.conf.UseAppendAction[tuple[Four, ...]], tyro.conf.arg(metavar="X Y Z R")] = ()
    """Centre and radius."""
    plane: Annotated[tyro.conf.UseAppendAction[tuple[Four, ...]], tyro.conf.arg(metavar="NX NY NZ D")] = ()
    """Normal and offset: keeps what has NX x + NY y + NZ z >= D."""
    outside: bool = False
    """Keep what lies outside of them together instead."""

    def run(self) -> None:
        check_writable(self.out)
        check_keeps(self.out, self.scene)
        if not (self.box or self.sphere or self.plane):
            raise InputError("nothing to crop to: give --box, --sphere or --plane")
        scene = load_scene(self.scene)
        keep = self.inside(scene.gaussians.means) != self.outside
        if not keep.any():
            raise InputError(f"the crop holds none of the {len(keep)} Gaussians; {_extent(scene)}")
        save_scene(self.out, replace(scene.take(keep), path=self.out))
        print(f"{self.out}: {keep.sum()} of {len(keep)} Gaussians")

    def inside(self, means: Array) -> Array:
        """(N, 3) positions -> (N,) bool, whether each is in all of the shapes."""
        inside = np.ones(len(means), bool)
        for numbers in self.box:
            corners = np.array(numbers).reshape(2, 3)
            inside &= in_box(means, corners.min(0), corners.max(0))
        for *centre, radius in self.sphere:
            if not radius > 0:
                raise InputError(f"--sphere: a radius of {radius:g} holds nothing; it must be above 0")
            inside &= in_sphere(means, np.array(centre), radius)
        for *normal, offset in self.plane:
            if not any(normal):
                raise InputError("--plane: the normal is 0 0 0; give a direction")
            inside &= above_plane(means, np.array(normal), offset)
        return inside


@dataclass(frozen=True)
class Clean:
    """Remove floaters: small regions that touch nothing and veils in free space, the least visible first.

    As many go as the allowed loss of PSNR lets go. It is measured on photographs that the scene was not
    trained on where --photos has some, else derived from how far the scene's images change.
    """

    scene: AnyScene
    out: WrittenScene
    photos: Path | None = None
    """Dataset the scene was trained on: true floaters then cost nothing, and more of them go."""
    json: bool = False
    """Print JSON."""
    config: Annotated[CleanConfig, tyro.conf.arg(name="")] = field(default_factory=CleanConfig)

    def run(self) -> None:
        from langsplat_core.compaction.clean import clean_scene  # pycolmap: not every install has it

        with TerminalProgress() as progress:
            report = clean_scene(self.scene, self.out, self.config, self.photos, progress)
        if self.json:
            print_json({"out": str(self.out), "removed": report.removed, **asdict(report)})
            return
        print(*_lines(report), f"written: {self.out}", sep="\n")


def _lines(report: "CleanReport") -> list[str]:
    how = "on photographs" if report.assumed_psnr is None else f"if the scene has {report.assumed_psnr:g} dB"
    lines = [
        f"removed: {report.removed} of {report.gaussians} Gaussians: {report.regions} in small regions, "
        f"{report.free_space} in free space, {report.invalid} that cannot be drawn",
        f"loss: {report.loss:.3f} dB of {report.budget:g} allowed, worst view {report.worst_loss:.2f} dB "
        f"({how}; {report.measuring_views} views; {report.views_from})",
    ]
    if report.psnr_before is not None and report.psnr_after is not None:
        lines.append(f"PSNR: {report.psnr_before:.2f} dB before, {report.psnr_after:.2f} after")
    if report.kept:
        lines.append(f"kept: {report.kept} more are suspected; --max-psnr-loss allows more")
    return lines


def _extent(scene: Scene) -> str:
    """Return the extent of a scene's Gaussians, in words."""
    means = scene.gaussians.means[np.isfinite(scene.gaussians.means).all(1)]
    if not len(means):
        return "the scene holds none that lies anywhere"
    low, high = (" ".join(f"{number:.4g}" for number in corner) for corner in (means.min(0), means.max(0)))
    return f"they lie between {low} and {high}"


@dataclass(frozen=True)
class Compact:
    """Drop the Gaussians and colour harmonics that the views do not need, within an error budget.

    Nothing is retrained; the language field, the cameras and extra properties are taken along.
    """

    scene: AnyScene
    out: OutFile | None = None
    """The scene to write (default: SCENE with .compact.ply for its ending)."""
    photos: Path | None = None
    """Dataset the scene was trained on: the loss is then measured against its photographs."""
    json: bool = False
    """Print JSON."""
    config: Annotated[BudgetConfig, tyro.conf.arg(name="")] = field(default_factory=BudgetConfig)

    def run(self) -> None:
        from langsplat_core.compaction.compact import compact_scene

        out = self.out or self.scene.with_name(self.scene.name.split(".")[0] + ".compact.ply")
        with TerminalProgress() as progress:
            report = compact_scene(self.scene, out, self.config, self.photos, progress)
        if self.json:
            print_json({"out": str(out), **asdict(report)})
            return
        OutputConsole().print(_table(report))
        print(*_notes(report), f"written: {out}", sep="\n")


def _table(report: "CompactReport") -> Table:
    table = Table("", "before", "after", "after / before")
    for column in table.columns[1:]:
        column.justify = "right"
    before, after = report.before, report.after

    def row(name: str, old: float, new: float, form: str, factor: float = 1.0) -> None:
        share = f"{100 * new / old:.1f} %" if old else "-"
        table.add_row(name, format(old * factor, form), format(new * factor, form), share)

    row("Gaussians", before.gaussians, after.gaussians, ",d", 1)
    table.add_row("SH degree", str(before.sh_degree), str(after.sh_degree), "")
    row("on disk, MB", before.disk_bytes, after.disk_bytes, ".2f", 1e-6)
    row("in memory, MB", before.memory_bytes, after.memory_bytes, ".2f", 1e-6)
    if before.psnr is not None and after.psnr is not None:
        table.add_row("PSNR, dB", f"{before.psnr:.2f}", f"{after.psnr:.2f}", "")
    return table


def _notes(report: "CompactReport") -> list[str]:
    how = (
        "measured on photographs"
        if report.assumed_psnr is None
        else f"derived from the change, if the scene has {report.assumed_psnr:g} dB"
    )
    lines = [
        f"loss: {report.loss:.3f} dB of {report.budget:g} allowed, worst view "
        f"{report.worst_loss:.2f} dB ({how})",
        f"views: {report.ranking_views} ranked the Gaussians, {report.measuring_views} others measured; "
        f"{report.views_from}",
    ]
    return lines


@dataclass(frozen=True)
class SetScale:
    """Say how long a scene's unit is, so that answers are in metres: by a known length in it, or by a factor.

    Without either, print what the scene says. Only the header of the .ply is changed.
    """

    scene: tyro.conf.Positional[Path]
    """The scene, *.ply."""
    metres: Positive | None = None
    """A known length, between the two points of --between."""
    between: Box | None = None
    """Two points that are --metres apart, x y z x y z in world units."""
    metres_per_unit: Positive | None = None
    """How long a unit is."""

    def run(self) -> None:
        if (self.metres is None) != (self.between is None):
            raise InputError(
                "--metres and --between belong together: a length, and the points it lies between"
            )
        if self.metres is not None and self.metres_per_unit is not None:
            raise InputError("give either --metres with --between, or --metres-per-unit")
        factor = self.metres_per_unit
        if self.metres is not None and self.between is not None:
            factor = metres_per_unit(self.metres, self.between)
        if factor is not None:
            write_metres(self.scene, factor)
        stored = load_without_language(self.scene).metres_per_unit
        print(f"{self.scene}: {'no scale' if stored is None else f'{stored:.6g} m per unit'}")


def metres_per_unit(metres: float, between: Box) -> float:
    """Return the metres per unit of a length in metres between two points.

    Raises InputError unless both lengths are positive.
    """
    units = math.dist(between[:3], between[3:])
    if not (0 < metres < math.inf and 0 < units < math.inf):
        raise InputError(
            f"{metres:g} m between points {units:g} units apart: both must be above 0 and finite"
        )
    return metres / units

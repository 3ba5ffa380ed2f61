"""A furnished room with small objects on a table: geometry, materials, and the names of everything."""

from dataclasses import dataclass

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.lab.config import Tier
from langsplat_core.lab.world.captions import Label, label_region
from langsplat_core.lab.world.objects.kit import Material, Piece, Thing
from langsplat_core.lab.world.placement import Placed
from langsplat_core.lab.world.rooms import furnished


@dataclass(frozen=True, eq=False)
class World:
    """All surfaces of a room in one set of arrays. The origin is the middle of the table's top, z up."""

    vertices: Array  # (V, 3) float32 world points, metres
    normals: Array  # (V, 3) float32 unit
    local: Array  # (V, 3) float32 the same vertices in their object's frame, where textures live
    triangles: Array  # (T, 3) int32
    piece_of: Array  # (T,) int32 row of `materials` and `ids`
    materials: tuple[Material, ...]
    frames: Array  # (P, 3, 3) rotation of every piece from its object's frame into the world
    ids: Array  # (P, 3) int32 label ids of every piece: subpart, part, whole
    labels: tuple[Label, ...]  # indexed by id
    solid: Array  # (T,) bool: surfaces that an outline of the room's objects should cover (not the room)


def build_room(seed: int, tier: Tier = "clutter") -> World:
    """The furnished room of a seed: the same arguments always give the same room, object for object.

    tier: "separate" objects at a distance, "clutter" on the table and the floor, or "occlusion": packed
    tightly, with look-alikes (the same class in other colours, the same colour on other classes).
    """
    return assemble(furnished(seed, tier))


def assemble(placed: list[Placed]) -> World:
    """One set of arrays from placed things; ids count up through wholes, parts and subparts."""
    columns: dict[str, list[Array]] = {key: [] for key in ("v", "n", "l", "t", "p")}
    labels: list[Label] = []
    known: dict[tuple[object, ...], int] = {}
    ids: list[list[int]] = []
    materials: list[Material] = []
    frames: list[Array] = []
    offset = 0

    def number(key: tuple[object, ...], level: int, thing: Thing, piece: Piece) -> int:
        if key not in known:
            known[key] = len(labels)
            labels.append(label_region(level, thing, piece))
        return known[key]

    for index, item in enumerate(placed):
        for piece in item.thing.pieces:
            part = (index, piece.part, piece.instance)
            ids.append([
                number((*part, piece.subpart), 0, item.thing, piece),
                number(part, 1, item.thing, piece),
                number((index,), 2, item.thing, piece),
            ])  # fmt: skip
            mesh = piece.mesh.stretched((item.scale,) * 3).turned(item.turn).moved(item.offset)
            columns["v"].append(mesh.vertices)
            columns["n"].append(mesh.normals)
            columns["l"].append(piece.mesh.vertices)
            columns["t"].append(mesh.triangles + offset)
            columns["p"].append(np.full(len(mesh.triangles), len(materials)))
            materials.append(piece.material)
            frames.append(item.turn)
            offset += len(mesh.vertices)
    whole_words = [labels[row[2]].word for row in ids]
    solid = np.array([word not in ("floor", "wall") for word in whole_words])
    piece_of = np.concatenate(columns["p"]).astype(np.int32)
    return World(
        np.concatenate(columns["v"]).astype(np.float32),
        np.concatenate(columns["n"]).astype(np.float32),
        np.concatenate(columns["l"]).astype(np.float32),
        np.concatenate(columns["t"]).astype(np.int32),
        piece_of,
        tuple(materials),
        np.stack(frames),
        np.array(ids, np.int32),
        tuple(labels),
        solid[piece_of],
    )

"""Occupancy along rays, the map of the floor, poses in front of things, and `langsplat map`."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.extensions.geometry.occupancy import (
    FloorMap,
    Occupancy,
    collider,
    find_goal,
    find_occupancy,
    floor_map,
    map_axes,
    reachable,
    trace,
)
from langsplat_core.extensions.geometry.planes import Room
from langsplat_core.io.scenes import save_scene
from langsplat_core.scene import Scene
from tests.support.fakes import named_scene
from tests.support.processes import refusal, run
from tests.support.scenes import FLOOR, WALL, box_room

COARSE = "--resolution", 0.1, "--step", 0.15
ROOM = Room(np.array([0.0, 0.0, 1.0]), FLOOR, None)


def reference_trace(eye: Array, ends: Array, shape: tuple[int, int, int]) -> tuple[Array, Array]:
    """The voxels that many small steps along each ray meet."""
    hits, passes = (np.zeros(shape, np.uint16) for _ in range(2))
    for end in ends:
        last = np.floor(end).astype(int)
        steps = eye + np.linspace(0, 1, 20_001)[:, None] * (end - eye)
        met = {tuple(cell) for cell in np.floor(steps).astype(int)} - {tuple(last)}
        for cell in met:
            if all(0 <= c < n for c, n in zip(cell, shape, strict=True)):
                passes[cell] += 1
        if ((last >= 0) & (last < shape)).all():
            hits[tuple(last)] += 1
    return hits, passes


@pytest.mark.parametrize("eye", [(3.3, 4.2, 5.1), (-4.6, 2.2, 3.7)], ids=["inside", "outside"])
def test_rays_pass_the_voxels_that_small_steps_pass(eye):
    rng = np.random.default_rng(1)
    ends, shape = rng.uniform(-1, 9, (40, 3)), (8, 8, 8)
    hits, passes = (np.zeros(shape, np.uint16) for _ in range(2))
    trace(np.array(eye), ends, hits, passes)
    want_hits, want_passes = reference_trace(np.array(eye), ends, shape)
    np.testing.assert_array_equal(hits, want_hits)
    # A step may miss a corner that the ray cuts.
    assert (passes >= want_passes).all()
    assert (passes - want_passes).sum() <= 0.01 * want_passes.sum()


def test_rays_along_an_axis_and_of_no_length_end():
    hits, passes = (np.zeros((4, 4, 4), np.uint16) for _ in range(2))
    start = np.full(3, 0.5)
    trace(start, np.array([[3.5, 0.5, 0.5], start]), hits, passes)
    assert passes[:, 0, 0].tolist() == [1, 1, 1, 0]
    assert hits[3, 0, 0] == hits[0, 0, 0] == 1
    full = np.full((4, 4, 4), np.iinfo(np.uint16).max, np.uint16)
    trace(start, np.array([[3.5, 0.5, 0.5]]), full.copy(), full)
    assert full[0, 0, 0] == np.iinfo(np.uint16).max


def test_axes_of_a_map_are_metres_with_the_ground_at_nought():
    up = np.array([0.6, 0.0, 0.8])
    matrix = map_axes(Room(up, 2.0, None), 3.0)
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, 9 * np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(27)
    np.testing.assert_allclose(matrix[:3, :3] @ (2.0 * up) + matrix[:3, 3], [0, 0, 0], atol=1e-12)
    sideways = map_axes(Room(np.array([1.0, 0, 0]), 0.0, None), 1.0)
    assert np.isfinite(sideways).all()


def test_a_room_is_free_within_its_walls():
    occupancy = find_occupancy(box_room(), map_axes(ROOM, 1.0), 0.1)
    plan = floor_map(occupancy, 0.15, 0.5)
    centres = plan.centres(np.argwhere(plan.free))
    assert np.abs(centres).max() < WALL + 0.1
    assert len(centres) * 0.01 > 0.4 * (2 * WALL) ** 2  # the cameras do not see all of it
    standing = plan.centres(np.argwhere(plan.occupied))
    at_wall = np.abs(np.abs(standing).max(1) - WALL) < 0.35  # seen at a flat angle
    block = (np.abs(standing[:, 0] - 1.5) < 0.4) & (np.abs(standing[:, 1]) < 1.5)
    assert (at_wall | block).mean() > 0.5
    assert at_wall.sum() > 20
    assert block.sum() > 10
    with pytest.raises(InputError, match="finer --resolution"):
        floor_map(occupancy, 0.6, 0.5)
    for scene, side, message in (
        (replace(box_room(), cameras=()), 0.1, "no cameras"),
        (box_room(), 0.001, "coarser --resolution"),
    ):
        with pytest.raises(InputError, match=message):
            find_occupancy(scene, map_axes(ROOM, 1.0), side)


def plan_of(rows: list[str]) -> FloorMap:
    """A map of cells of a metre: "." free, "#" occupied, "?" unknown; the first row has the largest y."""
    grid = np.array([list(row) for row in rows[::-1]]).T
    return FloorMap(np.zeros(2), 1.0, grid == "#", grid == ".")


PLAN = ["#######", "#..#..#", "#..#..#", "#..#.##", "#.....#", "#######"]


def test_goals_are_reachable_and_face_a_thing_with_nothing_between():
    plan, thing = plan_of(PLAN), np.array([[4.5, 4.5]])
    where = reachable(plan, 0.4, (1.5, 1.5))
    goal = find_goal(plan, where, thing)
    assert goal is not None
    assert goal.x >= 4  # not through the wall, where it would be as near
    islands, _ = ndimage.label(where)  # of cells that share an edge
    assert islands[int(goal.x), int(goal.y)] == islands[1, 1] > 0
    far = find_goal(plan, where, thing, 1.5)
    assert far is not None
    assert far.distance >= 1.5
    assert np.hypot(4.5 - far.x, 4.5 - far.y) == pytest.approx(far.distance)
    assert far.yaw == pytest.approx(np.arctan2(4.5 - far.y, 4.5 - far.x))
    assert find_goal(plan, where, thing, 30.0) is None
    assert find_goal(plan, np.zeros(plan.free.shape, bool), thing) is None


def test_a_robot_stays_where_it_fits_and_where_it_is():
    plan = plan_of([*PLAN[:4], "#..#..#", PLAN[5]])  # two rooms
    assert np.argwhere(reachable(plan, 0.4, (1.5, 1.5)))[:, 0].max() == 2
    assert np.argwhere(reachable(plan, 0.4))[:, 0].max() == 2  # the larger one
    with pytest.raises(InputError, match="does not fit there"):
        reachable(plan, 0.4, (3.5, 2.5))
    with pytest.raises(InputError, match="fits nowhere"):
        reachable(plan, 5.0)


def test_a_collider_is_closed_around_what_is_occupied():
    hits = np.zeros((3, 3, 3), np.uint16)
    hits[1, 1, 1] = hits[1, 1, 2] = 1
    corners, squares = collider(Occupancy(np.eye(4), np.full(3, -1.0), 0.5, hits, np.zeros_like(hits)))
    assert len(squares) == 10
    np.testing.assert_allclose([corners.min(0), corners.max(0)], [[-0.5, -0.5, -0.5], [0.0, 0.0, 0.5]])
    edges = np.sort(np.stack([squares, np.roll(squares, -1, 1)], -1).reshape(-1, 2), 1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    a, b, c = (corners[squares[:, k]] for k in range(3))
    outward = np.einsum("fi,fi->f", np.cross(b - a, c - b), corners[squares].mean(1) - corners.mean(0))
    assert (outward > 0).all()


def nav2_map(folder: Path) -> tuple[Array, Array, dict[str, str]]:
    """(rows, columns) occupied and free, as map_server reads them in mode trinary, and the settings."""
    settings = dict(line.split(": ", 1) for line in (folder / "map.yaml").read_text().splitlines())
    assert settings["mode"] == "trinary"
    assert settings["negate"] == "0"
    shade = np.asarray(Image.open(folder / settings["image"])).astype(float)
    occupancy = (255 - shade) / 255
    occupied = occupancy > float(settings["occupied_thresh"])
    return occupied, occupancy < float(settings["free_thresh"]), settings


def test_the_command_writes_what_nav2_reads(tmp_path, capsys):
    pytest.importorskip("open3d")
    save_scene(tmp_path / "room.ply", replace(box_room(), metres_per_unit=1.0))
    assert run("map", tmp_path / "room.ply", tmp_path / "map", *COARSE) == 0
    occupied, free, settings = nav2_map(tmp_path / "map")
    assert not (occupied & free).any()
    assert (~occupied & ~free).any()  # what nobody saw
    x, y, yaw = json.loads(settings["origin"])
    assert yaw == 0
    columns, rows = x + 0.1 * (np.arange(free.shape[1]) + 0.5), y + 0.1 * (np.arange(free.shape[0]) + 0.5)
    beyond = np.maximum(np.abs(columns)[None], np.abs(rows)[::-1, None]) > WALL + 0.15
    assert not free[beyond].any()
    labels, _ = ndimage.label(free)
    assert np.bincount(labels[labels > 0]).max() > 0.7 * free.sum()
    voxels = np.load(tmp_path / "map" / "voxels.npz", allow_pickle=False)
    assert len(voxels["cells"]) == len(voxels["words"]) == len(voxels["nodes"])
    assert (tmp_path / "map" / "collider.obj").read_text().startswith("v ")


def test_a_map_without_a_scale_is_refused(tmp_path, capsys):
    pytest.importorskip("open3d")
    save_scene(tmp_path / "room.ply", Scene(box_room().gaussians, cameras=box_room().cameras))
    assert "nobody said how long a unit" in refusal(capsys, "map", tmp_path / "room.ply", tmp_path / "map")
    assert not (tmp_path / "map" / "map.pgm").exists()


def test_goals_by_phrase_and_what_has_none(tmp_path, capsys):
    pytest.importorskip("open3d")
    scene = box_room()
    near_block = (np.abs(scene.gaussians.means - [1.5, 0, FLOOR + 0.3]) < [0.4, 1.5, 0.4]).all(1)
    latents = np.zeros((3, len(near_block), 4), np.float32)
    latents[..., 3] = 1
    latents[:, near_block] = [1, 0, 0, 0]
    ones = np.ones(latents.shape[:2], np.float32)
    codec = named_scene(False).language.codec
    field = replace(named_scene().language, latents=latents, confidence=ones, codec=codec)
    save_scene(tmp_path / "room.ply", replace(scene, language=field, metres_per_unit=1.0))
    words = "map", tmp_path / "room.ply", tmp_path / "map", *COARSE, "--goal", "mug", "wall"
    assert run(*words) == 2
    assert "no goal for 'wall': not here" in capsys.readouterr().err
    (goal,) = json.loads((tmp_path / "map" / "goals.json").read_text())
    assert goal["phrase"] == "mug"
    assert 0.3 <= goal["distance"] < 1.0
    assert np.cos(goal["yaw"]) > 0  # towards the block, which stands at the wall x = 2

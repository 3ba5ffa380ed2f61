"""Procedural rooms and their objects: geometry, colours, light, images, and the folders they go to."""

import json
from collections import defaultdict
from itertools import chain

import numpy as np
import pytest
from PIL import Image

from assets.making import dataset
from assets.making.__main__ import PROGRAM, parse
from assets.making.dataset import write_dataset
from assets.making.kit import COLOUR_SYNONYMS, COLOURS, Kit, colour_word, from_lch, random_colour, to_lch
from assets.making.objects import EVERYTHING, TABLE_TOP
from assets.making.render import Light, Renderer
from assets.making.vocabulary import CATEGORIES, MATERIALS, label_region, object_words, part_words
from assets.making.world import apart, bounds, build_room, footprint, furnished
from langsplat_core.cli.run import main
from langsplat_core.config import numeric_settings
from langsplat_core.datasets.nerfstudio import load_nerfstudio
from langsplat_core.errors import InputError
from langsplat_core.progress import silent
from langsplat_core.scene import CANONICAL_PHRASES, look_at

pytestmark = pytest.mark.long

UP = np.array([0.0, 0.0, 1.0])
SEED, VIEWS, SIZE = 2, 9, (160, 120)  # the room of the bundled scene


@pytest.fixture(scope="module")
def coarse_light():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "LIGHT_SAMPLES", 2)
        patch.setattr(dataset, "LIGHT_CELL", 0.0)
        yield


@pytest.fixture(scope="module")
def world():
    return build_room(3)


@pytest.fixture(scope="module")
def renderer(world):
    return Renderer(world, Light(np.array([-0.9, -1.0, 1.7])), samples=4)


def test_colour_words_cover_what_they_draw():
    rng = np.random.default_rng(0)
    for word in COLOURS:
        assert {colour_word(random_colour(word, rng)) for _ in range(20)} == {word}
    assert colour_word(np.array([0.9, 0.6, 0.15])) in ("orange", None)
    display = rng.uniform(0, 1, (50, 3))
    np.testing.assert_allclose(from_lch(to_lch(display)), display, atol=1e-6)


def test_truth_is_nested_and_follows_the_seed(world):
    for fine, coarse in ((0, 1), (1, 2)):
        owner = {}
        for row in world.ids:
            assert owner.setdefault(row[fine], row[coarse]) == row[coarse]
    assert [world.labels[i].level for i in world.ids[0]] == [0, 1, 2]
    assert len(np.unique(world.ids)) == len(world.labels)
    assert world.piece_of.max() + 1 == len(world.ids) == len(world.materials)
    again, other = build_room(3), build_room(4)
    np.testing.assert_array_equal(world.vertices, again.vertices)
    assert world.labels == again.labels != other.labels


def test_views_agree_on_the_points_they_share(world, renderer):
    one = look_at(np.array([0.2, -1.3, 0.8]), np.zeros(3), UP, (120, 90))
    two = look_at(np.array([0.7, -1.1, 0.8]), np.zeros(3), UP, (120, 90))
    a, b = renderer.render(one, oversample=2), renderer.render(two, oversample=2)
    rows, columns = np.nonzero(np.isfinite(a.depth))
    points = np.array(
        [one.unproject((c + 0.5, r + 0.5), a.depth[r, c]) for r, c in zip(rows, columns, strict=True)]
    )
    pixels, depth = two.project(points)
    x, y = np.floor(pixels).astype(int).T
    inside = (x >= 0) & (x < 120) & (y >= 0) & (y < 90) & (depth > 0)
    rows, columns, x, y, depth = rows[inside], columns[inside], x[inside], y[inside], depth[inside]
    same = np.abs(b.depth[y, x] - depth) < 0.005
    assert same.mean() > 0.3
    labels = (a.pieces[rows, columns] == b.pieces[y, x])[same]
    assert labels.mean() > 0.97  # the rest lies within a pixel of an edge
    difference = np.abs(a.image[rows, columns].astype(float) - b.image[y, x])[same]
    assert np.median(difference) < 8  # of 255: highlights move, textures are sampled half a pixel apart


def test_written_dataset_is_read_back(tmp_path, coarse_light):
    write_dataset(tmp_path, 1, 5, (64, 48), silent)
    capture = load_nerfstudio(tmp_path / "transforms.json", 800, silent)
    assert (capture.metres_per_unit, capture.drawn) == (1, True)
    assert len(capture) == 5
    assert capture.images[0].shape == (48, 64, 3)
    assert len(capture.points) == 20_000
    labels = json.loads((tmp_path / "truth" / "labels.json").read_text())
    with np.load(tmp_path / "truth" / "view_000.npz") as truth:
        ids, depth = truth["ids"], truth["depth"]
    assert ids.shape == (3, 48, 64)
    assert [labels[str(ids[level, 24, 32])]["level"] for level in range(3)] == ["subpart", "part", "whole"]
    camera = next(camera for camera in capture.cameras if camera.name == "view_000")
    point = camera.unproject((32.5, 24.5), float(depth[24, 32]))
    nearest = np.linalg.norm(capture.points - point, axis=1).min()
    assert nearest < 0.1  # the cloud covers what the camera sees: conventions of both agree


def test_interrupted_dataset_renders_missing_views_only(tmp_path, coarse_light):
    write_dataset(tmp_path, 1, 4, (32, 24), silent)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.glob("images/*")}
    image = np.asarray(Image.open(tmp_path / "images" / "view_002.png"))
    (tmp_path / "truth" / "view_002.npz").unlink()
    with pytest.raises(InputError, match="at least 4 views"):
        write_dataset(tmp_path, 1, 2, (32, 24), silent)
    write_dataset(tmp_path, 1, 4, (32, 24), silent)
    changed = {path.stem for path, when in before.items() if path.stat().st_mtime_ns != when}
    assert changed == {"view_002"}
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "images" / "view_002.png")), image)


def small_things(placed):
    """Things put down on the table or the floor, without the fruit in bowls and on plates."""
    hosts = [p for p in placed if p.scale != 1.0]
    held = {"orange", "apple"}
    return [p for p in hosts if p.thing.word not in held or p.offset[2] < 0.004]


@pytest.mark.parametrize(
    ("line", "wrong"), [("dataset --out d", "--views 0"), ("encoder --out d", "--batch 0")]
)
def test_commands_refuse_numbers_outside_their_range(line, wrong, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert all(setting.range for setting in numeric_settings(parse(line.split())))
    assert main(PROGRAM, lambda: parse(f"{line} {wrong}".split())) == 2
    assert f"{wrong}: must be" in capsys.readouterr().err
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize("tier", ["separate", "clutter", "occlusion"])
def test_things_stand_apart_on_a_surface(tier):
    placed = small_things(furnished(5, tier))
    assert len(placed) >= 6
    for item in placed:
        lowest = min(
            (p.mesh.vertices @ item.turn.T * item.scale + item.offset)[:, 2].min() for p in item.thing.pieces
        )
        height = min((0.0, -0.72, -0.708), key=lambda level: abs(level - lowest))  # table, floor, rug
        assert lowest - height == pytest.approx(0.001, abs=2e-4)
    corners = [footprint(item) for item in placed]
    for row, one in enumerate(corners):
        for other, item in zip(corners[:row], placed, strict=False):
            if abs(item.offset[2] - placed[row].offset[2]) < 0.4:
                assert apart(one, other, 0.0)


def test_tiers_grow_harder():
    rooms = {tier: build_room(5, tier) for tier in ("separate", "clutter", "occlusion")}
    wholes = {tier: [x for x in room.labels if x.level == 2] for tier, room in rooms.items()}
    assert len(wholes["separate"]) < len(wholes["clutter"]) < len(wholes["occlusion"])
    words = [label.word for label in wholes["occlusion"]]
    alike = {word for word in set(words) if words.count(word) >= 3} - {"wall"}
    hues = {word: {x.colour for x in wholes["occlusion"] if x.word == word} for word in alike}
    assert sum(len(colours) >= 2 for colours in hues.values()) >= 3  # the same class in other colours


# Every class of object: builds, stands, nests, has words of its own.


SEEDS = 10
# Words that are right for two things because they are the same thing, or that no phrase can tell apart:
# the fruit and the colour; a room's walls and a house's; the hat that a snowman wears.
SHARED = {"orange", "wall", "floor", "rug", "hat"}


def build(name, seed):
    builder, words = EVERYTHING[name]
    return builder(Kit(np.random.default_rng((seed, 17))), words[seed % len(words)])


def radius_of(thing):
    return max(np.linalg.norm(piece.mesh.vertices[:, :2], axis=1).max() for piece in thing.pieces)


def labels_of(thing, piece):
    return [label_region(level, thing, piece) for level in range(3)]


@pytest.fixture(scope="module")
def things():
    return {name: [build(name, seed) for seed in range(SEEDS)] for name in EVERYTHING}


@pytest.mark.parametrize("name", EVERYTHING)
def test_things_have_sound_meshes_and_stand_on_ground(name, things):
    for thing in things[name]:
        assert thing.word == name
        assert thing.colour in ("", *COLOURS)
        for piece in thing.pieces:
            mesh = piece.mesh
            assert len(mesh.triangles) > 0
            assert np.isfinite(mesh.vertices).all()
            np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
            assert mesh.triangles.min() >= 0
            assert mesh.triangles.max() < len(mesh.vertices)
        triangles = sum(len(piece.mesh.triangles) for piece in thing.pieces)
        assert triangles < (6500 if name != "table" else 45_000)  # its top shows fine shadows
        (_, _, lowest), (_, _, height) = bounds(thing)
        radius = radius_of(thing)
        assert -0.006 < lowest < 0.02
        assert (0.04 < radius < 0.26) if name in TABLE_TOP else (0.15 < radius < 1.4)
        assert (0.01 < height < 0.4) if name in TABLE_TOP else (0.4 < height < 1.6)
    thing = things[name][0]
    extent = max(radius_of(thing), bounds(thing)[1][2] / 2)
    for piece in thing.pieces:
        p = piece.mesh.vertices[piece.mesh.triangles]
        face = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        against = (face * piece.mesh.normals[piece.mesh.triangles].mean(1)).sum(1) < 0
        area = np.linalg.norm(face, axis=1)
        # A few slivers of round ends and ruffles may disagree.
        assert area[against].sum() < 0.02 * area.sum(), (piece.part, piece.subpart)
        # A region far below a hundredth of its thing would be no use in any image.
        assert np.ptp(piece.mesh.vertices, axis=0).max() / extent > 0.05, (piece.part, piece.subpart)


@pytest.mark.parametrize("name", EVERYTHING)
def test_parts_are_named_and_nested(name, things):
    names = [{(piece.part, piece.subpart) for piece in thing.pieces} for thing in things[name]]
    assert len(names[0]) >= 2
    assert all(other == names[0] for other in names)  # the same words whatever the seed
    for part, subpart in names[0]:
        assert part not in ("", subpart, name)
        assert part.replace(" ", "").isalpha()
        assert subpart.replace(" ", "").isalpha() or not subpart
    for thing in things[name][:2]:
        for piece in thing.pieces:
            labels = labels_of(thing, piece)
            assert [label.thing for label in labels] == [name] * 3
            assert labels[2].word == name
            assert set(labels[0].hues) <= set(labels[1].hues) <= set(labels[2].hues)
            assert set(labels[0].materials) <= set(labels[1].materials) <= set(labels[2].materials)
            assert all(label.material in ("", *MATERIALS) for label in labels)


def test_words_stand_for_one_thing(things):
    meant = defaultdict(set)
    for name in [*EVERYTHING, "rug", "floor", "wall"]:
        for word in object_words(name):
            meant[word].add(("object", name))
    pieces = [piece for group in things.values() for piece in group[0].pieces]
    regions = {name for piece in pieces for name in (piece.part, piece.subpart)} - {""}
    # Parts of two objects may share a word: both have handles.
    for role, words in {
        "category": set(chain.from_iterable(CATEGORIES.values())),
        "colour": {*COLOURS, *chain.from_iterable(COLOUR_SYNONYMS.values())},
        "material": set(chain.from_iterable(MATERIALS.values())),
        "canonical": set(CANONICAL_PHRASES),
        "part": {word for region in regions for word in part_words(region)},
    }.items():
        for word in words:
            meant[word].add((role, "" if role == "part" else word))
    assert {word for word, roles in meant.items() if len(roles) > 1} <= SHARED


def test_phrases_name_a_whole_or_a_part(things):
    """A snowman's hat is a hat; any other phrase for a part must not be one for a thing."""
    wholes, parts = set(), set()
    for group in things.values():
        for thing in group[:3]:
            for piece in thing.pieces:
                subpart, part, whole = labels_of(thing, piece)
                wholes.update(whole.names)
                parts.update(subpart.names, part.names)
    assert {phrase for phrase in wholes & parts if phrase.split()[-1] != "hat"} == set()

"""Scenes: framing, merged Gaussians, phrases, calibration, trees, and similarity transforms."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from langsplat_core import look_at, render
from langsplat_core.arrays import logit, psnr, sigmoid, unit
from langsplat_core.config import INRIA
from langsplat_core.errors import InputError
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import NO_NODE, Camera, Gaussians, PlattScaling, Scene, Tree, near_plane
from langsplat_core.scene.gaussians import GROUP, merged
from langsplat_core.scene.language import phrase_key, split_phrases, tidy, tokens
from langsplat_core.scene.transform import (
    AXES,
    IDENTITY,
    moving,
    rotating,
    scaling,
    similarity,
    transform_gaussians,
    transform_scene,
    turning,
)
from tests.support.file_samples import assert_same, random_field
from tests.support.hard_cases import balls
from tests.support.scenes import covariances, random_camera, random_gaussians, repeated, without_perspective


@pytest.mark.parametrize("offset", [0.0, 1e4, 1e15, 3e38])
def test_a_camera_frames_any_scene(offset: float) -> None:
    """At 1e15 all positions are one float32 and the eye was the target: a camera of NaN."""
    gaussians = random_gaussians(20)
    scene = Scene(replace(gaussians, means=gaussians.means + np.float32(offset)))
    camera = scene.framing_camera((64, 48))
    np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-6)


@pytest.mark.filterwarnings("error")
def test_scales_of_any_size_are_taken_from_doubles() -> None:
    taken = random_gaussians(9)
    assert len(replace(taken, means=taken.means.astype(np.float64), log_scales=np.full((9, 3), 1e4))) == 9


@pytest.mark.parametrize("angle", [0.0, 0.5, 1.3, 2.2])
def test_a_thin_scene_is_seen_from_its_broad_side(angle: float) -> None:
    """Up is -y without cameras; a sheet that stands upright, turned about it."""
    gaussians = random_gaussians(2000)
    across, high, thin = np.random.default_rng(0).uniform(-1, 1, (3, 2000)) * [[1.0], [1.0], [0.05]]
    normal = np.array([np.cos(angle), 0, np.sin(angle)])
    along = np.cross([0, 1, 0], normal)
    means = across[:, None] * along + high[:, None] * [0, 1, 0] + thin[:, None] * normal
    camera = Scene(replace(gaussians, means=means)).framing_camera((64, 48))
    ahead = camera.rotation[2] * [1, 0, 1]
    assert abs(ahead @ normal) / np.linalg.norm(ahead) > 0.75  # a quarter more would be better


def test_a_few_floaters_do_not_move_the_middle() -> None:
    gaussians = random_gaussians(200)
    centre, radius = Scene(gaussians).bounds()
    means = gaussians.means.copy()
    means[::50] = 1e30
    moved, larger = Scene(replace(gaussians, means=means)).bounds()
    assert np.linalg.norm(moved - centre) < 0.1 * radius
    assert larger == pytest.approx(radius, rel=0.1)


# Fewer Gaussians that look much the same.


def test_spiral_cameras_surround_the_scene():
    scene = Scene(random_gaussians(50, 1))
    cameras = scene.spiral_cameras(200, (64, 48), (-20.0, 60.0), (2.6, 1.6))
    centre, radius = scene.bounds()
    offsets = np.stack([camera.position for camera in cameras]) - centre
    distances = np.linalg.norm(offsets, axis=1)
    np.testing.assert_allclose(distances[:4] / radius, [2.6, 1.6, 2.6, 1.6])
    elevations = np.degrees(np.arcsin(offsets @ scene.up() / distances))
    assert elevations.min() == pytest.approx(-20, abs=0.5)
    assert elevations.max() == pytest.approx(60, abs=0.5)
    assert np.linalg.norm((offsets / distances[:, None]).mean(0) - 0.26 * scene.up()) < 0.02  # all around
    for camera in cameras[:5]:
        pixels, depths = camera.project(centre[None])
        assert depths[0] > radius
        np.testing.assert_allclose(pixels[0], (32, 24), atol=1e-6)


def test_cameras_are_rigid_and_of_whole_pixels():
    camera = random_camera(4, 60, 40)
    pose = camera.world_to_camera
    for wrong in (pose * [[2], [2], [2], [1]], pose * [[-1], [1], [1], [1]], pose.T, np.ones((4, 4))):
        with pytest.raises(ValueError, match="scaled, mirrored or transposed"):
            replace(camera, world_to_camera=wrong)
    with pytest.raises(ValueError, match="must be whole"):
        replace(camera, width=60.5)
    for eye, degrees, said in (
        ([1, 1, 1], 50, "looks at itself"),
        ([0, np.nan, 0], 50, "three finite numbers"),
        ([0, 0], 50, "three finite numbers"),
        ([0, 0, 0], 180, "of 180 degrees"),
    ):
        with pytest.raises(ValueError, match=said):
            look_at(eye, np.ones(3), np.array([0, 0, 1.0]), (60, 40), degrees)
    sized = replace(camera, width=np.uint8(60), height=40.0)
    assert (type(sized.width), sized.width, type(sized.height), sized.height) == (int, 60, int, 40)
    assert camera not in (replace(camera), sized)


# What cameras project, and where that came from.


def off_centre(orthographic: bool) -> Camera:
    camera = replace(random_camera(4, 60, 40), fx=35.0, fy=42.0, cx=11.3, cy=31.9)
    return without_perspective(camera) if orthographic else camera


@pytest.mark.parametrize("orthographic", [False, True])
def test_unprojecting_inverts_projecting_along_rays(orthographic: bool) -> None:
    """By hand, in float64: x right, y down, z forward, the first pixel's centre at 0.5."""
    camera, points = off_centre(orthographic), np.random.default_rng(0).normal(size=(4, 5, 3))
    pixels, depths = camera.project(points.reshape(-1, 3))
    back = camera.unproject(pixels.reshape(4, 5, 2), depths.reshape(4, 5))
    np.testing.assert_allclose(back, points, atol=1e-12)
    np.testing.assert_allclose(camera.unproject(pixels[3], depths[3]), points[0, 3], atol=1e-12)
    right, down, forward = camera.rotation
    points = camera.unproject(camera.pixel_centres(), np.float32(2.5))
    assert points.shape == (40, 60, 3)
    scale = 1.0 if orthographic else 2.5
    want = camera.position + scale * ((7.5 - 11.3) / camera.fx * right + (3.5 - 31.9) / camera.fy * down)
    np.testing.assert_allclose(points[3, 7], want + 2.5 * forward, atol=1e-12)


def test_points_in_the_image_are_told_apart() -> None:
    camera = off_centre(False)
    pixels = np.array([[0.0, 0.0], [59.9, 39.9], [60.0, 5.0], [5.0, 40.0], [-0.1, 5.0], [5.0, 5.0]])
    points = camera.unproject(pixels, np.array([1.0, 2.0, 1.0, 1.0, 1.0, -1.0]))
    points = np.append(points + 1e-9 * camera.rotation[:2].sum(0), np.full((1, 3), np.nan), 0)
    seen = camera.in_image(*camera.project(points))
    assert seen.tolist() == [True, True, False, False, False, False, False]


def test_merge_joins_copies():
    """Exactly: same place, same shape, the opacity of all four one behind the other."""
    one = random_gaussians(1, sh_degree=1, scale_range=(0.1, 0.4))
    found = merged(replace(one.take(np.zeros(GROUP, int)), opacity_logits=logit(np.full(GROUP, 0.3))))
    assert len(found.gaussians) == 1
    np.testing.assert_allclose(found.gaussians.means, one.means, rtol=1e-6)
    np.testing.assert_allclose(found.gaussians.sh, one.sh, rtol=1e-6)
    np.testing.assert_allclose(covariances(found.gaussians), covariances(one), rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(sigmoid(found.gaussians.opacity_logits), 1 - 0.7**GROUP, rtol=1e-6)
    np.testing.assert_allclose(found.weights, 1 / GROUP)


def test_merge_joins_neighbours_into_a_longer_one():
    """Mean and covariance are those of the mixture."""
    x = np.array([-0.12, -0.04, 0.04, 0.12])
    found = merged(balls(np.zeros(GROUP), 0.5, 0.2, x)).gaussians
    assert len(found) == 1
    np.testing.assert_allclose(found.means, 0, atol=1e-7)
    expected = np.diag([0.04 + np.mean(x**2), 0.04, 0.04])
    np.testing.assert_allclose(covariances(found)[0], expected, atol=1e-7)


def test_merge_keeps_distant_gaussians():
    apart = random_gaussians(81, scale_range=(1e-3, 2e-3))
    found = merged(apart)
    rows = found.sources[:, 0]
    assert sorted(rows) == list(range(81))
    assert_same(found.gaussians, apart.take(rows))


@pytest.fixture(scope="module")
def dense() -> Gaussians:
    return repeated(Scene(random_gaussians(200, 1, sh_degree=1, scale_range=(0.05, 0.2))), 1600).gaussians


def test_merge_shrinks_a_dense_scene_that_looks_alike(dense):
    found = merged(dense)
    assert 1600 / GROUP <= len(found.gaussians) < 800
    assert found.gaussians.valid().all()
    values = sigmoid(3 * dense.means)  # as colours are, much the same nearby
    camera = random_camera(2)
    want, want_alpha = ReferenceRasterizer().view(dense, camera).splat(values)
    image, alpha = ReferenceRasterizer().view(found.gaussians, camera).splat(found.values(values))
    assert psnr(image, want) > 27  # measured 29.1
    assert psnr(alpha, want_alpha) > 23  # measured 24.0: the ball's rim is much of so small a picture
    assert found.values(None) is None
    np.testing.assert_allclose(found.weights.sum(1), 1, rtol=1e-6)
    assert sorted(found.sources[found.weights > 0]) == list(range(1600))  # every row counts once


@pytest.mark.parametrize("count", [0, 1, 3, 4, 5])
def test_merge_takes_any_number_of_gaussians(count):
    found = merged(random_gaussians(count))
    assert len(found.gaussians) == len(found.weights) <= count
    values = found.values(np.ones((count, 2)))
    np.testing.assert_allclose(values, np.ones((len(found.gaussians), 2)), rtol=1e-6)


def test_merged_extremes_are_drawable():
    """Flat axes, points, the largest scales and full opacity; rows that cannot be drawn are left out."""
    hard = random_gaussians(16)
    hard.log_scales[:4, 0] = -np.inf
    hard.log_scales[4:8] = -np.inf
    hard.means[:12] = 0.5
    hard.log_scales[8:12] = 80
    hard.opacity_logits[:] = np.tile([np.inf, -np.inf, 90, 0], 4)
    hard.means[13], hard.quats_wxyz[15] = np.nan, 0
    with np.errstate(all="raise", under="ignore"):
        found = merged(hard)
    assert found.gaussians.valid().all()
    assert not set(found.sources.ravel().tolist()) & {13, 15}


# Phrases as they are written.

KEYS = {
    "red mug": ("red mug", '"red mug"', "'Red  Mug'", "“red mug”", "«red mug»", "(red) mug.", "red mug!?",
                " - red mug … ", "red mug\u200b", "red, mug,", "*red* _mug_", "ｒｅｄ　ｍｕｇ"),
    "the dogs' t-shirt & the child's cup": ("The dogs' T-shirt & the child’s cup",),
    "杯子": ("杯子。",),
    "café": ("cafe\u0301", "CAFÉ"),
    "☕": ("☕",),
    "": ("", " \n\t", "'?!'", "...", "\x00", ",;,", "\u200b"),
}  # fmt: skip


@pytest.mark.parametrize(("key", "text"), [(key, text) for key, texts in KEYS.items() for text in texts])
def test_quotes_and_punctuation_are_no_part_of_a_phrase(key, text):
    assert phrase_key(text) == key
    assert bool(tidy(text)) == bool(tokens(text)) == bool(split_phrases(text)) == bool(key)


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ('  "PLANT  pot" ', ["PLANT pot"]),
        ("mug , not 'red mug'!", ["mug, not red mug"]),
        (" , mug ,", ["mug"]),
        ("duck, penguin", ["duck", "penguin"]),
        ("杯子，书", ["杯子", "书"]),
        ('"mug", red book; plate, not red plate,, the cup, but not my cup',
         ["mug", "red book", "plate, not red plate", "the cup, but not my cup"]),
    ],
)  # fmt: skip
def test_phrases_in_a_line_are_separated(text, shown):
    assert split_phrases(text) == shown
    if len(shown) == 1:
        assert tidy(text) == shown[0]


@settings(max_examples=300)
@given(st.text(max_size=40))
@example(")\u0301")  # a mark over nothing
def test_a_tidy_phrase_stays_as_it_is(text):
    assert tidy(tidy(text)) == tidy(text)
    assert phrase_key(tidy(text)) == phrase_key(text)


# How cosines are read, and which thing a Gaussian belongs to.

N = 20


def test_probability_is_the_logistic_of_two_margins():
    odds = PlattScaling(-1.0, 18.0, 3.0, common=2.0)
    for fits in ((0.1, -0.2, 0.3), (-0.2, 0.1, 0.3), (-5.0, -4.0, -9.0)):
        logit = -1 + 18 * fits[2] + 3 * max(fits[:2])
        assert odds.probability(fits) == pytest.approx(1 / (1 + np.exp(-logit)))
        assert odds.probability(fits, -0.5) == pytest.approx(1 / (1 + np.exp(1 - logit)))
    far = odds.probability((-999.0, -999.0, -999.0)), odds.probability((999.0, 999.0, 999.0))
    assert 0 <= far[0] < 1e-9 < 1 - 1e-9 < far[1] <= 1
    assert type(far[0]) is float


@pytest.mark.parametrize(
    "numbers",
    [(np.nan, 1, 0, 0.7), (0, np.inf, 0, 0.7), (0, 1, -np.inf, 0.7), (0, 0, 0, 0.7), (0, 1, -1, 0.7),
     (0, -2, 1, 0.7), (0, 1, 1, 0.49), (0, 1, 1, 1.01), (0, 1, 1, np.nan)],
)  # fmt: skip
def test_odds_rise_with_fits(numbers):
    with pytest.raises(ValueError, match=r"up to 1e\+06, rising with fits"):
        PlattScaling(*numbers)


LEAVES = np.array([0, 0, 1, 2, 2, NO_NODE, 3], np.int32)  # two subparts of a part of a whole; another whole
PARENTS = np.array([4, 4, 5, 5, 6, NO_NODE, NO_NODE], np.int32)
TREE = Tree(LEAVES, PARENTS, np.array([0, 0, 2, 0, 1, 2, 2], np.uint8), np.zeros((7, 2), np.uint16))


def test_nodes_are_nested_sets():
    assert TREE.at(0).tolist() == [0, 0, 1, 2, 2, NO_NODE, 3]
    assert TREE.at(1).tolist() == [4, 4, 4, 2, 2, NO_NODE, 3]
    assert TREE.at(2).tolist() == [6, 6, 6, 5, 5, NO_NODE, 5]
    members = [np.flatnonzero(TREE.members(node)).tolist() for node in range(TREE.count)]
    assert members == [[0, 1], [2], [3, 4], [6], [0, 1, 2], [3, 4, 6], [0, 1, 2]]
    found, values = TREE.gaussians(), np.random.default_rng(0).normal(size=(7, 2))
    assert [rows.tolist() for rows in found] == members
    np.testing.assert_allclose(found.sums(values), [values[rows].sum(0) for rows in members], atol=1e-12)
    voted = replace(TREE, votes=np.array([[0, 5]] * 5 + [[1, 2], [0, 1]], np.uint16))
    assert voted.voted_wholes.tolist() == [NO_NODE] * 3 + [5, 5, NO_NODE, 5]


@pytest.mark.parametrize(
    "changed",
    [
        {"leaves": LEAVES + 4},
        {"leaves": LEAVES - 1},
        {"leaves": LEAVES.astype(np.uint16)},
        {"parents": np.zeros(7, np.int32)},  # a parent of its own, or an earlier node
        {"parents": np.full(7, 7, np.int32)},
        {"levels": np.arange(7, dtype=np.uint8)},
        {"levels": np.array([1, 0, 2, 0, 0, 2, 2], np.uint8)},  # a part within a subpart
        {"votes": np.zeros((7, 3), np.uint16)},
    ],
)
def test_malformed_trees_are_refused(changed):
    with pytest.raises((ValueError, TypeError)):
        replace(TREE, **changed)


def test_taking_rows_of_a_field_takes_their_leaves():
    with pytest.raises(ValueError, match="leaves"):
        replace(random_field(N), tree=TREE)
    field = replace(random_field(len(LEAVES)), tree=TREE)
    mask = np.arange(len(LEAVES)) % 2 == 1
    for rows in (np.array([5, 3, 3, 0]), mask, np.zeros(0, int)):
        taken = field.take(rows)
        np.testing.assert_array_equal(taken.tree.at(1), TREE.at(1)[rows])
        assert len(taken) == len(LEAVES[rows])
    assert random_field(N).take(np.arange(3)).tree is None


# A transformed scene seen by the transformed camera is the scene that was there before.

TO = rotating(np.array([1.0, -2.0, 0.5]), 77).then(scaling(1.7)).then(moving(np.array([3.0, -1.0, 2.0])))
TURNS = [rotating(axis, degrees) for axis in AXES.values() for degrees in (90, 180)] + [TO]


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("perspective", [True, False])
def test_the_transformed_scene_looks_the_same(degree: int, perspective: bool) -> None:
    """To the float64 reference; the Gaussians themselves are rounded to float32."""
    gaussians, camera = random_gaussians(40, seed=3, sh_degree=degree), random_camera(4)
    camera = camera if perspective else without_perspective(camera)
    want = render(Scene(gaussians), camera, backend="reference").colours
    for to in (*TURNS, scaling(0.5)):
        moved = Scene(transform_gaussians(gaussians, to))
        seen = render(moved, to.camera(camera), backend="reference").colours
        np.testing.assert_allclose(seen, want, atol=2e-5)


def test_transforms_compose_and_lead_back():
    points = np.random.default_rng(0).normal(size=(20, 3))
    other = rotating(AXES["y"], 12).then(scaling(0.25))
    np.testing.assert_allclose(TO.then(other).points(points), other.points(TO.points(points)), atol=1e-12)
    np.testing.assert_allclose(TO.then(TO.inverse()).matrix, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(TO.then(other).matrix, other.matrix @ TO.matrix, atol=1e-12)
    np.testing.assert_allclose(similarity(TO.matrix).matrix, TO.matrix, atol=1e-12)
    centre = np.array([1.0, 2.0, 3.0])
    turned = rotating(AXES["z"], 30).then(scaling(3)).about(centre)
    np.testing.assert_allclose(turned.points(centre[None])[0], centre, atol=1e-12)
    half = rotating(AXES["z"], 90).then(rotating(AXES["z"], 90))
    assert half.then(half).is_identity
    assert rotating(AXES["x"], -360).is_identity


@pytest.mark.parametrize("onto", [*AXES.values(), np.array([1.0, 1.0, 1e-9])])
def test_a_direction_is_turned_onto_another(onto) -> None:
    for start in (*AXES.values(), np.array([0.3, -2.0, 0.1])):
        np.testing.assert_allclose(turning(start, onto).rotation @ unit(start), unit(onto), atol=1e-9)


@pytest.mark.parametrize(
    ("matrix", "reason"),
    [
        (np.diag([1.0, 1, -1, 1]), "mirrors"),
        (np.diag([1.0, 1, 0, 1]), "flat"),
        (np.zeros((4, 4)) + np.diag([0, 0, 0, 1.0]), "flat"),
        (np.diag([1.0, 1, 2, 1]), "unlike"),
        (np.eye(4) + 0.2 * np.eye(4, k=1) * [[1], [0], [0], [0]], "shears"),
        (np.eye(4) * [1, 1, 1, 2.0], "last row"),
        (np.full((4, 4), np.nan), "finite"),
    ],
)
def test_a_matrix_that_is_no_similarity_is_refused(matrix, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        similarity(matrix)


def test_transforms_beyond_float32_are_refused():
    for make in (
        *(lambda factor=factor: scaling(factor) for factor in (0, -1, np.inf)),
        lambda: moving(np.array([np.nan, 0, 0])),
        lambda: rotating(np.zeros(3), 90),
        lambda: rotating(AXES["x"], np.inf),
        lambda: transform_gaussians(random_gaussians(3), scaling(1e39)),
        lambda: transform_gaussians(random_gaussians(3), moving(np.array([1e39, 0, 0]))),
        lambda: transform_scene(Scene(random_gaussians(3), cameras=(random_camera(),)), scaling(1e12)),
    ):
        with pytest.raises(InputError):
            make()


def test_invalid_rows_stay_invalid_when_transformed():
    """Zero quaternions, flat axes, places that are not finite: as they were, and no warning."""
    gaussians = random_gaussians(6, sh_degree=3)
    gaussians.quats_wxyz[0] = 0
    gaussians.log_scales[1, 2] = -np.inf
    gaussians.means[2] = [np.nan, np.inf, 0]
    gaussians.sh[3, 5] = np.nan
    gaussians.opacity_logits[4] = np.inf
    moved = transform_gaussians(gaussians, TO)
    np.testing.assert_array_equal(moved.valid(), gaussians.valid())
    assert moved.log_scales[1, 2] == -np.inf
    assert (moved.quats_wxyz[0] == 0).all()


def test_cameras_and_scale_are_transformed_along():
    """The language field is the same object, cameras move, a metre stays a metre."""
    scene = Scene(random_gaussians(9), random_field(9), (random_camera(),), metres_per_unit=0.5)
    moved = transform_scene(replace(scene, extras={"age": np.arange(9.0)}), TO)
    assert moved.language is scene.language
    assert moved.extras["age"].tolist() == list(range(9))
    assert moved.metres_per_unit == pytest.approx(0.5 / TO.scale)
    np.testing.assert_allclose(moved.cameras[0].position, TO.points(scene.cameras[0].position[None])[0])
    np.testing.assert_allclose(moved.up(), TO.rotation @ scene.up(), atol=1e-12)
    assert transform_scene(scene, IDENTITY) is scene


@pytest.mark.parametrize("chosen", [[], [4], range(9)])
def test_selected_gaussians_are_transformed_alone(chosen) -> None:
    gaussians, selected = random_gaussians(9, sh_degree=2), np.isin(np.arange(9), list(chosen))
    whole = transform_gaussians(gaussians, TO)
    moved = transform_scene(Scene(gaussians), TO, selected).gaussians
    assert_same(moved.take(~selected), gaussians.take(~selected))
    assert_same(moved.take(selected), whole.take(selected))


def test_the_near_plane_is_that_of_the_profile_or_what_is_seen():
    scene = Scene(random_gaussians(300, 1), cameras=tuple(random_camera(seed) for seed in range(3)))
    assert scene.raster_settings().near == scene.near
    assert scene.raster_settings(INRIA).near == INRIA.near
    near = replace(scene.cameras[0], fx=1e4, fy=1e4)  # sees little
    assert near_plane(scene.gaussians, [near], scene.near) <= scene.near

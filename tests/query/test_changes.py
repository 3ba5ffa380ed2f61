"""Two scenes of one place: what appeared, is gone, moved or has another colour, and nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.query.changes import Change, changes, colour_term, to_lab
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import QueryEngine
from langsplat_core.raster import load_lifting_rasterizer
from langsplat_core.scene import Scene
from tests.support.fakes import CENTRES, PER_BLOB, WORDS, FakeEncoder, named_scene

MUG, BOOK, PLANT = (slice(k * PER_BLOB, (k + 1) * PER_BLOB) for k in range(3))


def taken(scene: Scene, rows: slice) -> Scene:
    kept = np.ones(len(scene.gaussians), bool)
    kept[rows] = False
    return replace(scene.take(kept), cameras=scene.cameras)


def with_gaussians(scene: Scene, **changed: Array) -> Scene:
    return replace(scene, gaussians=replace(scene.gaussians, **changed))


def compared(first: Scene, second: Scene, placed: Array | None = None) -> tuple[Change, ...]:
    engines = [QueryEngine(scene, lambda _: FakeEncoder()) for scene in (first, second)]
    return changes(*engines, load_lifting_rasterizer("cpu"), placed)


@pytest.fixture
def scene() -> Scene:
    """Three blobs before a wall: what is gone uncovers something."""
    made = named_scene()
    g = made.gaussians
    x, y = np.meshgrid(np.linspace(-4, 4, 33), np.linspace(-3, 3, 25))
    wall = np.stack([x.ravel(), y.ravel(), np.full(x.size, 1.6)], 1)
    n = len(wall)
    assert made.language is not None
    field = made.language
    return replace(
        made,
        gaussians=replace(
            g,
            means=np.concatenate([g.means, wall]),
            log_scales=np.concatenate([g.log_scales, np.tile(np.log([0.2, 0.2, 0.01]), (n, 1))]),
            quats_wxyz=np.concatenate([g.quats_wxyz, np.tile([1.0, 0, 0, 0], (n, 1))]),
            opacity_logits=np.concatenate([g.opacity_logits, np.full(n, 6.0)]),
            sh=np.concatenate([g.sh, np.full((n, 1, 3), 1.2)]),
        ),
        language=replace(
            field,
            latents=np.concatenate([field.latents, np.full((3, n, 1), 3, np.uint16)], 1),
            confidence=np.concatenate([field.confidence, np.ones((3, n), np.float32)], 1),
            tree=None,
        ),
    )


def noisy(scene: Scene, seed: int = 5) -> Scene:
    """The same from another training: every Gaussian a little elsewhere and of a little other colour."""
    rng, g = np.random.default_rng(seed), scene.gaussians
    means = g.means + rng.normal(scale=0.01, size=g.means.shape)
    return with_gaussians(scene, means=means, sh=g.sh + rng.normal(scale=0.05, size=g.sh.shape))


def test_nothing_changed_is_said_of_the_same_and_of_noise(scene):
    assert compared(scene, scene) == ()
    assert compared(scene, noisy(scene)) == ()


@pytest.mark.parametrize("number", range(3))
def test_gone_and_appeared_are_each_other_backwards(scene, number):
    rows = (MUG, BOOK, PLANT)[number]
    fewer = noisy(taken(scene, rows))
    for pair, kind in (((scene, fewer), "gone"), ((fewer, scene), "appeared")):
        (change,) = compared(*pair)
        assert change.kind == kind
        np.testing.assert_allclose(change.centre, CENTRES[number], atol=0.1)
        assert change.share > 0.8


def test_before_nothing_what_is_gone_is_told_by_who_looked_there():
    """The blobs alone: what the second capture did not see may still be there."""
    scene = named_scene()
    fewer = taken(scene, BOOK)
    (change,) = compared(scene, fewer)
    assert change.kind == "gone"
    assert compared(scene, replace(fewer, cameras=())) == ()


def test_a_move_is_one_change_and_has_its_length(scene):
    means = scene.gaussians.means.copy()
    means[PLANT] += (0.3, -0.2, -1.0)
    (change,) = compared(scene, with_gaussians(scene, means=means))
    assert change.kind == "moved"
    np.testing.assert_allclose(change.moved, (0.3, -0.2, -1.0), atol=0.05)
    assert change.distance == pytest.approx(np.linalg.norm((0.3, 0.2, 1.0)), abs=0.05)


def test_another_colour_is_named(scene):
    sh = scene.gaussians.sh.copy()
    sh[MUG] = sh[PLANT]
    (change,) = compared(scene, with_gaussians(scene, sh=sh))
    assert change.kind == "recoloured"
    assert change.colours == ("red", "blue")


def test_another_exposure_changes_nothing(scene):
    assert compared(scene, with_gaussians(scene, sh=scene.gaussians.sh - 0.9)) == ()


def test_names_are_the_words_of_the_encoder(scene):
    one, other = (QueryEngine(part, lambda _: FakeEncoder()) for part in (scene, noisy(taken(scene, BOOK))))
    describers = Describer(one, WORDS), Describer(other, WORDS)
    (change,) = changes(one, other, load_lifting_rasterizer("cpu"), None, describers)
    assert change.name == "book"


def test_another_frame_and_scale_change_nothing(scene):
    """The second scene is the first one turned by 90 degrees, moved, and twice as large."""
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    g = scene.gaussians
    half = np.sqrt(0.5)
    turned = with_gaussians(
        scene,
        means=2 * g.means @ turn.T + (3.0, -1, 2),
        log_scales=g.log_scales + np.log(2),
        quats_wxyz=np.tile([half, 0, half, 0], (len(g), 1)),
    )
    into = np.eye(4)
    into[:3, :3], into[:3, 3] = turn.T / 2, -turn.T @ (3.0, -1, 2) / 2
    second = replace(turned, cameras=())  # those of the first are enough
    assert compared(scene, second, into) == ()
    (change,) = compared(scene, taken(second, MUG), into)
    np.testing.assert_allclose(change.centre, CENTRES[0], atol=0.1)


def test_what_cannot_be_compared_is_said(scene):
    blind = replace(scene, cameras=())
    with pytest.raises(InputError, match="cameras"):
        compared(blind, blind)
    for matrix in (np.eye(3), np.full((4, 4), np.nan), np.diag([1.0, 2, 1, 1]), np.zeros((4, 4))):
        with pytest.raises(InputError, match="matrix"):
            compared(scene, scene, matrix)
    with pytest.raises(InputError, match="language"):
        compared(scene, replace(scene, language=None))


def test_colours_are_those_of_cie():
    white, red = to_lab(np.array([[1.0, 1, 1], [1, 0, 0]]))
    np.testing.assert_allclose(white, (100, 0, 0), atol=0.1)
    np.testing.assert_allclose(red, (53.2, 80.1, 67.2), atol=0.2)  # of sRGB's red, D65
    assert [colour_term(to_lab(np.array(c))) for c in ((0.1, 0.3, 0.9), (0.95, 0.9, 0.3))] == [
        "blue",
        "yellow",
    ]

"""A compact scene keeps its error budget, its meaning and its order, or is not written; floaters go."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.arrays import Array, psnr
from langsplat_core.cli import run as command_line
from langsplat_core.datasets import Capture
from langsplat_core.errors import STRICTNESS, InputError
from langsplat_core.extensions.compaction import compact
from langsplat_core.extensions.compaction.clean import CleanConfig, CleanReport, clean, find_floaters
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.progress import silent
from langsplat_core.raster.reference import ReferenceRasterizer
from langsplat_core.scene import Camera, Gaussians, Scene, look_at
from langsplat_core.scene.gaussians import join_gaussians
from langsplat_core.scene.transform import moving, scaling, transform_scene
from tests.support.file_samples import random_field
from tests.support.hard_cases import balls
from tests.support.processes import contents
from tests.support.scenes import random_gaussians, tree_of_wholes

N = 400
CONFIG = compact.BudgetConfig(max_psnr_loss=0.3, max_side=64)


def cameras() -> tuple[Camera, ...]:
    angles = np.linspace(0, 2 * np.pi, 14, endpoint=False)
    eyes = 3 * np.stack([np.cos(angles), 0.3 * np.sin(3 * angles), np.sin(angles)], 1)
    return tuple(look_at(eye, np.zeros(3), [0, -1, 0], (64, 48)) for eye in eyes)


@pytest.fixture
def scene() -> Scene:
    """Half of it faint, so that there is something to drop; with every kind of companion."""
    gaussians = random_gaussians(N, seed=5, sh_degree=1, scale_range=(0.02, 0.1))
    gaussians.opacity_logits[::2] = -5.0
    gaussians.sh[:, 1:] *= 0.05
    extras = {"age": np.arange(N, dtype=np.float32)}
    tree = tree_of_wholes(np.arange(N) // 9)
    field = replace(random_field(N, phrases=("red mug", "door")), tree=tree)
    return Scene(gaussians, field, cameras(), extras=extras)


@pytest.fixture
def source(scene, tmp_path):
    save_scene(tmp_path / "scene.ply", scene)
    return tmp_path / "scene.ply"


@pytest.mark.long
def test_a_contribution_bounds_what_its_removal_changes():
    """One Gaussian on black, against the float64 reference: the picture is C = w c, and the score is
    sqrt(W (E + ALONE^2 W)) with E = sum w |c - C|^2, never less than sum w |c - C|."""
    gaussians = random_gaussians(12, seed=3, scale_range=(0.1, 0.3))
    camera = cameras()[0].resized(32, 24)
    for row in range(12):
        one = gaussians.take([row])
        score = compact.contributions(Scene(one), [camera])[0]
        weight = ReferenceRasterizer().view(one, camera).splat(np.ones((1, 1)))[0]
        colour = np.maximum(one.sh[0, 0].astype(float) * 0.28209479177387814 + 0.5, 0)
        distance = np.linalg.norm(colour * (1 - weight), axis=-1)  # |c - C|, with C = w c
        total = (weight[..., 0] * distance).sum()
        exact = np.sqrt(weight.sum() * (weight[..., 0] * (distance**2 + compact.ALONE**2)).sum())
        assert score == pytest.approx(exact, rel=1e-4, abs=1e-6)
        assert score >= total * (1 - 1e-4)


def test_loss_without_photographs_is_that_of_uncorrelated_errors(scene):
    """Photographs made as the picture plus noise of known strength: measured and derived loss agree."""
    view = scene.cameras[0].resized(256, 192)
    less, picture = scene.take(np.arange(N) % 9 > 0), compact.draw(scene, view)
    plain = compact.MeasuringView(view, picture)
    noise = np.random.default_rng(0).normal(0, 10 ** (-30 / 20), picture.shape)
    measured = compact.psnr_losses(less, [replace(plain, photograph=picture + noise)], 30.0)[0]
    derived = compact.psnr_losses(less, [plain], 30.0)[0]
    assert measured > 0.5
    assert derived == pytest.approx(measured, abs=0.1)  # the noise is finite: 147 000 numbers
    assert compact.estimated_loss(1e-3, 30.0) == pytest.approx(10 * np.log10(2))


def test_gaussians_that_any_view_needs_are_kept(scene):
    chosen = compact.choose_views(scene, None, CONFIG, silent)
    keep, _ = compact.find_reduction(scene, chosen, chosen.measured(scene), CONFIG)
    every = (*chosen.ranking, *chosen.measuring)
    score = compact.contributions(scene, every)
    each = [compact.contributions(scene, [view]) for view in every]
    np.testing.assert_array_equal(score, np.max(each, axis=0))
    assert 0 < (~keep).sum() < N
    assert score[~keep].max() <= score[keep].min()


def test_compact_file_keeps_budget_order_and_companions(scene, source, tmp_path):
    out = tmp_path / "out.ply"
    report = compact.compact_scene(source, out, CONFIG)
    small = load_scene(out)
    assert report.after.gaussians == len(small.gaussians) < 0.9 * N
    rows = small.extras["age"].astype(int)
    assert (np.diff(rows) > 0).all()
    count = small.gaussians.sh.shape[1]
    np.testing.assert_array_equal(small.gaussians.sh, scene.gaussians.sh[rows, :count])
    np.testing.assert_array_equal(small.language.latents, scene.language.latents[:, rows])
    np.testing.assert_array_equal(small.language.tree.leaves, scene.language.tree.leaves[rows])
    assert len(small.cameras) == len(scene.cameras)
    measured = compact.choose_views(scene, None, CONFIG, silent).measured(scene)
    losses = compact.psnr_losses(small, measured, CONFIG.assumed_psnr)
    assert losses.mean() == pytest.approx(report.loss)
    assert report.loss <= CONFIG.max_psnr_loss
    assert report.before.memory_bytes == 4 * N * (3 + 3 + 4 + 1 + 12 + 1 + 3 * 4) + 4 * N  # leaves
    sizes = [file.stat().st_size for file in tmp_path.iterdir() if file.name.startswith("out.")]
    assert len(sizes) == 3
    assert report.after.disk_bytes == sum(sizes)


def test_a_scene_without_cameras_is_seen_from_a_ring(scene, tmp_path):
    save_scene(tmp_path / "bare.ply", replace(scene, cameras=(), language=None))
    report = compact.compact_scene(tmp_path / "bare.ply", tmp_path / "out.ply", replace(CONFIG, views=12))
    assert "ring" in report.views_from
    centre, radius = scene.bounds()
    for camera in scene.spiral_cameras(12, (64, 48)):
        pixel, depth = camera.project(centre[None])
        assert depth[0] > radius
        np.testing.assert_allclose(pixel[0], (camera.width / 2, camera.height / 2), atol=1e-6)


def test_scenes_with_dots_in_their_names_keep_them(scene, tmp_path):
    save_scene(tmp_path / "a.v1.ply", scene)
    compact.Compact(tmp_path / "a.v1.ply", config=CONFIG).run()
    assert (tmp_path / "a.v1.compact.ply").exists()


@pytest.mark.parametrize(
    ("loss", "out", "named"),
    [(0.3, "scene.ply", "scene.ply"), (0.3, "out.xyz", ".xyz"), (1e-6, "out.splat", "format")],
)
def test_compact_refuses_unwritable_outputs(source, tmp_path, capsys, loss, out, named):
    """The source itself, an unknown format, and one whose eight bits alone cost more."""
    before = contents(tmp_path)
    command = compact.Compact(source, out=tmp_path / out, config=replace(CONFIG, max_psnr_loss=loss))
    assert command_line.main("langsplat", lambda: command) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("langsplat: ")
    assert named in said
    assert contents(tmp_path) == before


def test_strict_refuses_a_loss_before_the_work(scene, tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    save_scene(path, replace(scene, metres_per_unit=0.5))
    monkeypatch.setattr(STRICTNESS, "on", True)
    with pytest.raises(InputError, match="no room for"):
        compact.compact_scene(path, tmp_path / "b.spz", CONFIG, None, lambda *_: pytest.fail("worked"))


def test_unforeseen_loss_leaves_the_old_file(source, tmp_path, monkeypatch):
    out = tmp_path / "out.ply"
    compact.compact_scene(source, out, CONFIG)
    old = contents(tmp_path)

    monkeypatch.setattr(compact, "psnr_losses", lambda *_: np.array([0.0, 9.0]))  # a loss nobody foresaw
    with pytest.raises(InputError):
        compact.compact_scene(source, out, CONFIG)
    assert contents(tmp_path) == old


def test_bisection_weighs_counts_against_sh_degrees():
    def loss_of(count: int, sh_degree: int) -> float:
        return (1000 - count) / 1000 + 0.1 * (1 - sh_degree)

    count, degree = compact.smallest(1000, 1, loss_of, 0.3)
    assert degree == 0  # 800 of 14 numbers beat 700 of 23
    assert 800 <= count <= 800 + 1000 // 256 + 1
    assert compact.smallest(1000, 1, lambda *_: 1.0, 0.3) is None
    assert compact.smallest(1000, 1, lambda *choice: 0.0 if choice == (1000, 1) else 1.0, 0.3) == (1000, 1)


def test_photographs_held_out_from_training_measure(scene, source, tmp_path, monkeypatch):
    """The dataset has two views more than the scene was trained on, and noise that the scene lacks."""
    rng = np.random.default_rng(0)
    shot = [replace(camera, name=f"v{i}") for i, camera in enumerate(scene.cameras)]
    pictures = [compact.draw(scene, camera) for camera in shot]
    noisy = [np.clip(255 * p + rng.normal(0, 12, p.shape), 0, 255).astype(np.uint8) for p in pictures]
    capture = Capture(tuple(shot), tuple(noisy), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    monkeypatch.setattr(compact, "load_capture", lambda *_: capture)
    save_scene(source, replace(scene, cameras=tuple(shot[2:])))
    report = compact.compact_scene(source, tmp_path / "out.ply", CONFIG, photos=tmp_path)
    assert (report.ranking_views, report.measuring_views) == (12, 2)
    assert report.assumed_psnr is None
    assert report.before.psnr - report.after.psnr == pytest.approx(report.loss)
    truth = [psnr(p, n.astype(np.float32) / 255) for p, n in zip(pictures[:2], noisy[:2], strict=True)]
    assert report.before.psnr == pytest.approx(np.mean(truth), abs=1e-3)
    strangers = replace(capture, images=tuple(255 - image for image in noisy))
    monkeypatch.setattr(compact, "load_capture", lambda *_: strangers)
    with pytest.raises(InputError, match="something else"):
        compact.compact_scene(source, tmp_path / "out.ply", CONFIG, photos=tmp_path)


# Floaters go, the surface stays, and the budget holds.

CLEAN = CleanConfig(max_side=64)
WALL, FLOATERS = np.arange(24**2), 24**2 + np.arange(12)  # rows


def coloured(means, scale: float, opacity: float) -> Gaussians:
    sh = np.random.default_rng(0).uniform(-1, 1, (len(means), 1, 3))
    x, y, z = np.transpose(means)
    return replace(balls(z, opacity, scale, x, y), sh=sh)


@pytest.fixture
def dirty() -> Scene:
    """A wall of 576, then a single, a clump of ten and a large veil before it; cameras in front."""
    x, y = (side.ravel() for side in np.meshgrid(*[np.linspace(-1, 1, 24)] * 2))
    parts = (
        coloured(np.stack([x, y, 0 * x], 1), 0.04, 0.95),
        coloured([[0.0, -0.5, -0.7]], 0.03, 0.8),
        coloured([0.5, 0.4, -0.8] + 0.01 * np.random.default_rng(1).normal(size=(10, 3)), 0.02, 0.8),
        coloured([[-0.3, 0.2, -1.0]], 0.8, 0.1),
    )
    eyes = [np.array([x, y, -2.5]) for x in (-0.8, -0.3, 0.3, 0.8) for y in (-0.5, 0, 0.5)]
    seen_by = tuple(look_at(eye, np.zeros(3), [0, -1, 0], (64, 64)) for eye in eyes)
    return Scene(join_gaussians(list(parts)), cameras=seen_by)


def cleaned(scene: Scene, **changes: float) -> tuple[Array, CleanReport]:
    """Without photographs."""
    config = replace(CLEAN, **changes)
    return clean(scene, compact.choose_views(scene, None, config, silent), config)


def test_floaters_are_told_from_the_wall(dirty):
    suspicion, region = find_floaters(dirty, dirty.cameras, 100)
    np.testing.assert_array_equal(np.flatnonzero(suspicion), FLOATERS)
    np.testing.assert_array_equal(np.flatnonzero(region), FLOATERS[:11])
    # The size and place of the world are no matter.
    there = transform_scene(dirty, scaling(40).then(moving(np.array([300.0, 0, 0]))))
    np.testing.assert_array_equal(find_floaters(there, there.cameras, 100)[0], suspicion)


def test_photographs_let_all_floaters_go(dirty):
    """Of the wall alone: without floaters its images are these."""
    wall, held = dirty.take(WALL), dirty.cameras[1::3]
    photographs = tuple((255 * compact.draw(wall, camera)).round().astype(np.uint8) for camera in held)
    keep, report = clean(dirty, compact.Views(dirty.cameras[::3], held, photographs, "here"), CLEAN)
    np.testing.assert_array_equal(np.flatnonzero(~keep), FLOATERS)
    assert (report.regions, report.free_space, report.kept) == (11, 1, 0)
    assert report.loss < -1
    assert report.psnr_after > report.psnr_before


@pytest.mark.parametrize("budget", [0.0, 0.2, 50.0])
def test_cleaning_without_photographs_keeps_the_budget(dirty, budget):
    keep, report = cleaned(dirty, max_psnr_loss=budget)
    assert report.loss <= budget + 1e-9
    assert report.removed == (~keep).sum()
    assert report.removed + report.kept == 12
    assert keep[WALL].all()
    assert (report.removed == 12) == (budget == 50)


def test_cleaning_removes_invalid_rows(dirty):
    dirty.gaussians.means[5] = np.nan
    keep, report = cleaned(dirty)
    assert not keep[5]
    assert report.invalid == 1


@pytest.mark.parametrize("count", [1, 2, 40])
def test_cleaning_keeps_a_single_small_region(count):
    keep, report = cleaned(Scene(random_gaussians(count, scale_range=(0.5, 0.8))))
    assert keep.any()
    assert report.loss <= CLEAN.max_psnr_loss

"""`langsplat transform`, `crop` and `clean` on files: what belongs to a scene goes along, or nothing is
written."""

import json
from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.scene import Scene, TaughtWord
from langsplat_core.scene.tree import tree_of_wholes
from tests.support.commands import run
from tests.support.file_samples import random_field
from tests.support.scenes import random_camera, random_gaussians

N = 60


@pytest.fixture
def scene() -> Scene:
    """With every kind of companion, and none of its Gaussians far from a camera."""
    field = random_field(N, phrases=("red mug",))
    vector = np.eye(1, field.codec.vector_dim, dtype=np.float32)
    taught = (TaughtWord("thing", 2, vector, np.zeros(1, np.float32)),)
    field = replace(field, tree=tree_of_wholes(np.arange(N) // 9), taught=taught)
    extras = {"age": np.arange(N, dtype=np.float32)}
    cameras = tuple(random_camera(seed) for seed in range(3))
    return Scene(random_gaussians(N, sh_degree=3), field, cameras, extras=extras, metres_per_unit=0.5)


@pytest.fixture
def source(scene, tmp_path):
    save_scene(tmp_path / "scene.ply", scene)
    return tmp_path / "scene.ply"


def assert_companions(made: Scene, scene: Scene, rows) -> None:
    """The language field, tree, taught words, cameras and extra properties are those of `rows`."""
    field, expected = made.language, scene.language.take(rows)
    np.testing.assert_array_equal(field.latents, expected.latents)
    np.testing.assert_array_equal(field.tree.leaves, expected.tree.leaves)
    assert [word.name for word in field.taught] == ["thing"]
    assert list(field.phrasebook) == ["red mug"]
    assert len(made.cameras) == len(scene.cameras)
    np.testing.assert_array_equal(made.extras["age"], scene.extras["age"][rows])


def test_transform_moves_everything(scene, source, tmp_path, capsys):
    """A quarter turn about z, twice the size, and a move, in that order, whatever the order of options."""
    out = tmp_path / "out.ply"
    assert run("transform", source, out, "--move", 1, 2, 3, "--scale", 2, "--rotate", "z", 90) == 0
    made = load_scene(out)
    x, y, z = scene.gaussians.means.T
    np.testing.assert_allclose(
        made.gaussians.means, np.stack([1 - 2 * y, 2 + 2 * x, 3 + 2 * z], 1), atol=1e-5
    )
    assert made.metres_per_unit == pytest.approx(0.25)
    assert_companions(made, scene, np.arange(N))
    assert f"{N} Gaussians, 3 cameras" in capsys.readouterr().out


def test_transform_and_its_inverse_by_matrix(scene, source, tmp_path):
    there, back = tmp_path / "there.ply", tmp_path / "back.ply"
    matrix = [0, -2, 0, 5, 2, 0, 0, 6, 0, 0, 2, 7, 0, 0, 0, 1]
    assert run("transform", source, there, "--matrix", *matrix) == 0
    assert run("transform", there, back, "--matrix", *np.linalg.inv(np.reshape(matrix, (4, 4))).ravel()) == 0
    np.testing.assert_allclose(load_scene(back).gaussians.means, scene.gaussians.means, atol=1e-5)
    np.testing.assert_allclose(load_scene(back).gaussians.sh, scene.gaussians.sh, atol=1e-5)


@pytest.mark.parametrize("axis", ["z", "-y"])
def test_up_becomes_the_axis(axis, source, tmp_path):
    out = tmp_path / "out.ply"
    assert run("transform", source, out, f"--up={axis}") == 0
    expected = {"z": [0, 0, 1], "-y": [0, -1, 0]}[axis]
    np.testing.assert_allclose(load_scene(out).up(), expected, atol=1e-6)


@pytest.mark.parametrize(
    ("words", "kept"),
    [
        (["--box", 0, 0, 0, -9, -9, -9], lambda x, y, z: (x <= 0) & (y <= 0) & (z <= 0)),
        (["--sphere", 0, 0, 0, 0.5], lambda x, y, z: x**2 + y**2 + z**2 <= 0.25),
        (["--plane", 0, 2, 0, 0.2], lambda x, y, z: y >= 0.1),
        (["--plane", 0, 1, 0, 0, "--plane", -1, 0, 0, 0], lambda x, y, z: (y >= 0) & (x <= 0)),
        (["--box", 0, 0, 0, 9, 9, 9, "--sphere", 0, 0, 0, 0.9, "--outside"],
         lambda x, y, z: ~((x >= 0) & (y >= 0) & (z >= 0) & (x**2 + y**2 + z**2 <= 0.81))),
    ],
)  # fmt: skip
def test_crop_keeps_what_lies_in_all_shapes(words, kept, scene, source, tmp_path):
    out = tmp_path / "out.ply"
    assert run("crop", source, out, *words) == 0
    rows = np.flatnonzero(kept(*scene.gaussians.means.astype(np.float64).T))
    assert 0 < len(rows) < N
    np.testing.assert_array_equal(load_scene(out).gaussians.means, scene.gaussians.means[rows])
    assert_companions(load_scene(out), scene, rows)


@pytest.mark.parametrize(
    "words",
    [
        ["transform", "--scale", 0],
        ["transform", "--rotate", "x", "inf"],
        ["transform", "--matrix", 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1],
        ["transform", "--move", 1e11, 0, 0],
        ["crop"],
        ["crop", "--sphere", 100, 0, 0, 1],
        ["crop", "--sphere", 0, 0, 0, -1],
        ["crop", "--plane", 0, 0, 0, 1],
        ["crop", "--box", -9, -9, -9, 9, 9, 9, "--outside"],
    ],
)
def test_what_cannot_be_done_writes_nothing(words, source, tmp_path, capfd):
    before = sorted(tmp_path.iterdir())
    command, *options = words
    assert run(command, source, tmp_path / "out.ply", *options) == 2
    assert len(capfd.readouterr().err.strip().splitlines()) == 1
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("command", ["transform", "crop", "clean"])
def test_the_original_is_never_replaced(command, source, capfd):
    content = source.read_bytes()
    box = ["--box", -9, -9, -9, 9, 9, 9] if command == "crop" else []
    assert run(command, source, source, *box) == 2
    assert "would replace" in capfd.readouterr().err
    assert source.read_bytes() == content


def test_a_scene_without_companions_and_far_away(tmp_path):
    gaussians = random_gaussians(N)
    far = replace(gaussians, means=gaussians.means + np.float32(1e6))
    save_scene(tmp_path / "far.ply", Scene(far))
    near = tmp_path / "near.ply"
    assert run("transform", tmp_path / "far.ply", near, "--move", -1e6, -1e6, -1e6) == 0
    made = load_scene(near)
    assert made.language is None
    assert np.abs(made.gaussians.means - gaussians.means).max() < 0.1  # float32's steps at a million
    assert run("crop", near, tmp_path / "half.ply", "--plane", 1, 0, 0, 0) == 0


def test_clean_says_what_went(scene, source, tmp_path, capsys):
    out = tmp_path / "out.ply"
    assert run("clean", source, out, "--region", 3, "--max-psnr-loss", 3, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    made = load_scene(out)
    assert len(made.gaussians) == N - report["removed"]
    assert report["loss"] <= 3
    assert_companions(made, scene, np.isin(scene.extras["age"], made.extras["age"]))

"""`langsplat convert` to every format that is written: what of a scene arrives, what the image loses; and
`transform`, `crop` and `clean`: what belongs to a scene goes along, or nothing is written."""

import json
import os
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.cli.export import Convert
from langsplat_core.io.scenes import companion_path, load_scene, save_scene
from langsplat_core.io.sidecar import SUFFIX as SIDECAR
from langsplat_core.io.sidecar import write_language
from langsplat_core.scene import Scene
from tests.support.file_kinds import taught_word
from tests.support.file_samples import assert_same_extras, random_field, sog_files, write_folder
from tests.support.processes import refusal, run
from tests.support.scenes import random_camera, random_extras, random_gaussians, tree_of_wholes


def full_scene(n: int = 30) -> Scene:
    cameras = tuple(random_camera(seed) for seed in range(3))
    return Scene(random_gaussians(n, sh_degree=1), random_field(n), cameras, antialiased=True)


def convert(source: Path, out: Path, rematch: Path | None = None) -> Scene:
    Convert(source, (out,), rematch).run()
    return load_scene(out)


def test_scenes_of_one_name_keep_their_own_sidecars(tmp_path):
    """Positions differ by rounding, so that one sidecar could not serve both."""
    save_scene(tmp_path / "a.ply", full_scene())
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for suffix in (".spz", ".splat"):
        convert(tmp_path / "a.ply", tmp_path / f"a{suffix}")
    assert {path: path.read_bytes() for path in before} == before
    assert load_scene(tmp_path / "a.ply").language is not None
    back = convert(tmp_path / "a.spz", tmp_path / "c" / "a.ply")  # and on to the other
    assert back.language is not None
    save_scene(tmp_path / "a.spz", replace(full_scene(), language=None))
    assert load_scene(tmp_path / "a.spz").language is None
    assert load_scene(tmp_path / "a.ply").language is not None


def test_rematch_keeps_cameras_mark_and_extras(tmp_path):
    whole = replace(full_scene(40), extras=random_extras(40))
    save_scene(tmp_path / "whole.ply", whole)
    save_scene(tmp_path / "edited.ply", replace(whole.take(np.arange(5, 40)), language=None))
    old = companion_path(tmp_path / "whole.ply", SIDECAR)
    # a sidecar that does not fit lies beside the edited file, as an editor that saves in place leaves it
    companion_path(tmp_path / "edited.ply", SIDECAR).write_bytes(old.read_bytes())
    Convert(tmp_path / "edited.ply", (tmp_path / "new.ply",), rematch=old).run()
    got = load_scene(tmp_path / "new.ply")
    assert len(got.cameras) == 3
    np.testing.assert_allclose(got.cameras[1].world_to_camera, whole.cameras[1].world_to_camera, atol=1e-12)
    assert got.antialiased
    assert_same_extras(got.extras, {name: values[5:] for name, values in whole.extras.items()})
    np.testing.assert_array_equal(got.language.latents, whole.language.latents[:, 5:])


def test_sources_are_not_replaced_by_another_name(tmp_path, capsys, monkeypatch):
    """Nor what lies beside it: a folder of SOG and a PLY of its name have one sidecar."""
    monkeypatch.chdir(tmp_path)
    write_folder(Path("a"), sog_files(random_gaussians(20)))
    write_language("a.langsplat.safetensors", random_field(20), load_scene("a").gaussians.means)
    save_scene("b.ply", full_scene())
    Path("link.ply").symlink_to("b.ply")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    pairs = ("a", "a.ply"), ("a/meta.json", "a.ply"), ("link.ply", "b.ply"), ("b.ply", "link.ply")
    for words in (*pairs, ("a", "b.ply", "--rematch", "b.langsplat.safetensors")):
        said = refusal(capsys, "convert", *words)
        assert re.search(r"would replace (that of )?the original scene", said)
        assert ("its a.langsplat.safetensors" in said) == (words[1] == "a.ply")  # which is what lies there
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    os.link("b.ply", "other name.ply")  # which is another file as soon as it is written
    assert run("convert", "b.ply", "--out", "other name.ply") == 0
    assert Path("b.ply").read_bytes() == before[tmp_path / "b.ply"]
    Path("a.langsplat.safetensors").unlink()
    assert run("convert", "a", "a.ply") == 0  # nothing beside the folder could be replaced


# `langsplat transform`, `crop` and `clean`.

N = 60


@pytest.fixture
def scene() -> Scene:
    """With every kind of companion, and none of its Gaussians far from a camera."""
    field = random_field(N, phrases=("red mug",))
    taught = (taught_word("thing", field.codec.vector_dim),)
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
    """A quarter turn about z, twice the size, a move, in any order of options; its matrix; an axis."""
    out = tmp_path / "out.ply"
    assert run("transform", source, out, "--move", 1, 2, 3, "--scale", 2, "--rotate", "z", 90) == 0
    made = load_scene(out)
    x, y, z = scene.gaussians.means.T
    moved = np.stack([1 - 2 * y, 2 + 2 * x, 3 + 2 * z], 1)
    np.testing.assert_allclose(made.gaussians.means, moved, atol=1e-5)
    assert made.metres_per_unit == pytest.approx(0.25)
    assert_companions(made, scene, np.arange(N))
    printed = capsys.readouterr().out.split(" cameras; ")[1].split()
    assert run("transform", source, tmp_path / "again.ply", *printed) == 0
    np.testing.assert_array_equal(load_scene(tmp_path / "again.ply").gaussians.means, made.gaussians.means)
    matrix = [0, -2, 0, 5, 2, 0, 0, 6, 0, 0, 2, 7, 0, 0, 0, 1]
    assert run("transform", source, tmp_path / "there.ply", "--matrix", *matrix) == 0
    want = scene.gaussians.means @ np.array([[0, 2, 0], [-2, 0, 0], [0, 0, 2]]) + (5, 6, 7)
    np.testing.assert_allclose(load_scene(tmp_path / "there.ply").gaussians.means, want, atol=1e-5)
    for axis, up in (("z", [0, 0, 1]), ("-y", [0, -1, 0])):
        assert run("transform", source, f"--up={axis}", "--out", tmp_path / "out.ply") == 0
        np.testing.assert_allclose(load_scene(tmp_path / "out.ply").up(), up, atol=1e-6)


def test_crop_keeps_what_lies_in_the_box(scene, source, tmp_path):
    out = tmp_path / "out.ply"
    assert run("crop", source, "--out", out, "--box", 0, 0, 0, -9, -9, -9) == 0
    rows = np.flatnonzero((scene.gaussians.means <= 0).all(1))
    assert 0 < len(rows) < N
    np.testing.assert_array_equal(load_scene(out).gaussians.means, scene.gaussians.means[rows])
    assert_companions(load_scene(out), scene, rows)


def test_clean_reports_what_it_removes(scene, source, tmp_path, capsys):
    out = tmp_path / "out.ply"
    assert run("clean", source, out, "--region", 3, "--max-psnr-loss", 3, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    made = load_scene(out)
    assert len(made.gaussians) == N - report["removed"]
    assert report["loss"] <= 3
    assert_companions(made, scene, np.isin(scene.extras["age"], made.extras["age"]))

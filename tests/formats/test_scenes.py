"""Scenes saved and loaded as a whole, with what lies beside them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.errors import InputError
from langsplat_core.io import (
    companion_path,
    language,
    load_gaussians,
    load_scene,
    save_scene,
    scene_files,
    write_language,
    write_ply,
)
from langsplat_core.scene import Scene
from tests.support.file_samples import compressed_ply, random_field, sog_files, write_folder
from tests.support.same import assert_same_field
from tests.support.scenes import random_camera, random_gaussians

N = 60


def full_scene(seed: int = 0) -> Scene:
    cameras = tuple(replace(random_camera(i), name=f"view.{i}") for i in range(3))
    return Scene(random_gaussians(N, seed, sh_degree=1), random_field(N, seed=seed), cameras)


def test_a_saved_scene_is_loaded_whole(tmp_path):
    want = full_scene()
    path = tmp_path / "new folder" / "scene.ply"
    save_scene(path, want)
    got = load_scene(path)
    np.testing.assert_array_equal(got.gaussians.sh, want.gaussians.sh)
    assert got.language is not None
    assert_same_field(got.language, want.language)
    assert [camera.name for camera in got.cameras] == ["view.0", "view.1", "view.2"]
    assert got.path == path
    assert sorted(p.name for p in path.parent.iterdir()) == [
        "scene.cameras.json",
        "scene.langsplat.safetensors",
        "scene.ply",
    ]


def test_a_scene_without_companions_removes_those_of_the_one_it_replaces(tmp_path):
    save_scene(tmp_path / "scene.ply", full_scene())
    save_scene(tmp_path / "scene.ply", Scene(random_gaussians(5)))
    assert [p.name for p in tmp_path.iterdir()] == ["scene.ply"]
    got = load_scene(tmp_path / "scene.ply")
    assert got.language is None
    assert got.cameras == ()


class Interrupted(BaseException):
    """Like KeyboardInterrupt, at a chosen place."""


@pytest.mark.parametrize("after", range(20))
def test_an_interruption_never_leaves_a_mixture(tmp_path, monkeypatch, after):
    """Saving over another scene is stopped before its `after`-th change of a file name."""
    path = tmp_path / "scene.ply"
    old, new = full_scene(0), full_scene(1)
    save_scene(path, old)
    changes = iter(range(100))
    for name in ("replace", "unlink"):
        original = getattr(Path, name)

        def step(self, *args, original=original, **kwargs):
            # removing leftovers is what happens after an interruption, not a step of the saving
            is_step = original.__name__ == "replace" or not self.name.startswith(".")
            if is_step and next(changes) == after:
                raise Interrupted
            return original(self, *args, **kwargs)

        monkeypatch.setattr(Path, name, step)
    try:
        save_scene(path, new)
        finished = True
    except Interrupted:
        finished = False
    monkeypatch.undo()
    got = load_scene(path)  # raises if the sidecar is of the other scene
    is_new = np.array_equal(got.gaussians.means, new.gaussians.means)
    assert is_new or np.array_equal(got.gaussians.means, old.gaussians.means)
    source = new if is_new else old
    if got.language is not None:
        assert_same_field(got.language, source.language)
    if finished:
        assert is_new
        assert got.language is not None
        assert got.cameras
    leftovers = [p.name for p in tmp_path.iterdir() if p.name.startswith(".")]
    assert not leftovers
    assert after < 8 or finished  # the parameters cover every step


def test_a_failure_while_writing_changes_nothing(tmp_path, monkeypatch):
    path = tmp_path / "scene.ply"
    save_scene(path, full_scene(0))
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}

    def full_disk(*args):
        raise OSError("No space left on device")

    monkeypatch.setattr("langsplat_core.io.write_ply", full_disk)
    with pytest.raises(OSError, match="No space"):
        save_scene(path, full_scene(1))
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_formats_that_are_not_written(tmp_path):
    with pytest.raises(InputError, match=r"scenes are written as \.ply, \.spz, \.splat"):
        save_scene(tmp_path / "scene.sog", full_scene())
    assert not list(tmp_path.iterdir())


def test_companions_lie_beside_every_kind_of_scene(tmp_path):
    scene = random_gaussians(N)
    packed = tmp_path / "a.compressed.ply"
    packed.write_bytes(compressed_ply(scene))
    folder = write_folder(tmp_path / "b.v2", sog_files(scene))
    for path, sidecar in (
        (packed, "a.compressed.langsplat.safetensors"),
        (folder, "b.v2.langsplat.safetensors"),
        (folder / "meta.json", "b.v2.langsplat.safetensors"),
    ):
        place = companion_path(path, language.SUFFIX)
        assert place == tmp_path / sidecar
        write_language(place, random_field(N), load_gaussians(path).means)
        loaded = load_scene(path)
        assert loaded.language is not None
        assert_same_field(loaded.language, random_field(N))


@pytest.mark.parametrize("inner", ["", "meta.json"])
def test_the_files_of_a_scene_are_its_own_and_its_companions(tmp_path, inner):
    folder = write_folder(tmp_path / "b", sog_files(random_gaussians(N)))
    meta, *images, sidecar, cameras = scene_files(folder / inner)
    assert meta == folder / "meta.json"
    assert {path.name for path in images} == {path.name for path in folder.iterdir()} - {"meta.json"}
    beside = (tmp_path / "b.langsplat.safetensors", tmp_path / "b.cameras.json")
    assert (sidecar, cameras) == beside
    assert scene_files(tmp_path / "b.ply") == (tmp_path / "b.ply", *beside)


def test_cameras_of_an_inria_model(tmp_path):
    model = tmp_path / "model"
    save_scene(model / "other.ply", full_scene())
    (model / "other.cameras.json").rename(model / "cameras.json")
    path = model / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    write_ply(path, random_gaussians(5))
    assert len(load_scene(path).cameras) == 3


def test_what_is_not_a_scene(tmp_path):
    (tmp_path / "a.obj").write_bytes(b"x")
    with pytest.raises(InputError, match=r"a\.obj: not a scene of a known kind; supported: \.ply, .*\.sog"):
        load_scene(tmp_path / "a.obj")
    for nowhere in ("nowhere", "nowhere.ply", "nowhere.sog", "n" * 5000 + ".ply", "nul\0.ply"):
        with pytest.raises(InputError, match="no such file"):
            load_scene(tmp_path / nowhere)
    write_ply(tmp_path / ("n" * 240 + ".ply"), random_gaussians(1))  # its companions' names would be too long
    assert load_scene(tmp_path / ("n" * 240 + ".ply")).language is None
    write_ply(tmp_path / "model" / "iteration_7" / "point_cloud.ply", random_gaussians(1))
    with pytest.raises(InputError, match=r"perhaps .*model/iteration_7/point_cloud\.ply"):
        load_scene(tmp_path / "model")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"a folder without meta\.json is not a scene$"):
        load_scene(tmp_path / "empty")


def test_an_unusable_companion_is_left_out_with_its_reason(tmp_path):
    save_scene(tmp_path / "scene.ply", full_scene())
    write_ply(tmp_path / "scene.ply", random_gaussians(N - 1))
    (reason,) = load_scene(tmp_path / "scene.ply").unread
    assert "made for 60 Gaussians, the scene has 59" in reason
    (tmp_path / "scene.langsplat.safetensors").unlink()
    (tmp_path / "scene.cameras.json").write_text("[")
    (reason,) = load_scene(tmp_path / "scene.ply").unread
    assert "scene.cameras.json: not readable as JSON" in reason


def test_a_scene_of_which_most_cannot_be_drawn_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    gaussians = random_gaussians(N)
    for broken, told in ((N // 2, False), (N // 2 + 1, True)):
        means = gaussians.means.copy()
        means[:broken] = np.nan
        write_ply(tmp_path / "a.ply", replace(gaussians, means=means))
        caplog.clear()
        assert len(load_scene(tmp_path / "a.ply").gaussians) == N
        assert bool(caplog.messages) == told
    assert f"52% of the {N} Gaussians cannot be drawn (position not finite)" in caplog.messages[0]

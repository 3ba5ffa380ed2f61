"""Opening scenes, without a window."""

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from langsplat_core.io import load_scene, save_scene
from langsplat_core.scene import Scene
from langsplat_viewer.actions import opening, queries, settings, viewpoint
from langsplat_viewer.options import say_compiling
from tests.support.fakes import blob_scene
from tests.support.windowless import SCENES, errors, settle


def test_open_shows_the_scene_from_its_first_camera(opened):
    state = opened.state
    assert state.scene is SCENES["blobs.ply"]
    assert state.opening is None
    assert state.latent.shape == (3, 360, 3)
    assert state.camera_index == 0
    assert_allclose(
        state.view.camera(160, 120).world_to_camera, state.scene.cameras[0].world_to_camera, atol=1e-9
    )


def test_unusable_gaussians_are_counted(viewer):
    scene = blob_scene(field=False)
    scene.gaussians.means[[3, 7]] = np.nan
    viewer.services = replace(viewer.services, load_scene=lambda path: scene)
    opening.open_scene(viewer, Path("holes.ply"))
    settle(viewer)
    assert viewer.state.messages[0].text == "holes.ply: 360 Gaussians; not drawn: 2 with position not finite"
    assert np.isfinite(viewer.state.view.camera(160, 120).world_to_camera).all()


def test_a_broken_file_leaves_the_open_scene_alone(opened):
    before = opened.state.view
    opening.open_scene(opened, Path("broken.ply"))
    settle(opened)
    assert opened.state.scene is SCENES["blobs.ply"]
    assert opened.state.view is before
    assert opened.state.opening is None
    assert errors(opened) == ["broken.ply: broken; export it again"]


def test_opening_another_scene_forgets_the_queries(opened):
    queries.ask(opened, "mug")
    settle(opened)
    opening.open_scene(opened, Path("bare.ply"))
    settle(opened)
    assert opened.state.queries == []
    assert opened.state.camera_index is None


def test_a_scene_without_language_field_says_what_makes_one(viewer):
    settings.set_display(viewer, "relevancy")
    opening.open_scene(viewer, Path("plain.ply"))
    settle(viewer)
    assert viewer.state.picture.display == "rgb"
    assert "langsplat train" in viewer.state.messages[-1].text
    queries.ask(viewer, "mug")
    settings.set_display(viewer, "latent")
    assert viewer.state.queries == []
    assert viewer.state.picture.display == "rgb"
    assert "langsplat train" in errors(viewer)[-1]


def test_the_window_stays_responsive_while_a_scene_is_read(viewer):
    release = threading.Event()

    def slow(path: Path) -> Scene:
        assert release.wait(10)
        return SCENES["blobs.ply"]

    viewer.services = replace(viewer.services, load_scene=slow)
    opening.open_scene(viewer, Path("blobs.ply"))
    viewpoint.tick(viewer, 0.0)  # returns although the file is still being read
    assert viewer.state.scene is None
    assert viewer.worker.current[0] == "opening blobs.ply"
    release.set()
    settle(viewer)
    assert viewer.state.scene is not None


def test_cancelled_opening_shows_nothing(viewer):
    release = threading.Event()

    def slow(path: Path) -> Scene:
        assert release.wait(10)
        return SCENES["blobs.ply"]

    viewer.services = replace(viewer.services, load_scene=slow)
    opening.open_scene(viewer, Path("blobs.ply"))
    opening.cancel(viewer)
    assert viewer.worker.current is None
    assert viewer.state.opening is None
    release.set()
    viewer.worker.submit("after it", lambda progress: None, lambda nothing: None, pytest.fail)
    settle(viewer)
    assert viewer.state.scene is None


def test_a_scene_with_broken_companions_opens_and_says_why(tmp_path, viewer):
    path = tmp_path / "a.ply"
    save_scene(path, replace(blob_scene(), path=None))
    names = ("a.cameras.json", "a.langsplat.safetensors")
    for name in names:
        (tmp_path / name).write_bytes(b"{")
    viewer.services = replace(viewer.services, load_scene=load_scene)
    opening.open_scene(viewer, path)
    settle(viewer)
    assert viewer.state.scene.language is None
    said = errors(viewer)
    assert len(said) == 2
    assert all(name in reason for name, reason in zip(names, said, strict=True))


@pytest.mark.parametrize(
    ("names", "opened_name", "said"),
    [
        (["notes.txt", "plain.ply"], "plain.ply", "not opened: notes.txt"),
        (["blobs.cameras.json", "blobs.langsplat.safetensors", "blobs.ply"], "blobs.ply", ""),
        (["blobs.ply", *"abcde"], "blobs.ply", "not opened: a, b, c and 2 more"),
    ],
)
def test_of_dropped_files_the_scene_is_opened_and_what_is_none_is_said(viewer, names, opened_name, said):
    opening.open_dropped(viewer, [Path(name) for name in names])
    settle(viewer)
    assert viewer.state.path.name == opened_name
    assert [path.name for path in viewer.state.scenes] == [opened_name]
    assert errors(viewer) == ([said] if said else [])


def test_the_first_run_says_that_it_compiles(viewer, monkeypatch):
    seen = []

    def warm_up(scene, backend, progress):
        say_compiling(progress)
        seen.append(viewer.worker.current)

    monkeypatch.setattr("langsplat_core.compiled.is_compiled", lambda source: False)
    monkeypatch.setattr("langsplat_viewer.actions.opening.is_compiled", lambda source: False)
    viewer.services = replace(viewer.services, warm_up=warm_up)
    labels, submit = [], viewer.worker.submit
    monkeypatch.setattr(
        viewer.worker, "submit", lambda label, *rest: labels.append(label) or submit(label, *rest)
    )
    opening.open_scene(viewer, Path("blobs.ply"))
    settle(viewer)
    assert seen == [("compiling the drawing kernels, once per installation (half a minute)", 0.7)]
    assert "compiling the search kernels, once per installation (half a minute)" in labels
    assert errors(viewer) == []


def test_an_installation_that_was_used_before_says_nothing_of_it(viewer, monkeypatch):
    monkeypatch.setattr("langsplat_core.compiled.is_compiled", lambda source: True)
    say_compiling(lambda label, fraction: pytest.fail(label))

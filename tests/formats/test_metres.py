"""How long a unit is, as the header of a PLY says."""

from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.errors import FormatError, InputError
from langsplat_core.io import load_scene, save_scene, write_metres
from langsplat_core.io.ply import metres_by_comments, metres_comment
from langsplat_core.scene import Scene
from tests.support.fakes import blob_scene
from tests.support.file_samples import compressed_ply
from tests.support.scenes import random_gaussians


@pytest.mark.parametrize("metres", [0.25, 1.0, 1 / 3, 1e-12, 12345.678])
def test_a_scene_keeps_its_scale(tmp_path, metres):
    scene = replace(blob_scene(), metres_per_unit=metres, antialiased=True)
    save_scene(tmp_path / "a.ply", scene)
    back = load_scene(tmp_path / "a.ply")
    assert back.metres_per_unit == metres
    assert back.antialiased
    assert back.take(np.arange(3)).metres_per_unit == metres
    assert metres_by_comments((metres_comment(metres),)) == metres


@pytest.mark.parametrize(
    ("comments", "want"),
    [
        ((), None),
        (("made by hand", "metres_per_unit 2"), 2.0),
        (("metres_per_unit: 2.5e-1",), 0.25),
        (("metres_per_unit 2", "metres_per_unit 3"), 3.0),
        (("metres_per_unit 2", "metres_per_unit none"), None),
        (("metres_per_unit 0",), None),
        (("metres_per_unit -1",), None),
        (("metres_per_unit nan",), None),
        (("metres_per_unit inf",), None),
        (("metres_per_unit 2 3",), None),
    ],
)
def test_comments(comments, want):
    assert metres_by_comments(comments) == want


@pytest.mark.parametrize("wrong", [0.0, -1.0, np.nan, np.inf])
def test_no_scene_has_a_length_that_is_none(wrong, tmp_path):
    with pytest.raises(ValueError, match="must be above 0"):
        Scene(random_gaussians(2), metres_per_unit=wrong)
    save_scene(tmp_path / "a.ply", Scene(random_gaussians(2)))
    with pytest.raises(InputError, match="must be above 0"):
        write_metres(tmp_path / "a.ply", wrong)


def test_only_the_header_changes(tmp_path):
    path = tmp_path / "a.ply"
    save_scene(path, blob_scene())
    plain = path.read_bytes()
    write_metres(path, 0.5)
    write_metres(path, 0.25)
    head, body = path.read_bytes().split(b"end_header\n", 1)
    assert head.count(b"metres_per_unit") == 1
    assert head.replace(b"comment metres_per_unit 0.25\n", b"") + b"end_header\n" + body == plain
    scene = load_scene(path)
    assert scene.metres_per_unit == 0.25
    assert scene.language is not None  # the sidecar still fits


def test_other_plies_stay_what_they_are(tmp_path):
    path = tmp_path / "a.compressed.ply"
    path.write_bytes(compressed_ply(random_gaussians(300)))
    before = load_scene(path).gaussians
    write_metres(path, 2)
    after = load_scene(path)
    assert after.metres_per_unit == 2
    np.testing.assert_array_equal(after.gaussians.means, before.means)

    save_scene(path, Scene(random_gaussians(3)))
    head, body = path.read_bytes().split(b"end_header\n", 1)
    path.write_bytes(head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body)
    write_metres(path, 3)
    assert b"comment metres_per_unit 3.0\r\nend_header\r\n" in path.read_bytes()
    assert load_scene(path).metres_per_unit == 3


def test_what_cannot_keep_a_scale(tmp_path):
    save_scene(tmp_path / "a.spz", Scene(random_gaussians(3)))
    with pytest.raises(InputError, match="keeps a scale; make one"):
        write_metres(tmp_path / "a.spz", 1)
    with pytest.raises(InputError, match="no such file"):
        write_metres(tmp_path / "b.ply", 1)
    (tmp_path / "c.ply").write_bytes(b"plx\n")
    with pytest.raises(FormatError, match="not a PLY"):
        write_metres(tmp_path / "c.ply", 1)
    assert (tmp_path / "c.ply").read_bytes() == b"plx\n"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.spz", "c.ply"]

"""How files say that a scene was trained with antialiasing."""

import json

import pytest

from langsplat_core.io import load_scene, read_ply_scene, read_sog_scene, save_scene, write_ply
from langsplat_core.scene import Scene
from tests.support.file_samples import (
    compressed_ply,
    sog_files,
    write_folder,
)
from tests.support.scenes import random_gaussians

MARKS = [
    ((), False),
    (("Exported from Brush", "SplatRenderMode: mip"), True),
    (("SplatRenderMode: default",), False),
    (("SplatRenderMode: 2dgs",), False),
    (("  SPLATRENDERMODE:   MIP ",), True),
    (("SplatRenderMode:mip",), True),
    (("antialiased 1",), True),
    (("antialiased 0",), False),
    (("antialiased",), False),
    (("the antialiased 1 of them",), False),
    (("train_flags exposure antialiasing",), True),
    (("train_flags exposure",), False),
    (("antialiased 1", "SplatRenderMode: default"), False),
    (("SplatRenderMode: default", "antialiased 1"), True),
]


@pytest.mark.parametrize(("comments", "antialiased"), MARKS)
def test_the_marks_of_other_programs(tmp_path, comments, antialiased):
    write_ply(tmp_path / "a.ply", random_gaussians(3), comments)
    assert load_scene(tmp_path / "a.ply").antialiased is antialiased


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_mark_is_written_back(tmp_path, antialiased):
    save_scene(tmp_path / "a.ply", Scene(random_gaussians(3), antialiased=antialiased))
    assert load_scene(tmp_path / "a.ply").antialiased is antialiased
    assert (b"comment SplatRenderMode: mip\n" in (tmp_path / "a.ply").read_bytes()) is antialiased


def test_the_mark_of_a_compressed_ply(tmp_path):
    content = compressed_ply(random_gaussians(300))
    (tmp_path / "a.ply").write_bytes(content.replace(b"made by a test", b"antialiased 1"))
    assert read_ply_scene(tmp_path / "a.ply").antialiased
    (tmp_path / "a.ply").write_bytes(content)
    assert not read_ply_scene(tmp_path / "a.ply").antialiased


@pytest.mark.parametrize(
    ("entry", "antialiased"),
    [
        ({}, False),
        ({"model": "antialiased"}, True),
        ({"model": "2dgs"}, False),
        ({"model": ["antialiased"]}, False),
        ({"antialias": True}, True),
        ({"antialias": False}, False),
        ({"antialias": "no"}, False),
    ],
)
def test_the_mark_of_a_sog(tmp_path, entry, antialiased):
    files = sog_files(random_gaussians(20))
    files["meta.json"] = json.dumps(json.loads(files["meta.json"]) | entry).encode()
    assert read_sog_scene(write_folder(tmp_path / "a", files)).antialiased is antialiased

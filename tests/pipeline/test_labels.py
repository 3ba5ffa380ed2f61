"""Labels of Gaussians for other programs."""

import json
from dataclasses import replace

import numpy as np
import pytest

from langsplat_core.errors import InputError
from langsplat_core.io.scenes import load_scene
from langsplat_core.pipeline.labels import export_labels
from langsplat_core.query.describe import Describer
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import NO_NODE, Scene
from langsplat_core.scene.language import Tree
from tests.support.fakes import CENTRES, NAMES, PER_BLOB, WORDS, FakeEncoder, named_scene

LOOSE = 7  # Gaussians of the last blob that are in no node
PART = slice(PER_BLOB, PER_BLOB + 40)


def labelled_scene() -> Scene:
    """Wholes 3, 4, 5 with the blobs' names; node 0, some of the second blob, is a part of the first whole."""
    scene = named_scene()
    assert scene.language is not None
    leaves = np.repeat(np.arange(3, 6, dtype=np.int32), PER_BLOB)
    leaves[PART], leaves[-LOOSE:] = 0, NO_NODE
    parents = np.array([3, 4, 5, NO_NODE, NO_NODE, NO_NODE], np.int32)
    votes = np.ones((6, 2), np.uint16)
    tree = Tree(leaves, parents, np.array([2, 1, 1, 2, 2, 2], np.uint8), votes)
    extras = {"instance": np.zeros(len(leaves), np.uint8), "time": np.ones(len(leaves), np.float32)}
    return replace(scene, language=replace(scene.language, tree=tree), extras=extras)


def describer(scene: Scene) -> Describer:
    return Describer(QueryEngine(scene, lambda _: FakeEncoder()), NAMES)


def test_labels_are_those_of_the_tree_and_its_words(tmp_path):
    scene = labelled_scene()
    beside = export_labels(describer(scene), tmp_path / "out.ply")
    assert beside == tmp_path / "out.labels.json"
    got, said = load_scene(tmp_path / "out.ply"), json.loads(beside.read_text())
    assert set(got.extras) == {"instance", "part", "class", "time"}
    assert got.language is not None
    nodes = {node["node"]: node for node in said["nodes"]}
    whole = np.repeat([3, 4, 5], PER_BLOB)
    whole[PART], whole[-LOOSE:] = 3, NO_NODE
    np.testing.assert_array_equal(got.extras["instance"], whole)
    names = [None if number == NO_NODE else said["classes"][number] for number in got.extras["class"]]
    assert names == [None if node == NO_NODE else WORDS[node - 3] for node in whole]
    for blob, node in enumerate((3, 4, 5)):
        low, high = nodes[node]["box"]
        assert (np.less(low, CENTRES[blob]) & np.less(CENTRES[blob], high)).all()
        assert nodes[node]["gaussians"] == (whole == node).sum()
        assert nodes[node]["parent"] == NO_NODE
    np.testing.assert_array_equal(got.extras["part"][PART], 0)
    same = np.delete(np.arange(3 * PER_BLOB), PART)
    np.testing.assert_array_equal(got.extras["part"][same], whole[same])
    assert nodes[0]["parent"] == 3
    assert nodes[0]["word"] == WORDS[1]


def test_no_labels_are_left_where_the_scene_cannot_be_written(tmp_path):
    (tmp_path / "out.labels.json").mkdir()
    with pytest.raises(InputError, match=r"out\.labels\.json: is a folder"):
        export_labels(describer(labelled_scene()), tmp_path / "out.ply")
    assert [path.name for path in tmp_path.iterdir()] == ["out.labels.json"]

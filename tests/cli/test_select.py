"""`langsplat select` and `langsplat scale`."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData

from langsplat_core.arrays import Array
from langsplat_core.cli import select
from langsplat_core.cli.app import parse
from langsplat_core.cli.run import main
from langsplat_core.cli.scenes import Scale
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import Scene
from tests.support.fakes import CENTRES, PER_BLOB, FakeEncoder, axis, blob_scene


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, with a scene of a mug, a book and a plant. In its phrasebook are also "pair", both
    mug and plant, and "void", which is nothing."""
    scene = blob_scene(phrasebook=True)
    assert scene.language is not None
    pair = ((axis(0) + axis(2)) / np.sqrt(2)).astype(np.float32)
    known = dict(scene.language.phrasebook) | {"pair": pair, "void": axis(6)}
    extras = {"label": np.arange(len(scene.gaussians), dtype=np.int32)}
    language = replace(scene.language, phrasebook=known)
    save_scene(tmp_path / "a.ply", replace(scene, language=language, extras=extras, metres_per_unit=0.5))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(select, "load_text_encoder", lambda name: FakeEncoder())
    return tmp_path


def run(*words: str) -> int:
    return main("langsplat", lambda: parse(list(words)))


def blob_of(scene: Scene) -> list[int]:
    """How many Gaussians of each blob."""
    nearest = np.abs(scene.gaussians.means[:, :1] - CENTRES[:, 0]).argmin(1)
    return np.bincount(nearest, minlength=3).tolist()


def labels(scene: Scene) -> Array:
    return scene.extras["label"]


def test_a_thing_is_a_scene_of_its_own(folder, capsys):
    assert run("select", "a.ply", "mug", "--out", "mug.ply") == 0
    whole, mug = load_scene("a.ply"), load_scene("mug.ply")
    assert blob_of(mug)[1:] == [0, 0]
    assert 0.9 * PER_BLOB < len(mug.gaussians) <= PER_BLOB
    rows = labels(mug)
    np.testing.assert_array_equal(mug.gaussians.sh, whole.gaussians.sh[rows])
    assert mug.language is not None
    assert whole.language is not None
    np.testing.assert_array_equal(mug.language.latents, whole.language.latents[:, rows])
    assert set(mug.language.phrasebook) == {"book", "pair", "void"}
    assert len(mug.cameras) == len(whole.cameras)
    assert mug.metres_per_unit == 0.5
    assert QueryEngine(mug, lambda name: FakeEncoder()).run("mug").found
    assert "size, m" in capsys.readouterr().out


def test_removing_is_the_complement(folder):
    for words in ((), ("--remove",)):
        assert run("select", "a.ply", "book", "--out", f"{len(words)}.ply", *words) == 0
    with_it, without = (labels(load_scene(f"{k}.ply")) for k in (0, 1))
    assert sorted([*with_it, *without]) == list(range(3 * PER_BLOB))
    assert not QueryEngine(load_scene("1.ply")).run("book").found


@pytest.mark.parametrize(
    ("how", "want"), [("union", [1, 1, 0]), ("intersection", [1, 0, 0]), ("difference", [0, 0, 1])]
)
def test_several_phrases(folder, how, want):
    phrases = {"union": ("mug", "book"), "intersection": ("mug", "pair"), "difference": ("pair", "mug")}[how]
    assert run("select", "a.ply", *phrases, "--combine", how, "--out", "b.ply") == 0
    assert [count > 0.8 * PER_BLOB for count in blob_of(load_scene("b.ply"))] == [bool(k) for k in want]


def test_one_of_several_things(folder, capsys):
    assert run("select", "a.ply", "pair", "--out", "all.ply", "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert [thing["number"] for thing in answer["instances"]] == answer["taken"] == [1, 2]
    assert answer["written"] == answer["selected"] == len(load_scene("all.ply").gaussians)
    assert answer["metres_per_unit"] == 0.5
    assert run("select", "a.ply", "pair", "--out", "one.ply", "--instance", "2") == 0
    second = load_scene("one.ply")
    assert len(second.gaussians) == answer["instances"][1]["gaussians"]
    centre = second.gaussians.means.mean(0)
    np.testing.assert_allclose(centre, answer["instances"][1]["centre"], atol=0.05)


def test_growing_and_shrinking_are_in_metres(folder):
    sizes = {}
    for name, words in {"0": (), "g": ("--grow", "0.2"), "s": ("--shrink", "0.01")}.items():
        assert run("select", "a.ply", "book", "--out", f"{name}.ply", *words) == 0
        sizes[name] = len(load_scene(f"{name}.ply").gaussians)
    assert sizes["s"] <= sizes["0"] < sizes["g"]
    assert run("select", "a.ply", "book", "--out", "u.ply", "--grow", "0.4", "--scale", "1") == 0
    assert len(load_scene("u.ply").gaussians) == sizes["g"]


def test_points_and_hulls(folder, capsys):
    assert run("select", "a.ply", "mug", "--out", "p.ply", "--as", "points") == 0
    vertex = PlyData.read("p.ply")["vertex"]
    assert 0.9 * PER_BLOB < len(vertex["x"]) <= PER_BLOB
    assert vertex["relevancy"].min() > 0.5
    assert vertex["red"].mean() > 190 > 60 > vertex["green"].mean() > 40
    assert run("select", "a.ply", "pair", "--out", "h.obj", "--as", "hull") == 0
    assert "h.obj: 2 closed hulls" in capsys.readouterr().out
    assert [line for line in Path("h.obj").read_text().splitlines() if line[0] == "o"] == [
        "o pair_1",
        "o pair_2",
    ]
    assert run("select", "a.ply", "mug", "--out", "rest.ply", "--as", "points", "--remove") == 0
    assert len(PlyData.read("rest.ply")["vertex"]["x"]) >= 2 * PER_BLOB


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("void",), "'void' was not found"),
        (("mug", "void"), "'void' was not found"),
        (("spoon",), "does not know 'spoon'"),
        (("",), "empty"),
        ((), "no phrase given"),
        (("mug", "book", "--combine", "intersection"), "the intersection of 'mug', 'book' is empty"),
        (("mug", "--instance", "2"), "--instance 2: there are 1, numbered from 1"),
        (("mug", "--instance", "0"), "--instance 0"),
        (("mug", "--grow", "-1"), "--grow -1: must be 0 to 1e+09"),
        (("mug", "--shrink", "nan"), "--shrink nan"),
        (("pair", "--shrink", "9"), "nothing is left; shrink by less"),
        (("mug", "book", "plant", "--grow", "99", "--remove"), "the whole scene"),
        (("mug", "--as", "hull", "--remove"), "--as hull"),
        (("mug", "--as", "hull", "--out", "b.stl"), ".ply or .obj"),
        (("mug", "--as", "points", "--out", "b.spz"), "written as .ply"),
        (("mug", "--out", "b.sog"), "scenes are written as"),
        (("mug", "--out", "a.ply"), "would replace the original"),
        (("mug", "--out", "there/b.ply"), "there: no such folder for b.ply"),
        (("mug", "--scale", "0"), "--scale 0"),
    ],
)
def test_what_cannot_be_selected_is_said_in_a_line_and_nothing_is_written(folder, capsys, words, message):
    before = sorted(path.name for path in folder.iterdir())
    out = () if "--out" in words else ("--out", "b.ply")
    assert run("select", "a.ply", *words, *out) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert message in line
    assert sorted(path.name for path in folder.iterdir()) == before


def test_a_scene_without_a_field_cannot_be_asked(folder, capsys):
    save_scene("plain.ply", blob_scene(field=False))
    assert run("select", "plain.ply", "mug", "--out", "b.ply") == 2
    assert "no language field" in capsys.readouterr().err


def test_a_known_length_gives_the_scale(folder, capsys):
    assert run("scale", "a.ply", "--metres", "0.3", "--between", "-1", "0", "0", "0.2", "0", "0") == 0
    assert load_scene("a.ply").metres_per_unit == pytest.approx(0.25)
    assert "0.25 m per unit" in capsys.readouterr().out
    assert run("scale", "a.ply", "--metres-per-unit", "2") == 0
    assert run("scale", "a.ply") == 0
    assert capsys.readouterr().out.count("2 m per unit") == 2
    save_scene("plain.ply", blob_scene())
    assert run("scale", "plain.ply") == 0
    assert "no scale" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"metres": 1.0}, "belong together"),
        ({"between": (0, 0, 0, 1, 0, 0)}, "belong together"),
        ({"metres": 1.0, "between": (0, 0, 0, 0, 0, 0)}, "both must be above 0"),
        ({"metres": -1.0, "between": (0, 0, 0, 1, 0, 0)}, "both must be above 0"),
        ({"metres": 1.0, "between": (0, 0, 0, 1, 0, 0), "metres_per_unit": 1.0}, "give either"),
        ({"metres_per_unit": 0.0}, "must be above 0"),
    ],
)
def test_a_scale_that_is_none(folder, given, message):
    with pytest.raises(InputError, match=message):
        Scale(folder / "a.ply", **given).run()
    assert load_scene("a.ply").metres_per_unit == 0.5

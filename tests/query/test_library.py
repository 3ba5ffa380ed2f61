"""The index of scenes: its answers are the engine's, it follows its folder, and is refused when damaged."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.errors import EncoderError, FormatError, InputError
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.query import library as module
from langsplat_core.query.engine import QueryEngine
from langsplat_core.query.finding import find, judged
from langsplat_core.query.library import INDEX, MAGIC, fits_in, read_library, scenes_in, update_library
from langsplat_core.scene import Scene
from tests.support.fakes import NAMES, PER_BLOB, WORDS, FakeEncoder, axis, named_scene

MUG, BOOK, PLANT = (slice(k * PER_BLOB, (k + 1) * PER_BLOB) for k in range(3))


def without(scene: Scene, rows: slice) -> Scene:
    kept = np.ones(len(scene.gaussians), bool)
    kept[rows] = False
    return replace(scene.take(kept), cameras=scene.cameras)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Everything, nothing but mug and book, and a scene without a codebook; another without a field."""
    save_scene(tmp_path / "all.ply", named_scene())
    (tmp_path / "deep").mkdir()
    save_scene(tmp_path / "deep" / "few.ply", without(named_scene(), PLANT))
    save_scene(tmp_path / "linear.spz", named_scene(codebook=False))
    save_scene(tmp_path / "plain.ply", replace(named_scene(), language=None))
    return tmp_path


def load(name: str) -> FakeEncoder:
    return FakeEncoder()


def test_scenes_with_a_field_are_found_in_all_folders(folder):
    (folder / ".hidden").mkdir()
    save_scene(folder / ".hidden" / "scene.ply", named_scene())
    found = [path.relative_to(folder).as_posix() for path in scenes_in(folder)]
    assert found == ["all.ply", "linear.spz", "deep/few.ply"]
    with pytest.raises(InputError, match="no such folder"):
        scenes_in(folder / "elsewhere")


@pytest.mark.parametrize("phrase", WORDS)
def test_the_index_has_the_fits_of_the_engine(folder, phrase):
    group = update_library(folder, load_encoder=load).groups[0]
    vector = FakeEncoder().encode_texts([phrase])[0]
    for scene, fits in zip(group.scenes, fits_in(group, vector), strict=True):
        answer = QueryEngine(load_scene(folder / scene.path)).run(phrase, vector=vector)
        if scene.path == "linear.spz":
            assert not scene.is_indexed
            assert np.isneginf(fits).all()
        else:
            np.testing.assert_allclose(fits, answer.fits, atol=0.05)  # spreads; 8 bits of a codeword
            above, chance, verdict = judged(scene, fits, "thing")
            assert (verdict, chance) == (answer.verdict, answer.probability)
            assert above == pytest.approx(answer.excess, abs=0.2)


def test_the_best_scenes_come_first_and_with_a_place(folder):
    (answered,) = find(update_library(folder, load_encoder=load), "plant", load)
    names = [hit.path.name for hit in answered.hits]
    assert set(names[:2]) == {"all.ply", "linear.spz"}
    assert names[2] == "few.ply"
    assert (answered.count("found"), answered.count("not here")) == (2, 1)
    for hit in answered.hits[:2]:
        assert hit.answer is not None
        assert np.linalg.norm(hit.answer.place - [1.2, 0, 0]) < 0.2
        assert hit.picture is not None
        assert np.ptp(hit.picture) > 50
    assert answered.hits[2].answer is None


def test_only_what_has_changed_is_read_again(folder, monkeypatch):
    first = update_library(folder, load_encoder=load)
    read: list[str] = []
    whole = module.digest

    def noted(path: Path, name: str, encoder: object) -> module.Digest:
        read.append(name)
        return whole(path, name, load)

    monkeypatch.setattr(module, "digest", noted)
    again = update_library(folder, load_encoder=load)
    assert read == []
    assert [scene.path for scene in again.scenes] == [scene.path for scene in first.scenes]
    save_scene(folder / "all.ply", without(named_scene(), MUG))
    (folder / "linear.spz.langsplat.safetensors").unlink()
    third = update_library(folder, load_encoder=load)
    assert read == ["all.ply"]
    assert [scene.path for scene in third.scenes] == ["all.ply", "deep/few.ply"]
    assert {hit.path.name: hit.verdict for hit in find(third, "mug", load)[0].hits} == {
        "all.ply": "not here",
        "few.ply": "found",
    }


def test_an_interrupted_update_keeps_what_was_read(folder):
    def stop(report: object) -> None:
        if getattr(report, "fraction", 0) > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        update_library(folder, load_encoder=load, progress=module.Progress(stop))
    assert len(read_library(folder / INDEX, folder).scenes) == 2


def test_without_an_encoder_a_phrasebook_of_the_group_answers(folder):
    def none(name: str) -> FakeEncoder:
        raise EncoderError("no weights here")

    library = update_library(folder, load_encoder=none)
    (answered,) = find(library, NAMES[0], none)
    assert answered.count("found") == 3
    (unknown,) = find(library, "teapot", none)
    assert unknown.problem == "no weights here"


def test_scenes_of_two_encoders_are_two_groups(folder):
    scene = named_scene()
    field = replace(scene.language, canonical=np.tile(axis(4), (4, 1)), encoder_id="other")
    save_scene(folder / "other.ply", replace(scene, language=field))
    groups = find(update_library(folder, load_encoder=load), "mug", load)
    assert [(each.encoder_id, len(each.hits)) for each in groups] == [("fake", 3), ("other", 1)]


def test_a_scene_that_cannot_be_read_is_named(folder):
    (folder / "all.ply").write_bytes(b"ply\n")
    library = update_library(folder, load_encoder=load)
    (unread,) = library.unread
    assert unread.path == "all.ply"
    assert "all.ply" in unread.unread
    assert len(library.scenes) == 2


# Damaged and hostile index files.


def rewritten(index: Path, change: object) -> None:
    """The index with another header, its arrays as they were."""
    data = index.read_bytes()
    length = int.from_bytes(data[8:16], "little")
    header = json.loads(data[16 : 16 + length])
    change(header)  # type: ignore[operator]
    text = json.dumps(header).encode()
    rest = data[16 + length + (-length) % 8 :]
    index.write_bytes(MAGIC + len(text).to_bytes(8, "little") + text + bytes(-len(text) % 8) + rest)


def counts(header: dict, value: object) -> None:
    header["groups"][0][3][0][2] = value


HEADERS = {
    "scene outside": lambda header: header["groups"][0][3][0].__setitem__(0, "../../etc/x.ply"),
    "absolute": lambda header: header["groups"][0][3][0].__setitem__(0, "/etc/x.ply"),
    "too many": lambda header: counts(header, [2**40] * 5),
    "negative": lambda header: counts(header, [-1, 1, 1, 1, 1]),
    "text": lambda header: counts(header, "many"),
    "no groups": lambda header: header.pop("groups"),
    "huge vectors": lambda header: header["groups"][0].__setitem__(2, 2**50),
    "no numbers": lambda header: header["groups"][0][3][0].__setitem__(3, ["x"] * 20),
}


@pytest.mark.parametrize("name", HEADERS)
def test_a_header_that_lies_is_refused(folder, name):
    update_library(folder, load_encoder=load)
    rewritten(folder / INDEX, HEADERS[name])
    with pytest.raises(FormatError, match="remove it"):
        read_library(folder / INDEX, folder)


@pytest.mark.parametrize(
    "wound",
    [
        lambda data: b"",
        lambda data: b"LSLIB",
        lambda data: MAGIC + b"\xff" * 8,
        lambda data: MAGIC + bytes(8),
        lambda data: data[:-8],
        lambda data: data + bytes(8),
    ],
)
def test_what_is_no_whole_index_is_refused_and_made_again(folder, wound):
    update_library(folder, load_encoder=load)
    (folder / INDEX).write_bytes(wound((folder / INDEX).read_bytes()))
    for read in (
        lambda: read_library(folder / INDEX, folder),
        lambda: update_library(folder, load_encoder=load),
    ):
        with pytest.raises(FormatError):
            read()
    assert len(update_library(folder, load_encoder=load, rebuild=True).scenes) == 3


@pytest.mark.parametrize("column", ["words", "regions", "parents"])
def test_numbers_out_of_place_are_no_crash(folder, column):
    group = update_library(folder, load_encoder=load).groups[0]
    wrong: dict[str, Array] = {name: np.array(values) for name, values in group.columns.items()}
    wrong[column][0] = 2**30
    with pytest.raises(FormatError, match="damaged"):
        fits_in(replace(group, columns=wrong), axis(0))

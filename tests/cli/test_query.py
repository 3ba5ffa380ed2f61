"""`langsplat query`, `select`, `describe`, `teach` and `scale`."""

import itertools
import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.cli import describe, query
from langsplat_core.errors import EncoderError
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.io.sidecar import read_words
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import Scene
from langsplat_core.semantics.encoders import OPEN_MODEL
from tests.support.fakes import (
    CENTRES,
    NAMES,
    PER_BLOB,
    FakeEncoder,
    axis,
    blob_scene,
    blobs,
    calibrated_for,
    cameras,
    language,
    named_scene,
)
from tests.support.file_samples import assert_same_field
from tests.support.processes import refusal, run

SCENE = named_scene()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a scene of a mug, a book and a plant; "pair" is mug and plant, "void" nothing."""
    pair = ((axis(0) + axis(2)) / np.sqrt(2)).astype(np.float32)
    field = replace(language(), phrasebook={"book": axis(1), "pair": pair, "void": axis(6)})
    extras = {"label": np.arange(3 * PER_BLOB, dtype=np.int32)}
    scene = replace(blob_scene(), language=field, extras=extras, metres_per_unit=0.5)
    save_scene(tmp_path / "a.ply", scene)
    monkeypatch.chdir(tmp_path)
    for module in (query, describe):
        monkeypatch.setattr(module, "load_text_encoder", lambda name: FakeEncoder())
    return tmp_path


def lines(capsys, *words: str) -> list[str]:
    capsys.readouterr()
    assert run(*words) == 0
    return capsys.readouterr().out.splitlines()


def answers(capsys, *words: str):
    return json.loads("\n".join(lines(capsys, *words, "--json")))


def save_fake(**changes) -> None:
    """Write "b.ply", of which only the book is in the phrasebook."""
    save_scene("b.ply", Scene(blobs(), replace(language(phrasebook=True), **changes), cameras(1)))


def test_unaskable_phrases_are_named_before_searching(folder, monkeypatch, capsys):
    assert run("query", "a.ply", "mug", "plamt", "the", "book or sofa", '"book"', "--json") == 0
    out, err = capsys.readouterr()
    assert [answer["phrase"] for answer in json.loads(out)] == ["mug", "book"]
    plamt, the, sofa = err.splitlines()
    why = "the encoder does not know 'plamt' (did you mean 'plant'?)"
    assert plamt.startswith(f"langsplat: not asked: 'plamt': {why}")
    assert "'the' names nothing" in the
    assert "'book or sofa': the encoder does not know 'sofa';" in sofa
    monkeypatch.setattr(QueryEngine, "relevancy", lambda *_: pytest.fail("searched"))
    assert run("query", "a.ply", "sofa; ?", "the") == 2
    out, err = capsys.readouterr()
    assert (out, "does not know 'sofa'" in err) == ("", True)


def test_broken_encoder_is_tried_once_and_where_needed(folder, monkeypatch, capsys):
    tried = []

    def absent(name):
        tried.append(name)
        raise EncoderError("no weights here")

    monkeypatch.setattr(query, "load_text_encoder", absent)
    assert lines(capsys, "query", "a.ply", "  Book ")[0].startswith("Book: found")
    assert tried == []
    assert run("query", "a.ply", "mug", "book", "plant") == 0
    out, err = capsys.readouterr()
    assert out.startswith("book: found")
    assert err == "langsplat: not asked: 'mug', 'plant': no weights here\n"
    assert len(tried) == 1


def test_commas_separate_phrases_and_a_camera_gives_many_pixels(folder, capsys):
    found = answers(capsys, "query", "a.ply", "mug, plant; mug or book, not book")
    assert [answer["phrase"] for answer in found] == ["mug", "plant", "mug or book, not book"]
    assert [answer["reading"] for answer in found] == [None, None, "(mug  or  book)  without  book"]
    assert lines(capsys, "query", "a.ply", "mug or plant")[1] == "  read as: mug  or  plant"
    some = [" or ".join(names) for names in itertools.permutations(("mug", "book", "plant", "pair", "void"))]
    assert {answer["pixel"] for answer in answers(capsys, "query", "a.ply", *some)} == {None}
    together = answers(capsys, "query", "a.ply", *some, "--camera", "0")
    assert [answer["phrase"] for answer in together] == some
    assert together[-1:] == answers(capsys, "query", "a.ply", some[-1])


def test_query_lists_the_instances(folder, capsys):
    """Two of the three blobs are a "pair", in a scene whose unit is half a metre."""
    found, absent = answers(capsys, "query", "a.ply", "pair", "void")
    assert absent["instances"] == []
    assert found["metres_per_unit"] == 0.5
    assert (found["count"], absent["count"]["most"]) == ({"best": 2, "least": 1, "most": 2}, 0)
    assert [thing["number"] for thing in found["instances"]] == [1, 2]
    centres = sorted(thing["centre"][0] for thing in found["instances"])
    np.testing.assert_allclose(centres, [-1.2, 1.2], atol=0.1)
    for thing in found["instances"]:
        rotation = np.array(thing["oriented_box"]["rotation"])
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        np.testing.assert_allclose(thing["size"], 2 * np.array(thing["oriented_box"]["half_extents"]))
        assert 0.4 < thing["share"] < 0.6
    verdict, heading, row, _ = lines(capsys, "query", "a.ply", "pair", "--instances", "1")
    assert " m, pixel" in verdict
    assert "centre, m" in heading
    assert abs(float(row.split()[5])) == pytest.approx(0.6, abs=0.05)
    row = lines(capsys, "query", "a.ply", "pair", "--scale", "1")[2]
    assert abs(float(row.split()[5])) == pytest.approx(1.2, abs=0.1)


@pytest.mark.parametrize(
    ("logit", "verdict", "probability"),
    [(9.0, "found", 1.0), (1.0, "weak match", 0.73), (-3.0, "not here", 0.05)],
)
def test_query_prints_the_probability(folder, capsys, logit, verdict, probability):
    save_fake(calibration=calibrated_for("book", logit))
    (answer,) = answers(capsys, "query", "b.ply", "book")
    assert answer["probability"] == pytest.approx(probability, abs=0.01)
    said = lines(capsys, "query", "b.ply", "book")[0]
    assert said.startswith(f"book: {verdict}, {100 * answer['probability']:.0f} %, score ")
    assert said.endswith(", place none") == (verdict == "not here")
    assert (answer["verdict"], answer["found"]) == (verdict, verdict == "found")
    assert (answer["instances"] == []) == (verdict != "found")


def test_query_prints_chance_without_calibration(folder, capsys):
    save_fake()
    (answer,) = answers(capsys, "query", "b.ply", "book")
    assert (answer["probability"], answer["encoder"], answer["calibration"]) == (None, "fake", None)
    said = lines(capsys, "query", "b.ply", "book")
    assert said[0].startswith("book: found, by chance ")
    assert said[0].startswith(f"book: {answer['said']}, score ")
    save_fake(encoder_id="demo")
    *said, last = lines(capsys, "query", "b.ply", "book", "book")
    assert f"--clip.model {OPEN_MODEL}" in last
    assert not any(OPEN_MODEL in line for line in said)


# `langsplat select`.


def blob_of(scene: Scene) -> list[int]:
    nearest = np.abs(scene.gaussians.means[:, :1] - CENTRES[:, 0]).argmin(1)
    return np.bincount(nearest, minlength=3).tolist()


def test_select_writes_a_thing_and_remove_its_complement(folder, capsys):
    assert run("select", "a.ply", "mug", "--out", "mug.ply") == 0
    assert "size, m" in capsys.readouterr().out
    whole, mug = load_scene("a.ply"), load_scene("mug.ply")
    assert blob_of(mug)[1:] == [0, 0]
    assert 0.9 * PER_BLOB < len(mug.gaussians) <= PER_BLOB
    rows = mug.extras["label"]
    np.testing.assert_array_equal(mug.gaussians.sh, whole.gaussians.sh[rows])
    np.testing.assert_array_equal(mug.language.latents, whole.language.latents[:, rows])
    assert set(mug.language.phrasebook) == {"book", "pair", "void"}
    assert (len(mug.cameras), mug.metres_per_unit) == (len(whole.cameras), 0.5)
    assert QueryEngine(mug, lambda name: FakeEncoder()).run("mug").found
    assert run("select", "a.ply", "mug", "--out", "rest.ply", "--remove") == 0
    rest = load_scene("rest.ply")
    assert sorted([*rows, *rest.extras["label"]]) == list(range(3 * PER_BLOB))
    assert not QueryEngine(rest, lambda name: FakeEncoder()).run("mug").found


def test_select_takes_several_phrases_and_one_instance(folder, capsys):
    for phrases, want in ((("mug", "book"), [1, 1, 0]), (("pair, not mug",), [0, 0, 1])):
        assert run("select", "a.ply", *phrases, "--out", "b.ply") == 0
        assert [count > 0.8 * PER_BLOB for count in blob_of(load_scene("b.ply"))] == [bool(k) for k in want]
    assert capsys.readouterr()
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


def test_known_length_gives_the_scale(folder, capsys):
    assert run("scale", "a.ply", "--metres", "0.3", "--between", "-1", "0", "0", "0.2", "0", "0") == 0
    assert load_scene("a.ply").metres_per_unit == pytest.approx(0.25)
    assert "0.25 m per unit" in capsys.readouterr().out
    assert run("scale", "a.ply", "--metres-per-unit", "2") == 0
    assert run("scale", "a.ply") == 0
    assert capsys.readouterr().out.count("2 m per unit") == 2
    save_scene("plain.ply", blob_scene())
    assert run("scale", "plain.ply") == 0
    assert "no scale" in capsys.readouterr().out


# `langsplat describe`.


@pytest.fixture
def described(folder: Path) -> Path:
    """Scenes with everything, without field, without cameras and of another encoder; lists; a taught word."""
    save_scene("named.ply", SCENE)
    save_scene("plain.ply", Scene(SCENE.gaussians))
    save_scene("blind.ply", replace(SCENE, cameras=()))
    other = replace(SCENE.language, encoder_id="other", canonical=np.tile(axis(5), (4, 1)))
    save_scene("other.ply", replace(SCENE, language=other))
    Path("junk.safetensors").write_bytes(b"junk")
    Path("loop").symlink_to("loop")
    assert run("teach", "named.ply", "--name", "vase", "--at", MUG, "--into", "own.safetensors") == 0
    lists = {"empty": "# nothing", "bad": "mug\n???", "sofas": "sofa", "list": "\n".join([*NAMES, "sofa"])}
    for name, text in lists.items():
        Path(f"{name}.txt").write_text(text)
    return folder


def test_outline_and_inventory_are_printed_as_text_and_json(described, capsys):
    words = ("describe", "named.ply", "--vocabulary", "list.txt", "--outline")
    said = lines(capsys, *words)
    assert {line.split(":")[0] for line in said[:3]} == {"mug", "book", "plant"}
    found = answers(capsys, *words)["outline"]
    assert {node["word"]["phrase"] for node in found} == {"mug", "book", "plant"}
    for node in found:
        assert (node["level"], node["parts"]) == ("whole", [])  # their parts mean the same, or nothing
        assert sum(node["votes"]) == 0
        assert node["share"] == pytest.approx(1 / 3, abs=0.05)
        assert (np.diff(node["size"]) <= 0).all()
    words = words[:-1]
    said = "\n".join(lines(capsys, *words))
    assert "4 phrases compared, 1 left out" in said
    found = answers(capsys, *words)
    assert (found["asked"], found["left_out"]) == (4, 1)
    assert {entry["phrase"] for entry in found["inventory"]} == {"mug", "book", "plant"}
    for entry in found["inventory"]:
        assert (entry["level"], entry["probability"]) == ("whole", None)
        assert 0 < entry["softmax"] <= 1
        (spot,) = entry["spots"]
        np.testing.assert_allclose(spot["centre"], CENTRES[NAMES.index(entry["phrase"])], atol=0.1)


def test_export_says_why_nothing_can_be_asked(folder, capsys):
    field = replace(SCENE.language, phrasebook={}, encoder_id="./absent")
    save_scene("b.ply", replace(SCENE, language=field))
    (said,) = lines(capsys, "export", "b.ply", "b.html")
    assert said.endswith(" can be searched: its encoder ./absent is not here; name it with --encoder")


# `langsplat teach`, and `query` for what was taught.


def pixel_of(blob: int) -> str:
    """The pixel of the first camera in the middle of a blob, as the options have it."""
    means = SCENE.gaussians.means[blob * PER_BLOB : (blob + 1) * PER_BLOB].astype(np.float64)
    column, row = SCENE.cameras[0].project(means.mean(0)[None])[0][0].astype(int)
    return f"{column},{row}"


REPLACING = "convert,transform,clean,describe --labels"
NO_PIXELS = ("80", "a,b", "-1,2", "1,2,3", "1.5,2", "9" * 5000 + ",1", "٣,٣")
MUG, BOOK = pixel_of(0), pixel_of(1)


def test_scene_keeps_and_forgets_taught_words(described, capsys):
    before = load_scene("named.ply").language
    teach = ("teach", "named.ply", "--name", "grandma's vase")
    assert run(*teach, "--at", MUG) == 0
    (answer,) = answers(capsys, "query", "named.ply", "Grandma's vase")
    assert (answer["verdict"], answer["probability"], answer["level"]) == ("found", None, "whole")
    assert [one["gaussians"] for one in answer["instances"]] == [PER_BLOB]
    assert answer["pixel"] == pytest.approx([int(number) for number in MUG.split(",")], abs=12)
    assert run(*teach, "--at", BOOK) == 0
    (both,) = answers(capsys, "query", "named.ply", "grandma's vase")
    assert sum(one["gaussians"] for one in both["instances"]) == 2 * PER_BLOB
    assert run("select", "named.ply", "grandma's vase", "--out", "c.ply") == 0
    assert len(load_scene("c.ply").gaussians) == 2 * PER_BLOB
    assert run(*teach, "--remove") == 0
    assert_same_field(load_scene("named.ply").language, before)


def test_users_words_work_in_other_scenes(described, capsys):
    teach = ("--into", "words.safetensors", "--camera", "0")
    save_scene("b.ply", SCENE)
    untouched = Path("named.langsplat.safetensors").read_bytes()
    assert run("teach", "named.ply", "--name", "book", "--at", MUG, *teach) == 0
    assert run("teach", "named.ply", "--name", "wall", "--at", BOOK, "--level", "whole", *teach) == 0
    assert Path("named.langsplat.safetensors").read_bytes() == untouched
    assert [word.name for word in read_words("words.safetensors").words] == ["book", "wall"]
    book, mug = answers(capsys, "query", "b.ply", "book", "mug", "--taught", "words.safetensors")
    assert book["place"] == pytest.approx(mug["place"], abs=0.1)  # what was shown, in place of the text
    (plain,) = answers(capsys, "query", "b.ply", "book")
    assert plain["place"] != pytest.approx(book["place"], abs=0.1)
    assert run("teach", "named.ply", "--name", "Book", "--remove", *teach) == 0
    assert [word.name for word in read_words("words.safetensors").words] == ["wall"]
    assert run("select", "b.ply", "wall", "--out", "c.ply", "--taught", "words.safetensors") == 0
    assert len(load_scene("c.ply").gaussians) == PER_BLOB


@pytest.mark.parametrize("into", [None, Path("words.safetensors")])
def test_words_taught_at_once_are_all_kept(described, into):
    names = ("vase", "urn", "jar", "pot")
    with ThreadPoolExecutor(len(names)) as pool:
        list(pool.map(lambda name: describe.Teach(Path("named.ply"), name, MUG, into=into).run(), names))
    kept = load_scene("named.ply").language.taught if into is None else read_words(into).words
    assert {word.name for word in kept} == set(names)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("query a.ply", "no phrase given"),
        ("query a.ply book --camera 9", "--camera 9: the scene has cameras 0 to 2"),
        ("select a.ply void", "'void' was not found"),
        *((f"query a.ply mug {given} .", "--why or --segmenter") for given in ("--work", "--photographs")),
        ("query a.ply mug --segmenter absent", "name their folder with --photographs"),
        ("teach named.ply --name vase --remove --camera 1", "--camera: is only used with --at"),
        ("eval lerf-ovs . --maps . --encoder demo", "--encoder: is only used with a scene"),
        ("compact a.ply --photos . --assumed-psnr 30", "--assumed-psnr: the loss is measured"),
        ("convert a.ply b.spz --phrases mug", "are for checkpoints"),
        ("select a.ply spoon", "does not know 'spoon'"),
        ("select a.ply mug --instance 2", "--instance 2: there are 1, numbered from 1"),
        ("select a.ply mug book plant --remove", "the whole scene"),
        ("select a.ply mug --out a.ply", "would replace the original"),
        ("select a.ply mug --out there/b.ply", "there: no such folder for b.ply"),
        ("scale a.ply --metres 1", "belong together"),
        ("scale a.ply --metres 1 --between 0 0 0 0 0 0", "must be above 0"),
        ("scale a.ply --metres 1 --between 0 0 0 1 0 0 --metres-per-unit 1", "give either"),
        ("select plain.ply mug", "no language field (NAME.langsplat.safetensors) lies beside it"),
        ("describe named.ply --vocabulary empty.txt", "empty.txt: the vocabulary is empty"),
        ("describe named.ply --vocabulary bad.txt", "bad.txt, line 2"),
        ("describe named.ply --vocabulary sofas.txt", "knows none of the vocabulary's 1 phrases"),
        (f"teach named.ply --name the --at {MUG}", "'the' cannot be a name"),
        ("teach named.ply --name vase", "give either --at X,Y, a pixel to teach, or --remove"),
        ("teach named.ply --name vase --at 0,0", "--at 0,0: nothing is there in camera 0"),
        ("teach named.ply --name vase --at 160,0", "--at 160,0: camera 0 has columns 0 to 159"),
        *((f"teach named.ply --name vase --at={at}", "give column and row") for at in NO_PIXELS),
        (f"teach named.ply --name vase --at {MUG} --level subpart", "point at something else"),
        ("teach named.ply --name vase --remove", "'vase' was not taught here; taught words: none"),
        (f"teach blind.ply --name vase --at {MUG}", "no cameras"),
        ("inspect --jsn", "scene is missing; is there an unknown option"),
        ("inspect a.ply --jsn", "--jsn; did you mean --json?"),
        ("query a.ply mug --instances 1e3", "--instances: expected a whole number, got '1e3'"),
        ("query a.ply mug --scale x", "--scale: expected a number, got ['x']"),
        *((f"transform a.ply b.ply --{one} x y z", "expected numbers, got") for one in ("move", "matrix")),
        ("transform a.ply b.ply --rotate q 3", "--rotate: expected one of 'x', 'y', 'z' and a number"),
        ("transform a.ply b.ply --rotate x nan", "--rotate x nan: must be -360 to 360"),
        ("train loop --out b.ply", "loop does not exist"),
        ("train a.ply --out b.ply", "a.ply is no dataset; expected"),  # before weights are asked for
        ("convert b.ply", "name what to read"),
        ("convert a.ply out --to nothing", "choose one of scene"),
        *((f"{one} a.ply a.ply", "would replace") for one in REPLACING.split(",")),
        ("export a.ply b.html --encoder ./absent", "absent: no such"),
        ("export a.ply room.png", "written as .html"),
        ("transform a.ply b.ply", "no step given"),
        ("transform a.ply b.ply --move 1e11 0 0", "move by less"),
        ("crop a.ply b.ply --box 100 0 0 101 1 1", "langsplat inspect a.ply"),
        (f"teach named.ply --name vase --at {MUG} --into words.json", "written as .safetensors"),
        (f"teach named.ply --name vase --at {MUG} --into junk.safetensors", "not a whole safetensors file"),
        (f"teach named.ply --name vase --at {MUG} --into named.langsplat.safetensors", "not of taught words"),
        (f"teach other.ply --name vase --at {MUG} --into own.safetensors", "own.safetensors: these words"),
        ("query blind.ply mug --camera 1", "--camera 1: the scene has no cameras; leave it out"),
        ("query other.ply mug --taught own.safetensors", "with fake, the scene was made with other"),
        ("query named.ply vase --mode paper --taught own.safetensors", "--mode paper"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_nothing_is_written(described, capsys, words, message):
    before = {path.name: path.read_bytes() for path in described.iterdir() if path.exists()}
    out = ("--out", "b.ply") if words.startswith("select") and "--out" not in words else ()
    assert message in refusal(capsys, *words.split(), *out)
    assert {path.name: path.read_bytes() for path in described.iterdir() if path.exists()} == before

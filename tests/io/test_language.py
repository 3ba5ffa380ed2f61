"""The language sidecar: written and read back, refused when broken, matched with an edited scene."""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io import language
from langsplat_core.io.language import read_language, rematch_language, write_language
from langsplat_core.io.ply import pack_positions, step, unpack_positions
from langsplat_core.scene import NO_THING, Calibration, CodebookCodec, LanguageField, Odds, Reading
from tests.support.file_samples import random_field
from tests.support.same import assert_same_field
from tests.support.scenes import random_gaussians

N = 60


@pytest.fixture
def means():
    return random_gaussians(N).means


@pytest.fixture
def sidecar(tmp_path, means):
    path = tmp_path / "scene.langsplat.safetensors"
    write_language(path, random_field(N), means)
    return path


def edit(path: Path, change) -> None:
    """Rewrite a safetensors file; `change` gets (header, data) and returns the new pair."""
    raw = path.read_bytes()
    size = struct.unpack("<Q", raw[:8])[0]
    header, data = change(json.loads(raw[8 : 8 + size]), raw[8 + size :])
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data)


def edit_metadata(path: Path, **entries: str | None) -> None:
    def change(header, data):
        for key, value in entries.items():
            header["__metadata__"].pop(key)
            if value is not None:
                header["__metadata__"][key] = value
        return header, data

    edit(path, change)


def edit_tensor(path: Path, name: str, **entries) -> None:
    edit(path, lambda header, data: (header | {name: header[name] | entries}, data))


def rename_tensor(path: Path, old: str, new: str) -> None:
    edit(path, lambda header, data: ({new if k == old else k: v for k, v in header.items()}, data))


@pytest.mark.parametrize("kind", ["codebook", "autoencoder", "linear"])
@pytest.mark.parametrize("phrases", [(), ("red mug",), ("tür", 'a "quoted", {braced}\nphrase', "猫")])
def test_what_is_written_is_read_back(tmp_path, means, kind, phrases):
    want = random_field(N, kind, phrases)
    path = tmp_path / "a.langsplat.safetensors"
    write_language(path, want, means)
    assert_same_field(read_language(path, means), want)
    assert list(tmp_path.iterdir()) == [path]


def test_a_scene_without_gaussians(tmp_path):
    path = tmp_path / "a.langsplat.safetensors"
    write_language(path, random_field(0), np.zeros((0, 3), np.float32))
    assert len(read_language(path, np.zeros((0, 3), np.float32))) == 0


def test_the_layout_is_the_documented_one(sidecar, means):
    raw = sidecar.read_bytes()
    size = struct.unpack("<Q", raw[:8])[0]
    header = json.loads(raw[8 : 8 + size])
    metadata = header.pop("__metadata__")
    shapes = {name: tuple(entry["shape"]) for name, entry in header.items()}
    kinds = {name: entry["dtype"] for name, entry in header.items()}
    assert (kinds.pop("positions"), kinds.pop("everyday")) == ("U64", "F16")
    assert set(kinds.values()) == {"F32"}
    assert shapes["latents"] == (3, N, 3)
    assert shapes["confidence"] == (3, N)
    assert shapes["positions"] == (N,)
    assert shapes["corners"] == (2, 3)
    assert shapes["canonical"] == (4, 16)
    assert (shapes["phrasebook"], shapes["everyday"]) == ((2, 16), (60, 16))
    assert shapes["codec.encoder.0.weight"] == (8, 16)
    assert metadata == {
        "format": "langsplat",
        "version": "2",
        "encoder": "demo",
        "levels": "subpart,part,whole",
        "codec": "autoencoder",
        "d": "3",
        "gaussians": str(N),
        "means_blake2b": language.means_checksum(means),
        "phrases": '["red mug", "tür"]',
        "temperature": "10.0",
        "found": "0.6",
    }


def test_a_field_of_other_gaussians_is_refused_with_the_way_to_mend_it(sidecar, means):
    mend = r"langsplat convert EDITED\.ply NEW\.ply --rematch .*scene\.langsplat\.safetensors"
    with pytest.raises(FormatError, match=f"made for 60 Gaussians, the scene has 59; .*{mend}"):
        read_language(sidecar, means[1:])
    nudged = means.copy()
    nudged[3, 1] = np.nextafter(nudged[3, 1], np.float32(9))
    for other in (nudged, means[::-1]):
        with pytest.raises(FormatError, match=f"other positions than the scene's; .*{mend}"):
            read_language(sidecar, other)


BROKEN = {
    "another program's": (lambda p: edit_metadata(p, format="gguf"), "not a language field"),
    "no format": (lambda p: edit_metadata(p, format=None), "not a language field"),
    "no metadata": (
        lambda p: edit(p, lambda h, d: ({k: v for k, v in h.items() if k != "__metadata__"}, d)),
        "not a language field",
    ),
    "a newer version": (
        lambda p: edit_metadata(p, version="3"),
        "version '3'; this program reads 1 and 2, update",
    ),
    "no checksum": (lambda p: edit_metadata(p, means_blake2b=None), "the header has no 'means_blake2b'"),
    "a wrong checksum": (lambda p: edit_metadata(p, means_blake2b="00"), "at other positions"),
    "levels in another order": (
        lambda p: edit_metadata(p, levels="whole,part,subpart"),
        "levels 'whole,part",
    ),
    "an unknown codec": (lambda p: edit_metadata(p, codec="vq"), "unknown codec kind 'vq'"),
    "the other codec": (lambda p: edit_metadata(p, codec="linear"), "linear codec without its basis"),
    "a wrong d": (lambda p: edit_metadata(p, d="4"), "the header's d or number of Gaussians"),
    "a wrong count": (lambda p: edit_metadata(p, gaussians="61"), "the header's d or number of Gaussians"),
    "phrases that are no list": (lambda p: edit_metadata(p, phrases='{"a": 1}'), "not a list of texts"),
    "phrases that are no texts": (lambda p: edit_metadata(p, phrases="[1, 2]"), "not a list of texts"),
    "phrases that are no JSON": (lambda p: edit_metadata(p, phrases="[1,"), "not readable as JSON"),
    "one phrase twice": (lambda p: edit_metadata(p, phrases='["a", "a"]'), "one phrase twice"),
    "a phrase without a vector": (
        lambda p: edit_metadata(p, phrases='["a","b","c"]'),
        r"phrasebook: .*\(3, 16\)",
    ),
    "no latents": (lambda p: rename_tensor(p, "latents", "old"), "tensor 'latents' is missing"),
    "no positions": (lambda p: rename_tensor(p, "corners", "old"), "tensor 'corners' is missing"),
    "a temperature that is no number": (lambda p: edit_metadata(p, temperature="hot"), "could not convert"),
    "a temperature of nothing": (lambda p: edit_metadata(p, temperature="0"), "temperature 0.0 and found"),
    "a verdict that is none": (lambda p: edit_metadata(p, found="nan"), "found nan"),
    "a codec in parts": (lambda p: rename_tensor(p, "codec.encoder.0.bias", "x"), "without encoder.0.bias"),
    "latents of another shape": (
        lambda p: edit_tensor(p, "latents", shape=[N, 3, 3]),
        "latents: expected shape",
    ),
    "flat latents": (lambda p: edit_tensor(p, "latents", shape=[3 * N * 3]), "latents: expected shape"),
    "too few positions": (
        lambda p: edit_tensor(p, "positions", shape=[N // 2, 2]),
        "positions: expected shape",
    ),
    "flat weights": (lambda p: edit_tensor(p, "codec.encoder.0.weight", shape=[128]), "safetensors: "),
    "latents of integers": (
        lambda p: edit_tensor(p, "latents", dtype="I32"),
        "'latents' is I32; expected F32 or F16",
    ),
    "latents of bfloat16": (
        lambda p: edit_tensor(p, "latents", dtype="BF16", shape=[3, N, 6]),
        "'latents' is BF16; expected F32 or F16",
    ),
    "a shape beyond the data": (
        lambda p: edit_tensor(p, "latents", shape=[3, 10**12, 3]),
        "not a whole safetens",
    ),
    "not safetensors": (lambda p: p.write_bytes(b"\x80\x04pickle"), "not a whole safetensors file"),
    "empty": (lambda p: p.write_bytes(b""), "not a whole safetensors file"),
    "truncated": (lambda p: p.write_bytes(p.read_bytes()[:-1]), "not a whole safetensors file"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_every_broken_rule_has_its_message(sidecar, means, case):
    spoil, message = BROKEN[case]
    spoil(sidecar)
    with pytest.raises(FormatError, match=message) as caught:
        read_language(sidecar, means)
    assert str(caught.value).startswith(str(sidecar))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "value"), [("latents", np.nan), ("canonical", np.inf), ("confidence", -1)])
def test_numbers_that_mean_nothing(tmp_path, means, name, value):
    field = random_field(N)
    getattr(field, name)[0, 0] = value
    write_language(tmp_path / "a.safetensors", field, means)
    with pytest.raises(FormatError, match=f"tensor '{name}' holds"):
        read_language(tmp_path / "a.safetensors", means)


def test_paths_that_cannot_be_read(tmp_path, means):
    with pytest.raises(InputError, match="no such file"):
        read_language(tmp_path / "a.safetensors", means)
    with pytest.raises(InputError, match="is a folder"):
        read_language(tmp_path, means)


def test_rematch_after_removing_and_reordering(sidecar, means):
    field = random_field(N)
    keep = np.random.default_rng(3).permutation(N)[:40]
    got = rematch_language(sidecar, means[keep])
    assert_same_field(
        got, replace(field, latents=field.latents[:, keep], confidence=field.confidence[:, keep])
    )


def test_rematch_leaves_what_has_no_partner_without_meaning(sidecar, means):
    field = random_field(N)
    far = np.array([[50, 0, 0], [np.nan, 0, 0]], np.float32)
    rounded = means + np.random.default_rng(4).uniform(-1e-4, 1e-4, means.shape).astype(np.float32)
    got = rematch_language(sidecar, np.concatenate([rounded, far]))
    np.testing.assert_array_equal(got.latents[:, :N], field.latents)
    np.testing.assert_array_equal(got.confidence[:, :N], field.confidence)
    assert not got.latents[:, N:].any()
    assert not got.confidence[:, N:].any()


def test_rematch_within_a_given_distance(sidecar, means):
    moved = means + np.float32([0.01, 0, 0])
    assert rematch_language(sidecar, moved, max_distance=0.02).confidence.any()
    assert not rematch_language(sidecar, moved, max_distance=0.005).confidence.any()


@pytest.mark.parametrize(("old", "new"), [(0, 5), (5, 0), (1, 1), (1, 3)])
def test_rematch_of_almost_nothing(tmp_path, means, old, new):
    write_language(tmp_path / "a.safetensors", random_field(old), means[:old])
    got = rematch_language(tmp_path / "a.safetensors", means[:new])
    assert len(got) == new
    assert (got.confidence.any(0) == (np.arange(new) < old)).all()


def test_a_codebook_is_stored_in_small_numbers_where_that_loses_nothing(tmp_path, means):
    field = random_field(N, "codebook")
    codec = CodebookCodec(*(rounded(tensor) for tensor in field.codec.tensors().values()))
    field = replace(field, codec=codec, confidence=rounded(field.confidence))
    path = tmp_path / "a.langsplat.safetensors"
    write_language(path, field, means)
    header = header_of(path)
    kinds = {name: (entry["dtype"], entry["shape"]) for name, entry in header.items()}
    assert kinds["codes"] == ("U16", [3, N])
    assert kinds["codec.vectors"] == ("F16", [11, 16])
    assert kinds["confidence"] == ("F16", [3, N])
    assert kinds["canonical"] == ("F32", [4, 16])
    assert "latents" not in kinds
    assert_same_field(read_language(path, means), field)


def test_a_code_without_a_codeword_is_refused(tmp_path, means):
    path = tmp_path / "a.langsplat.safetensors"
    write_language(path, random_field(N, "codebook"), means)
    rename_tensor(path, "codec.vectors", "codec.all_vectors")
    with pytest.raises(FormatError, match="codebook codec without its vectors"):
        read_language(path, means)
    field = random_field(N, "codebook")
    field.latents[1, 5] = 11
    write_language(path, field, means)
    with pytest.raises(FormatError, match="11 is not the number of one of 11 codewords"):
        read_language(path, means)


def test_version_1_still_opens(tmp_path, means):
    """As the first release wrote it: everything float32, and the means themselves."""
    field = replace(random_field(N), everyday=None)
    path = tmp_path / "a.langsplat.safetensors"
    write_language(path, field, means)
    metadata = header_of(path, metadata=True)
    for name in ("temperature", "found"):
        metadata.pop(name)
    tensors = load_file(path)
    for name in ("positions", "corners"):
        tensors.pop(name)
    save_file(tensors | {"means": means}, path, metadata | {"version": "1"})
    assert_same_field(read_language(path, means), field)
    assert_same_field(rematch_language(path, means), field)


def test_the_reading_of_an_encoder_is_kept(tmp_path, means):
    field = replace(random_field(N), reading=Reading(11.7, 0.55))
    path = tmp_path / "a.langsplat.safetensors"
    write_language(path, field, means)
    assert read_language(path, means).reading == field.reading
    assert rematch_language(path, means[:9]).reading == field.reading


def test_packed_positions_are_as_near_as_they_say():
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.normal(size=(500, 3)), 900 * rng.normal(size=(5, 3))]).astype(np.float32)
    means[7] = np.nan
    means[:, 2] = 4.0  # an axis without extent
    packed, corners = pack_positions(means)
    got = unpack_positions(packed, corners)
    finite = np.isfinite(means).all(1)
    assert np.isnan(got[7]).all()
    assert np.abs(got[finite] - means[finite]).max() <= 0.51 * step(corners)
    assert step(corners) < 0.002
    empty, nowhere = pack_positions(np.full((2, 3), np.inf, np.float32))
    assert np.isnan(unpack_positions(empty, nowhere)).all()


def rounded(tensor: np.ndarray) -> np.ndarray:
    return tensor.astype(np.float16).astype(np.float32)


def header_of(path: Path, metadata: bool = False) -> dict:
    raw = path.read_bytes()
    header = json.loads(raw[8 : 8 + struct.unpack("<Q", raw[:8])[0]])
    own = header.pop("__metadata__")
    return own if metadata else header


def test_the_same_field_makes_the_same_bytes(tmp_path, means):
    written = set()
    for number in range(6):  # the library orders the metadata anew each time
        path = tmp_path / f"{number}.langsplat.safetensors"
        write_language(path, random_field(N), means)
        written.add(path.read_bytes())
    assert len(written) == 1


# Things and the calibration in the language sidecar.

CALIBRATION = Calibration(Odds(-0.25, 18.548, 2.7, 0.62), Odds(0.5, 2.25, 15.5), Odds(0.75, -0.5, 9.25, 0.5))
Change = Callable[[dict[str, Array], dict[str, str]], None]


def full_field(kind: str = "codebook") -> LanguageField:
    things = (np.arange(N) // 7).astype(np.uint16)
    things[::5] = NO_THING
    return replace(random_field(N, kind), things=things, reading=Reading(11.7, 0.73, CALIBRATION))


@pytest.fixture
def stored_sidecar(tmp_path, means) -> Path:
    path = tmp_path / "scene.langsplat.safetensors"
    write_language(path, full_field(), means)
    return path


def change(path: Path, how: Change) -> None:
    """Write the file again with other tensors and metadata."""
    with safe_open(path, framework="numpy") as file:
        metadata = dict(file.metadata())
    tensors = load_file(path)
    how(tensors, metadata)
    save_file(tensors, path, metadata)


@pytest.mark.parametrize("kind", ["codebook", "autoencoder", "linear"])
@pytest.mark.parametrize("things", [False, True])
@pytest.mark.parametrize("calibration", [None, CALIBRATION, Calibration(*[Odds(0, 1, 0, 1)] * 3)])
def test_a_stored_sidecar_is_read_back(tmp_path, means, kind, things, calibration):
    want = replace(full_field(kind), reading=Reading(11.7, 0.73, calibration))
    if not things:
        want = replace(want, things=None)
    path = tmp_path / "a.langsplat.safetensors"
    write_language(path, want, means)
    assert_same_field(read_language(path, means), want)


def test_the_stored_layout_is_the_documented_one(stored_sidecar, tmp_path, means):
    with safe_open(stored_sidecar, framework="numpy") as file:
        stored, metadata = file.get_slice("things"), file.metadata()
        assert (stored.get_dtype(), stored.get_shape()) == ("U16", [N])
    assert json.loads(metadata["odds"]) == [
        [-0.25, 18.548, 2.7, 0.62],
        [0.5, 2.25, 15.5, 0.75],
        [0.75, -0.5, 9.25, 0.5],
    ]
    write_language(tmp_path / "a.safetensors", random_field(N), means)
    with safe_open(tmp_path / "a.safetensors", framework="numpy") as file:
        assert "things" not in file.keys()  # noqa: SIM118 (not a dictionary)
        assert "odds" not in file.metadata()


def test_a_field_without_either_is_what_files_held_before(stored_sidecar, means):
    def older(tensors: dict[str, Array], metadata: dict[str, str]) -> None:
        del tensors["things"], tensors["everyday"], metadata["odds"]
        metadata["calibration"] = "[-0.25, 18.5, 2.75, 0.625]"  # of another scale: not read

    change(stored_sidecar, older)
    field = read_language(stored_sidecar, means)
    assert (field.things, field.everyday, field.reading) == (None, None, Reading(11.7, 0.73))


def stating(text: str) -> Change:
    return lambda tensors, metadata: metadata.update(odds=text)


def thrice(numbers: str) -> str:
    return f"[[{numbers}], [{numbers}], [{numbers}]]"


def holding(things: Array) -> Change:
    return lambda tensors, metadata: tensors.update(things=things)


DAMAGED = {
    "no JSON": (stating("[0.0, 1.0,"), "not readable as JSON"),
    "no list": (stating('{"constant": 1.0}'), "not 3 lists of four numbers"),
    "a number": (stating("1.0"), "not 3 lists of four numbers"),
    "nothing": (stating("null"), "not 3 lists of four numbers"),
    "too short": (stating("[0.0, 1.0, 2.0]"), "not 3 lists of four numbers"),
    "too long": (stating("[0.0, 1.0, 2.0, 0.7, 0.7]"), "not 3 lists of four numbers"),
    "texts": (stating('["0.0", "1.0", "2.0", "0.7"]'), "not 3 lists of four numbers"),
    "truths": (stating("[true, true, true, true]"), "not 3 lists of four numbers"),
    "two lists": (stating("[[0.0, 1.0, 2.0, 0.7], [0.0, 1.0, 2.0, 0.7]]"), "not 3 lists of four numbers"),
    "lists of four": (stating("[[0.0, 1.0, 2.0, 0.7], [0.0, 1.0, 2.0, 0.7], [0.0]]"), "not 3 lists"),
    "a falling one": (
        stating("[[0.0, 1.0, 2.0, 0.7], [0.0, 1.0, 2.0, 0.7], [0.0, -3.0, 2.0, 0.7]]"),
        "rising with fits",
    ),
    "lists": (stating("[[0.0], [1.0], [2.0], [0.7]]"), "not 3 lists of four numbers"),
    "an endless number": (stating("[1" + "0" * 500 + ", 1.0, 2.0, 0.7]"), "not 3 lists of four numbers"),
    "nested without end": (stating("[" * 100_000), "not readable as JSON"),
    "NaN": (stating(thrice("NaN, 1.0, 2.0, 0.7")), "expected finite numbers"),
    "infinite": (stating(thrice("0.0, Infinity, 2.0, 0.7")), "expected finite numbers"),
    "falling": (stating(thrice("0.0, -3.0, 2.0, 0.7")), "rising with fits"),
    "found by less than even": (stating(thrice("0.0, 3.0, 2.0, 0.3")), r"found in \[0.5, 1\]"),
    "everyday phrases of whole numbers": (
        lambda tensors, _: tensors.update(everyday=np.zeros((60, 16), np.int32)),
        "'everyday' is I32",
    ),
    "everyday phrases of another length": (
        lambda tensors, _: tensors.update(everyday=np.zeros((60, 3), np.float32)),
        "everyday: expected shape",
    ),
    "things of floats": (holding(np.zeros(N, np.float32)), "'things' is F32; expected U16"),
    "things of 32 bits": (holding(np.zeros(N, np.int32)), "'things' is I32; expected U16"),
    "things of bytes": (holding(np.zeros(N, np.uint8)), "'things' is U8; expected U16"),
    "too few things": (holding(np.zeros(N - 1, np.uint16)), "things: expected shape"),
    "too many things": (holding(np.zeros(N + 1, np.uint16)), "things: expected shape"),
    "things of each level": (holding(np.zeros((3, N), np.uint16)), "things: expected shape"),
    "one thing": (holding(np.array(4, np.uint16)), "things: expected shape"),
}


@pytest.mark.parametrize("case", DAMAGED)
def test_damage_is_one_line(stored_sidecar, means, case):
    how, message = DAMAGED[case]
    change(stored_sidecar, how)
    for read in (read_language, rematch_language):
        with pytest.raises(FormatError, match=message) as caught:
            read(stored_sidecar, means)
        assert str(caught.value).startswith(str(stored_sidecar))
        assert "\n" not in str(caught.value)


def test_rematching_carries_things_and_the_calibration(stored_sidecar, means):
    field = full_field()
    keep = np.random.default_rng(3).permutation(N)[:40]
    got = rematch_language(stored_sidecar, means[keep])
    assert_same_field(got, field.take(keep))
    far = np.array([[50, 0, 0], [np.nan, 0, 0]], np.float32)
    got = rematch_language(stored_sidecar, np.concatenate([means, far]))
    np.testing.assert_array_equal(got.things[:N], field.things)
    assert got.things[N:].tolist() == [NO_THING] * 2
    nobody = rematch_language(stored_sidecar, np.zeros((0, 3), np.float32))
    assert (nobody.things.shape, nobody.things.dtype) == ((0,), np.uint16)


def test_rematching_invents_no_things(tmp_path, means):
    write_language(tmp_path / "a.safetensors", random_field(N), means)
    assert rematch_language(tmp_path / "a.safetensors", means[:9]).things is None

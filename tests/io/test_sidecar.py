"""The language sidecar: written and read back, refused when malformed, matched with an edited scene."""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.sidecar import (
    Words,
    means_checksum,
    pack_positions,
    read_language,
    read_words,
    rematch_language,
    unpack_positions,
    write_language,
    write_words,
)
from langsplat_core.scene import (
    NO_NODE,
    Calibration,
    CodebookCodec,
    LanguageField,
    PlattScaling,
    TaughtWord,
    Tree,
)
from tests.support.file_samples import assert_refused, assert_same_field, random_field
from tests.support.scenes import random_gaussians

N = 60
CALIBRATION = Calibration(*(PlattScaling(x, 18.548, 2.7, 0.62, 1.5) for x in (-0.25, 0.5, 1, 2, 3)))
AXES = np.eye(3, 16, dtype=np.float32)
TAUGHT = (
    TaughtWord("Grandma's vase", 2, AXES[:2], np.array([0.25, 0.5], np.float32)),
    TaughtWord("tür", 0, AXES[2:], np.ones(1, np.float32)),
)


def full_field(kind: str = "autoencoder") -> LanguageField:
    leaves = (np.arange(N) // 7).astype(np.int32)
    leaves[::5] = NO_NODE
    parents = np.array([9, 9, 9, 10, 10, 10, 10, 10, 10, NO_NODE, NO_NODE], np.int32)
    levels = np.array([0] * 9 + [1, 2], np.uint8)
    tree = Tree(leaves, parents, levels, np.arange(22, dtype=np.uint16).reshape(11, 2))
    made = replace(random_field(N, kind), tree=tree, temperature=11.7, found=0.73, calibration=CALIBRATION)
    return replace(made, taught=TAUGHT)


@pytest.fixture
def means() -> Array:
    return random_gaussians(N).means


@pytest.fixture
def sidecar(tmp_path: Path, means: Array) -> Path:
    path = tmp_path / "scene.langsplat.safetensors"
    write_language(path, full_field(), means)
    return path


def header_of(path: Path) -> dict[str, Any]:
    raw = path.read_bytes()
    return json.loads(raw[8 : 8 + struct.unpack("<Q", raw[:8])[0]])


def layout(header: dict[str, Any]) -> dict[str, tuple[str, list[int]]]:
    """Type and shape of every tensor."""
    return {name: (of["dtype"], of["shape"]) for name, of in header.items() if name != "__metadata__"}


def change_header(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Rewrite the header alone: it need not go with the data any more."""
    header, data = header_of(path), path.read_bytes()
    change(header)
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data[8 + struct.unpack("<Q", data[:8])[0] :])


def change(path: Path, **tensors: Array | None) -> None:
    """Write the file again with other tensors; None for one that is to go."""
    found = load_file(path) | tensors
    found = {name: tensor for name, tensor in found.items() if tensor is not None}
    save_file(found, path, header_of(path)["__metadata__"])


Spoil = Callable[[Path], object]


def says(**entries: str | None) -> Spoil:
    """Other metadata; None for an entry that is to go."""

    def edit(header: dict[str, Any]) -> None:
        metadata = header["__metadata__"] | entries
        header["__metadata__"] = {key: value for key, value in metadata.items() if value is not None}

    return lambda path: change_header(path, edit)


def declares(name: str, **entries: Any) -> Spoil:
    """Another type or shape of a tensor."""
    return lambda path: change_header(path, lambda header: header[name].update(entries))


def holds(**tensors: Array | None) -> Spoil:
    return lambda path: change(path, **tensors)


def spoilt(name: str, value: float) -> Spoil:
    def put(path: Path) -> None:
        tensor = load_file(path)[name].copy()
        tensor[0, 0] = value
        change(path, **{name: tensor})

    return put


def odds(numbers: str) -> Spoil:
    return says(odds=f"[[{numbers}], [{numbers}], [{numbers}]]")


@pytest.mark.parametrize("kind", ["codebook", "autoencoder", "linear"])
@pytest.mark.parametrize("phrases", [(), ("red mug",), ("tür", 'a "quoted", {braced}\nphrase', "猫")])
@pytest.mark.parametrize("full", [False, True])
def test_sidecars_are_read_back_as_written(tmp_path, means, kind, phrases, full):
    want = random_field(N, kind, phrases)
    if full:
        want = replace(full_field(kind), phrasebook=want.phrasebook)
    path = tmp_path / "a.langsplat.safetensors"
    write_language(path, want, means)
    assert_same_field(read_language(path, means), want)
    assert list(tmp_path.iterdir()) == [path]
    write_language(path, want.take(slice(0)), means[:0])
    assert len(read_language(path, means[:0])) == 0


def test_sidecars_have_the_documented_layout(sidecar, means):
    header = header_of(sidecar)
    metadata = header["__metadata__"]
    assert layout(header).items() >= {
        "latents": ("F32", [3, N, 3]), "confidence": ("F32", [3, N]), "positions": ("U64", [N]),
        "tree.leaves": ("U16", [N]), "tree.parents": ("U32", [11]), "tree.levels": ("U8", [11]),
        "tree.votes": ("U16", [11, 2]), "corners": ("F32", [2, 3]), "canonical": ("F32", [4, 16]),
        "everyday": ("F16", [60, 16]), "phrasebook": ("F32", [2, 16]), "taught": ("F16", [3, 16]),
        "taught.rivals": ("F16", [3]), "codec.encoder.0.weight": ("F32", [8, 16]),
    }.items()  # fmt: skip
    assert json.loads(metadata.pop("odds")) == [[*vars(way).values()] for way in vars(CALIBRATION).values()]
    assert metadata == {
        "format": "langsplat",
        "version": "3",
        "encoder": "demo",
        "levels": "subpart,part,whole",
        "codec": "autoencoder",
        "d": "3",
        "gaussians": str(N),
        "means_blake2b": means_checksum(means),
        "phrases": '["red mug", "tür"]',
        "temperature": "11.7",
        "found": "0.73",
        "taught": '[["Grandma\'s vase", 2, 2], ["tür", 0, 1]]',
    }


# Of taught words, in a scene and in a file of their own.
MISTAUGHT: dict[str, Spoil] = {
    **{f"taught words {text}": says(taught=text) for text in
       ("[[", '["a"]', '[["a", true, 3]]', '[["a", 2, 9]]', '[["a", 2, -1], ["b", 2, 4]]')},
    "no examples": holds(taught=None),
    "a word without a name": says(taught='[["", 2, 3]]'),
    "a name without end": says(taught=f'[["{"a" * 100_000}", 2, 3]]'),
    "one name twice": says(taught='[["vase", 2, 2], ["Vase", 2, 1]]'),
    "examples that are no unit vectors": spoilt("taught", 3.0),
    "a rival of more than one": holds(**{"taught.rivals": np.full(3, 2, np.float16)}),
    "examples of another length": holds(taught=np.eye(3, 15, dtype=np.float16)),
}  # fmt: skip
MALFORMED: dict[str, Spoil] = {
    "another program's": says(format="gguf"),
    "a newer version": says(version="4"),
    "levels in another order": says(levels="whole,part,subpart"),
    "the other codec": says(codec="linear"),
    "a wrong count": says(gaussians="61"),
    **{f"phrases {text}": says(phrases=text) for text in ("[1,", '["a", "a"]')},
    "a temperature of 0": says(temperature="0"),
    "odds nested without end": says(odds="[" * 100_000),
    **{f"odds {text[:40]}": says(odds=text) for text in ("1.0", "[1" + "0" * 500 + ", 1.0, 2.0, 0.7]")},
    **MISTAUGHT,
    **{f"odds of {text}": odds(f"0.0, {text}, 2.0, 0.7") for text in ("NaN", "Infinity", "1e308", "-3.0")},
    "found by less than even": odds("0.0, 3.0, 2.0, 0.3"),
    "a codec in parts": holds(**{"codec.encoder.0.bias": None}),
    "too few positions": declares("positions", shape=[N // 2, 2]),
    "a shape beyond the data": declares("latents", shape=[3, 10**12, 3]),
    "latents that are NaN": spoilt("latents", np.nan),
    "huge latents": spoilt("latents", 3e38),
    "negative confidence": spoilt("confidence", -1),
    "a leaf too many": holds(**{"tree.leaves": np.zeros(N + 1, np.uint16)}),
    "leaves in no node": holds(**{"tree.leaves": np.full(N, 11, np.uint16)}),
    "parents in a circle": holds(**{"tree.parents": np.zeros(11, np.uint32)}),
}  # fmt: skip


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_sidecars_are_refused_in_a_line(sidecar, means, case):
    MALFORMED[case](sidecar)
    for read in (read_language, rematch_language):
        assert_refused(lambda path, read=read: read(path, means), sidecar)


NO_TREE = {f"tree.{name}": None for name in ("leaves", "parents", "levels", "votes")}


@pytest.fixture
def own_words(tmp_path: Path) -> Path:
    """A file of a user's words."""
    write_words(tmp_path / "words", Words("demo", random_field(N, "linear").canonical, TAUGHT))
    return tmp_path / "words"


def test_words_are_read_back_as_written(own_words):
    got, want = read_words(own_words), replace(random_field(N, "linear"), taught=TAUGHT)
    found = replace(want, taught=got.words, encoder_id=got.encoder_id, canonical=got.canonical)
    assert_same_field(found, want)
    write_words(own_words, replace(got, words=()))
    assert read_words(own_words).words == ()


MALFORMED_WORDS = MISTAUGHT | {
    "a scene's": says(format="langsplat"),
    "no encoder": says(encoder=None),
    "a newer version": says(version="2"),
    "no canonical vectors": holds(canonical=None),
}


@pytest.mark.parametrize("case", MALFORMED_WORDS)
def test_malformed_words_are_refused_in_a_line(own_words, case):
    MALFORMED_WORDS[case](own_words)
    assert_refused(read_words, own_words)


def test_odds_of_three_ways_are_read(sidecar, means):
    says(odds="[[0, 18.5, 2.5, 0.625], [0.5, 2, 15, 0.75], [1, -0.5, 9, 0.5]]")(sidecar)
    ways = PlattScaling(0, 18.5, 2.5, 0.625), PlattScaling(0.5, 2, 15), PlattScaling(1, -0.5, 9, 0.5)
    assert read_language(sidecar, means).calibration == Calibration(*ways)


def test_version_2_is_read_without_its_things_and_calibration(sidecar, means, caplog):
    change(sidecar, things=np.zeros(N, np.uint16), **NO_TREE, everyday=None)
    says(version="2", odds=None, calibration="[-0.25, 18.5, 2.75, 0.625]")(sidecar)
    field = read_language(sidecar, means)
    assert (field.tree, field.everyday, field.calibration) == (None, None, None)
    assert all(text in caplog.messages[0] for text in ("'things'", "langsplat train --gaussians"))
    assert (field.temperature, field.found) == (11.7, 0.73)
    assert rematch_language(sidecar, means[:9]).tree is None


def test_rematch_follows_removing_reordering_and_adding(sidecar, means):
    field = full_field()
    keep = np.random.default_rng(3).permutation(N)[:40]
    assert_same_field(rematch_language(sidecar, means[keep]), field.take(keep))
    far = np.array([[50, 0, 0], [np.nan, 0, 0]], np.float32)
    rounded = means + np.random.default_rng(4).uniform(-1e-4, 1e-4, means.shape).astype(np.float32)
    got = rematch_language(sidecar, np.concatenate([rounded, far]))
    assert_same_field(got.take(np.arange(N)), field)
    assert not got.latents[:, N:].any()
    assert not got.confidence[:, N:].any()
    assert got.tree.leaves.tolist()[N:] == [NO_NODE] * 2
    assert rematch_language(sidecar, np.zeros((0, 3), np.float32)).tree.leaves.shape == (0,)


def test_a_sidecar_of_other_gaussians_names_the_rematch(sidecar, means, tmp_path):
    nudged = means.copy()
    nudged[3, 1] = np.nextafter(nudged[3, 1], np.float32(9))
    for other in (means[1:], nudged, means[::-1]):
        with pytest.raises(FormatError) as refused:
            read_language(sidecar, other)
        assert str(refused.value).endswith(f"langsplat convert EDITED.ply NEW.ply --rematch {sidecar}'")
    for path in (tmp_path / "a.safetensors", tmp_path):
        with pytest.raises(InputError):
            read_language(path, means)


def test_exact_halves_are_stored_as_float16(tmp_path, means):
    field = random_field(N, "codebook")
    codec = CodebookCodec(*(rounded(tensor) for tensor in field.codec.tensors().values()))
    field = replace(field, codec=codec, confidence=rounded(field.confidence))
    write_language(tmp_path / "a", field, means)
    kinds = layout(header_of(tmp_path / "a"))
    assert kinds["codes"] == ("U16", [3, N])
    assert kinds["codec.vectors"] == ("F16", [11, 16])
    assert kinds["confidence"] == ("F16", [3, N])
    assert kinds["canonical"] == ("F32", [4, 16])
    assert "latents" not in kinds
    assert_same_field(read_language(tmp_path / "a", means), field)


def test_a_code_without_a_codeword_is_refused(tmp_path, means):
    field = random_field(N, "codebook")
    field.latents[1, 5] = 11
    write_language(tmp_path / "a", field, means)
    assert_refused(lambda path: read_language(path, means), tmp_path / "a")


def test_version_1_is_read(tmp_path, means):
    field = replace(random_field(N), everyday=None)
    write_language(tmp_path / "a", field, means)
    change(tmp_path / "a", means=means, positions=None, corners=None)
    says(version="1", temperature=None, found=None)(tmp_path / "a")
    for read in (read_language, rematch_language):
        assert_same_field(read(tmp_path / "a", means), field)


def test_packed_positions_are_exact_to_half_a_step():
    rng = np.random.default_rng(0)
    means = np.concatenate([rng.normal(size=(500, 3)), 900 * rng.normal(size=(5, 3))]).astype(np.float32)
    means[7] = np.nan
    means[:, 2] = 4.0  # an axis without extent
    packed, corners = pack_positions(means)
    got, step = unpack_positions(packed, corners)
    finite = np.isfinite(means).all(1)
    assert np.isnan(got[7]).all()
    assert np.abs(got[finite] - means[finite]).max() <= 0.51 * step < 0.001
    assert np.isnan(unpack_positions(*pack_positions(np.full((2, 3), np.inf, np.float32)))[0]).all()


def rounded(tensor: np.ndarray) -> np.ndarray:
    return tensor.astype(np.float16).astype(np.float32)


def test_sidecars_are_deterministic(tmp_path, means):
    written = set()
    for _ in range(6):  # the library orders the metadata anew each time
        write_language(tmp_path / "a", random_field(N), means)
        written.add((tmp_path / "a").read_bytes())
    assert len(written) == 1

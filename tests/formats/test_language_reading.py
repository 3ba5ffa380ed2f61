"""Things and the calibration in the language sidecar."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from langsplat_core.arrays import Array
from langsplat_core.errors import FormatError
from langsplat_core.io import read_language, rematch_language, write_language
from langsplat_core.scene import NO_THING, Calibration, LanguageField, Odds, Reading
from tests.support.file_samples import random_field
from tests.support.same import assert_same_field
from tests.support.scenes import random_gaussians

N = 60
CALIBRATION = Calibration(Odds(-0.25, 18.548, 2.7, 0.62), Odds(0.5, 2.25, 15.5), Odds(0.75, -0.5, 9.25, 0.5))
Change = Callable[[dict[str, Array], dict[str, str]], None]


@pytest.fixture
def means() -> Array:
    return random_gaussians(N).means


def full_field(kind: str = "codebook") -> LanguageField:
    things = (np.arange(N) // 7).astype(np.uint16)
    things[::5] = NO_THING
    return replace(random_field(N, kind), things=things, reading=Reading(11.7, 0.73, CALIBRATION))


@pytest.fixture
def sidecar(tmp_path, means) -> Path:
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
def test_what_is_written_is_read_back(tmp_path, means, kind, things, calibration):
    want = replace(full_field(kind), reading=Reading(11.7, 0.73, calibration))
    if not things:
        want = replace(want, things=None)
    path = tmp_path / "a.langsplat.safetensors"
    write_language(path, want, means)
    assert_same_field(read_language(path, means), want)


def test_the_layout_is_the_documented_one(sidecar, tmp_path, means):
    with safe_open(sidecar, framework="numpy") as file:
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


def test_a_field_without_either_is_what_files_held_before(sidecar, means):
    def older(tensors: dict[str, Array], metadata: dict[str, str]) -> None:
        del tensors["things"], tensors["everyday"], metadata["odds"]
        metadata["calibration"] = "[-0.25, 18.5, 2.75, 0.625]"  # of another scale: not read

    change(sidecar, older)
    field = read_language(sidecar, means)
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
def test_damage_is_one_line(sidecar, means, case):
    how, message = DAMAGED[case]
    change(sidecar, how)
    for read in (read_language, rematch_language):
        with pytest.raises(FormatError, match=message) as caught:
            read(sidecar, means)
        assert str(caught.value).startswith(str(sidecar))
        assert "\n" not in str(caught.value)


def test_rematching_carries_things_and_the_calibration(sidecar, means):
    field = full_field()
    keep = np.random.default_rng(3).permutation(N)[:40]
    got = rematch_language(sidecar, means[keep])
    assert_same_field(got, field.take(keep))
    far = np.array([[50, 0, 0], [np.nan, 0, 0]], np.float32)
    got = rematch_language(sidecar, np.concatenate([means, far]))
    np.testing.assert_array_equal(got.things[:N], field.things)
    assert got.things[N:].tolist() == [NO_THING] * 2
    nobody = rematch_language(sidecar, np.zeros((0, 3), np.float32))
    assert (nobody.things.shape, nobody.things.dtype) == ((0,), np.uint16)


def test_rematching_invents_no_things(tmp_path, means):
    write_language(tmp_path / "a.safetensors", random_field(N), means)
    assert rematch_language(tmp_path / "a.safetensors", means[:9]).things is None

"""The language sidecar, and scenes saved and loaded as a whole."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from langsplat_core.errors import FormatError, InputError
from langsplat_core.formats import (
    companion_path,
    language,
    load_gaussians,
    load_scene,
    read_language,
    rematch_language,
    save_scene,
    write_language,
    write_ply,
)
from langsplat_core.scene import LanguageField, Scene
from tests.support.file_samples import compressed_ply, random_field, sog_files, write_folder
from tests.support.scenes import random_camera, random_gaussians

N = 60


def assert_same_field(got: LanguageField, want: LanguageField) -> None:
    """Bit for bit: a saved scene must answer exactly like the one in memory."""
    for name in ("latents", "confidence", "canonical"):
        np.testing.assert_array_equal(getattr(got, name), getattr(want, name), name)
    assert got.encoder_id == want.encoder_id
    assert got.codec.kind == want.codec.kind
    assert got.codec.tensors().keys() == want.codec.tensors().keys()
    for name, tensor in want.codec.tensors().items():
        np.testing.assert_array_equal(got.codec.tensors()[name], tensor, name)
    assert list(got.phrasebook) == list(want.phrasebook)
    for phrase, vector in want.phrasebook.items():
        np.testing.assert_array_equal(got.phrasebook[phrase], vector)


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


@pytest.mark.parametrize("kind", ["autoencoder", "linear"])
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
    assert {entry["dtype"] for entry in header.values()} == {"F32"}
    assert shapes["latents"] == (3, N, 3)
    assert shapes["confidence"] == (3, N)
    assert shapes["means"] == (N, 3)
    assert shapes["canonical"] == (4, 16)
    assert shapes["phrasebook"] == (2, 16)
    assert shapes["codec.encoder.0.weight"] == (8, 16)
    start, end = header["means"]["data_offsets"]
    assert raw[8 + size + start : 8 + size + end] == means.astype("<f4").tobytes()
    assert metadata == {
        "format": "langsplat",
        "version": "1",
        "encoder": "demo",
        "levels": "subpart,part,whole",
        "codec": "autoencoder",
        "d": "3",
        "gaussians": str(N),
        "means_blake2b": language.means_checksum(means),
        "phrases": '["red mug", "tür"]',
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
        lambda p: edit_metadata(p, version="2"),
        "version '2'; this program reads '1', update",
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
    "no means": (lambda p: rename_tensor(p, "means", "old"), "tensor 'means' is missing"),
    "a codec in parts": (lambda p: rename_tensor(p, "codec.encoder.0.bias", "x"), "without encoder.0.bias"),
    "latents of another shape": (
        lambda p: edit_tensor(p, "latents", shape=[N, 3, 3]),
        "latents: expected shape",
    ),
    "flat latents": (lambda p: edit_tensor(p, "latents", shape=[3 * N * 3]), "latents: expected shape"),
    "flat means": (lambda p: edit_tensor(p, "means", shape=[N * 3]), "means: expected shape"),
    "flat weights": (lambda p: edit_tensor(p, "codec.encoder.0.weight", shape=[128]), "safetensors: "),
    "latents of integers": (
        lambda p: edit_tensor(p, "latents", dtype="I32"),
        "'latents' is I32; expected F32",
    ),
    "latents of bfloat16": (
        lambda p: edit_tensor(p, "latents", dtype="BF16", shape=[3, N, 6]),
        "'latents' is BF16; expected F32",
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


# ---- scenes as a whole ----


def full_scene(seed: int = 0) -> Scene:
    cameras = tuple(replace(random_camera(i), name=f"view.{i}") for i in range(3))
    return Scene(random_gaussians(N, seed, sh_degree=1), random_field(N, seed=seed), cameras)


def test_a_saved_scene_is_loaded_whole(tmp_path):
    want = full_scene()
    path = tmp_path / "new folder" / "scene.ply"
    save_scene(path, want)
    got = load_scene(path)
    np.testing.assert_array_equal(got.gaussians.sh, want.gaussians.sh)
    assert got.language is not None
    assert_same_field(got.language, want.language)
    assert [camera.name for camera in got.cameras] == ["view.0", "view.1", "view.2"]
    assert got.path == path
    assert sorted(p.name for p in path.parent.iterdir()) == [
        "scene.cameras.json",
        "scene.langsplat.safetensors",
        "scene.ply",
    ]


def test_a_scene_without_companions_removes_those_of_the_one_it_replaces(tmp_path):
    save_scene(tmp_path / "scene.ply", full_scene())
    save_scene(tmp_path / "scene.ply", Scene(random_gaussians(5)))
    assert [p.name for p in tmp_path.iterdir()] == ["scene.ply"]
    got = load_scene(tmp_path / "scene.ply")
    assert got.language is None
    assert got.cameras == ()


class Interrupted(BaseException):
    """Like KeyboardInterrupt, at a chosen place."""


@pytest.mark.parametrize("after", range(20))
def test_an_interruption_never_leaves_a_mixture(tmp_path, monkeypatch, after):
    """Saving over another scene is stopped before its `after`-th change of a file name."""
    path = tmp_path / "scene.ply"
    old, new = full_scene(0), full_scene(1)
    save_scene(path, old)
    changes = iter(range(100))
    for name in ("replace", "unlink"):
        original = getattr(Path, name)

        def step(self, *args, original=original, **kwargs):
            # removing leftovers is what happens after an interruption, not a step of the saving
            is_step = original.__name__ == "replace" or not self.name.startswith(".")
            if is_step and next(changes) == after:
                raise Interrupted
            return original(self, *args, **kwargs)

        monkeypatch.setattr(Path, name, step)
    try:
        save_scene(path, new)
        finished = True
    except Interrupted:
        finished = False
    monkeypatch.undo()
    got = load_scene(path)  # raises if the sidecar is of the other scene
    is_new = np.array_equal(got.gaussians.means, new.gaussians.means)
    assert is_new or np.array_equal(got.gaussians.means, old.gaussians.means)
    source = new if is_new else old
    if got.language is not None:
        assert_same_field(got.language, source.language)
    if finished:
        assert is_new
        assert got.language is not None
        assert got.cameras
    leftovers = [p.name for p in tmp_path.iterdir() if p.name.startswith(".")]
    assert not leftovers
    assert after < 8 or finished  # the parameters cover every step


def test_a_failure_while_writing_changes_nothing(tmp_path, monkeypatch):
    path = tmp_path / "scene.ply"
    save_scene(path, full_scene(0))
    before = {p.name: p.read_bytes() for p in tmp_path.iterdir()}

    def full_disk(*args):
        raise OSError("No space left on device")

    monkeypatch.setattr("langsplat_core.formats.write_ply", full_disk)
    with pytest.raises(OSError, match="No space"):
        save_scene(path, full_scene(1))
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == before


def test_formats_that_are_not_written(tmp_path):
    with pytest.raises(InputError, match=r"scenes are written as \.ply, \.spz, \.splat"):
        save_scene(tmp_path / "scene.sog", full_scene())
    assert not list(tmp_path.iterdir())


def test_companions_lie_beside_every_kind_of_scene(tmp_path):
    scene = random_gaussians(N)
    packed = tmp_path / "a.compressed.ply"
    packed.write_bytes(compressed_ply(scene))
    folder = write_folder(tmp_path / "b.v2", sog_files(scene))
    for path, sidecar in (
        (packed, "a.compressed.langsplat.safetensors"),
        (folder, "b.v2.langsplat.safetensors"),
        (folder / "meta.json", "b.v2.langsplat.safetensors"),
    ):
        place = companion_path(path, language.SUFFIX)
        assert place == tmp_path / sidecar
        write_language(place, random_field(N), load_gaussians(path).means)
        loaded = load_scene(path)
        assert loaded.language is not None
        assert_same_field(loaded.language, random_field(N))


def test_cameras_of_an_inria_model(tmp_path):
    model = tmp_path / "model"
    save_scene(model / "other.ply", full_scene())
    (model / "other.cameras.json").rename(model / "cameras.json")
    path = model / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    write_ply(path, random_gaussians(5))
    assert len(load_scene(path).cameras) == 3


def test_what_is_not_a_scene(tmp_path):
    (tmp_path / "a.obj").write_bytes(b"x")
    with pytest.raises(InputError, match=r"a\.obj: not a scene of a known kind; supported: \.ply, .*\.sog"):
        load_scene(tmp_path / "a.obj")
    for nowhere in ("nowhere", "nowhere.ply", "nowhere.sog", "n" * 5000 + ".ply", "nul\0.ply"):
        with pytest.raises(InputError, match="no such file"):
            load_scene(tmp_path / nowhere)
    write_ply(tmp_path / ("n" * 240 + ".ply"), random_gaussians(1))  # its companions' names would be too long
    assert load_scene(tmp_path / ("n" * 240 + ".ply")).language is None
    write_ply(tmp_path / "model" / "iteration_7" / "point_cloud.ply", random_gaussians(1))
    with pytest.raises(InputError, match=r"perhaps .*model/iteration_7/point_cloud\.ply"):
        load_scene(tmp_path / "model")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"a folder without meta\.json is not a scene$"):
        load_scene(tmp_path / "empty")


def test_an_unusable_companion_is_an_error(tmp_path):
    save_scene(tmp_path / "scene.ply", full_scene())
    write_ply(tmp_path / "scene.ply", random_gaussians(N - 1))
    with pytest.raises(FormatError, match="made for 60 Gaussians, the scene has 59"):
        load_scene(tmp_path / "scene.ply")
    (tmp_path / "scene.langsplat.safetensors").unlink()
    (tmp_path / "scene.cameras.json").write_text("[")
    with pytest.raises(FormatError, match=r"scene\.cameras\.json: not readable as JSON"):
        load_scene(tmp_path / "scene.ply")

"""Scenes saved and loaded as a whole, with what lies beside them."""

import json
import os
from contextlib import nullcontext
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from langsplat_core.cli.query import QueryScene
from langsplat_core.cli.scenes import Inspect
from langsplat_core.errors import InputError
from langsplat_core.io.cameras import read_cameras, write_cameras
from langsplat_core.io.ply import write_ply
from langsplat_core.io.scenes import (
    CORE_FORMATS,
    LOSSES,
    check_writable,
    companion_path,
    formats,
    load_scene,
    load_without_language,
    save_scene,
    scene_files,
    summarise,
)
from langsplat_core.io.sidecar import SUFFIX as SIDECAR
from langsplat_core.io.sidecar import write_language
from langsplat_core.query.engine import QueryEngine
from langsplat_core.scene import Scene
from langsplat_core.scene.transform import moving, place_scene
from tests.support.fakes import blob_scene
from tests.support.file_samples import (
    assert_refused,
    assert_same_extras,
    assert_same_field,
    compressed_ply,
    load_gaussians,
    random_field,
    sog_files,
    write_folder,
)
from tests.support.processes import killed_everywhere, refusal, run
from tests.support.scenes import random_camera, random_extras, random_gaussians

N = 60
MARKS = (pytest.mark.long, pytest.mark.skipif(find_spec("pxr") is None, reason="no usd-core"))
WRITTEN = [pytest.param(row, marks=MARKS * (row not in CORE_FORMATS)) for row in formats() if row.write]


def full_scene(seed: int = 0) -> Scene:
    cameras = [replace(random_camera(i, width=70 + i), name=f"Tür {i}.a") for i in range(3)]
    cameras[1] = replace(cameras[1], orthographic=True)
    return Scene(random_gaussians(N, seed, sh_degree=1), random_field(N, seed=seed), cameras)


# ---- the law of round trips, over the table of formats ----


def spoilt(got: Scene, want: Scene) -> set[str]:
    """What of a scene is not as it was, in the words of `LOSSES`; what every format keeps is asserted."""
    assert len(got.gaussians) == len(want.gaussians)
    # the rows' order too
    np.testing.assert_allclose(got.gaussians.means, want.gaussians.means, atol=0.5 / 4096)
    assert_same_field(got.language, want.language)
    for a, b in zip(got.cameras, want.cameras, strict=True):
        # the centre of projection is stored instead of the translation: a few rounding errors
        np.testing.assert_allclose(a.world_to_camera, b.world_to_camera, atol=1e-14)
        assert {**vars(a), "world_to_camera": 0} == {**vars(b), "world_to_camera": 0}
    arrays = [vars(scene.gaussians).values() for scene in (got, want)]
    changed = {
        "precision": not all(map(np.array_equal, *arrays)),
        "view dependence": got.gaussians.sh_degree < want.gaussians.sh_degree,
        "antialiasing": got.antialiased != want.antialiased,
        "extra properties": not got.extras,
    }
    assert (*changed, "origin") == LOSSES
    if got.extras:
        assert_same_extras(got.extras, want.extras)
    return {name for name, lost in changed.items() if lost}


@pytest.mark.parametrize("degree", range(1, 4))
@pytest.mark.parametrize("row", WRITTEN, ids=lambda row: row.suffix)
def test_a_scene_keeps_what_its_format_holds_and_says_the_rest(tmp_path, row, degree, caplog):
    want = replace(full_scene(), gaussians=random_gaussians(N, sh_degree=degree), antialiased=True)
    want = replace(want, extras=random_extras(N), metres_per_unit=1 / 3)
    path = tmp_path / "new folder" / f"scene{row.suffix}"
    save_scene(path, want)
    got = load_scene(path)
    assert got.path == path
    lost = spoilt(got, want)
    assert lost == set(row.loses) - {"origin"}
    said = {what for what in (*LOSSES, "metres per unit") for line in caplog.messages if f" {what}" in line}
    assert said == (lost - {"precision"}) | ({"metres per unit"} if "origin" in row.loses else set())
    assert len(caplog.messages) == len(said)
    assert got.metres_per_unit == want.metres_per_unit
    stem = path.name if row.own_companions else path.stem
    names = {path.name, f"{stem}.cameras.json", f"{stem}.langsplat.safetensors"}
    names |= {f"{stem}.origin.json"} if "origin" in row.loses else set()
    assert {p.name for p in path.parent.iterdir()} == names == {p.name for p in scene_files(path)}
    save_scene(tmp_path / f"again{row.suffix}", got)  # a second turn loses nothing more
    np.testing.assert_array_equal(load_gaussians(tmp_path / f"again{row.suffix}").means, got.gaussians.means)


FAR = [(500_123.25, 5_412_345.5, 0.0), (4.0e6, 7.0e5, 4.9e6)]  # UTM, and from the earth's centre


@pytest.mark.parametrize("at", FAR, ids=["UTM", "ECEF"])
@pytest.mark.parametrize("row", WRITTEN, ids=lambda row: row.suffix)
def test_a_far_scene_is_kept_like_one_at_zero(tmp_path, row, at, caplog):
    near = full_scene()
    save_scene(tmp_path / f"near{row.suffix}", near)
    save_scene(tmp_path / f"far{row.suffix}", place_scene(near, moving(np.array(at))))
    loses = "origin" in row.loses
    assert sum("the origin" in message for message in caplog.messages) == loses
    assert (tmp_path / f"far{row.suffix}.origin.json").exists() == loses
    caplog.clear()
    want, got = (load_scene(tmp_path / f"{name}{row.suffix}") for name in ("near", "far"))
    assert not caplog.records
    assert np.abs(got.origin).max() > 1e5
    rounding = 2e-8 if "precision" not in row.loses or "origin" not in row.loses else 1e-4
    world = got.in_world(got.gaussians.means)
    np.testing.assert_allclose(world - at, want.gaussians.means, rtol=2e-7, atol=4 * rounding)
    for a, b in zip(got.cameras, want.cameras, strict=True):
        np.testing.assert_allclose(got.in_world(a.position) - at, b.position, atol=4e-9)
    assert_same_field(got.language, want.language)
    save_scene(tmp_path / f"again{row.suffix}", got)
    again = load_scene(tmp_path / f"again{row.suffix}")
    np.testing.assert_array_equal(again.in_world(again.gaussians.means), world)


def test_rounded_positions_are_drawn_and_told_of_once(tmp_path, caplog):
    gaussians = random_gaussians(N)
    rounded = (gaussians.means + np.array(FAR[0])).astype(np.float32)
    write_ply(tmp_path / "a.ply", replace(gaussians, means=rounded))
    write_language(tmp_path / FIELD, random_field(N), rounded)  # of before there were origins
    replace(gaussians, means=gaussians.means + np.array(FAR[0]))  # by nobody who could have an origin
    assert "rounded to 0.5 units: give Scene an origin" in caplog.text
    got = load_scene(tmp_path / "a.ply")
    assert got.language is not None
    assert ["steps of 0.5 units" in record.getMessage() for record in caplog.records] == [False, True]
    np.testing.assert_array_equal(got.in_world(got.gaussians.means), rounded)
    assert np.abs(got.gaussians.means).max() < 20


def test_replacing_a_scene_removes_its_companions_and_says_so(tmp_path, caplog):
    save_scene(tmp_path / "scene.ply", full_scene())
    save_scene(tmp_path / "scene.ply", Scene(random_gaussians(5)))
    assert [p.name for p in tmp_path.iterdir()] == ["scene.ply"]
    assert load_scene(tmp_path / "scene.ply").language is None
    assert [SIDECAR in said for said in caplog.messages] == [True, False]  # the other is of cameras


@pytest.mark.skipif(os.name == "nt", reason="no signal 9")
def test_a_killed_saving_never_leaves_a_mixture(tmp_path):
    path, old, new = tmp_path / "scene.ply", full_scene(0), full_scene(1)
    save_scene(path, old)
    for code in killed_everywhere(lambda: save_scene(path, new), tmp_path):
        got = load_scene(path)  # without a line about a sidecar of the other scene
        assert got.unread == ()
        (source,) = (one for one in (old, new) if np.array_equal(got.gaussians.means, one.gaussians.means))
        if got.language is not None:
            assert_same_field(got.language, source.language)
        if code:
            save_scene(path, old)
    assert code == 0
    assert source is new
    assert got.language is not None
    assert got.cameras


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
        place = companion_path(path, SIDECAR)
        assert place == tmp_path / sidecar
        write_language(place, random_field(N), load_gaussians(path).means)
        assert_same_field(load_scene(path).language, random_field(N))
    (tmp_path / "link").symlink_to(folder)
    assert load_scene(tmp_path / "link").language is not None
    write_language(tmp_path / f"link{SIDECAR}", random_field(N, seed=1), load_gaussians(folder).means)
    assert_same_field(load_scene(tmp_path / "link").language, random_field(N, seed=1))


@pytest.mark.parametrize("inner", ["", "meta.json"])
def test_scene_files_are_its_own_and_its_companions(tmp_path, inner):
    folder = write_folder(tmp_path / "b", sog_files(random_gaussians(N)))
    meta, *images, sidecar, cameras = scene_files(folder / inner)
    assert meta == folder / "meta.json"
    assert {path.name for path in images} == {path.name for path in folder.iterdir()} - {"meta.json"}
    beside = (tmp_path / "b.langsplat.safetensors", tmp_path / "b.cameras.json")
    assert (sidecar, cameras) == beside
    assert scene_files(tmp_path / "b.ply") == (tmp_path / "b.ply", *beside)


def test_companions_of_inria_models_and_links_are_found(tmp_path):
    model = tmp_path / "model"
    save_scene(model / "other.ply", full_scene())
    (model / "other.cameras.json").rename(model / "cameras.json")
    path = model / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    write_ply(path, random_gaussians(5))
    assert len(load_scene(path).cameras) == 3
    save_scene(model / "whole.ply", full_scene())
    for target, name in ((path, "link.ply"), (model / "whole.ply", "other.ply")):
        (tmp_path / name).symlink_to(target)
    assert len(load_scene(tmp_path / "link.ply").cameras) == 3
    assert load_scene(tmp_path / "other.ply").language is not None
    save_scene(tmp_path / "other.ply", replace(full_scene(), language=None))  # what it leads to goes along
    assert load_scene(model / "whole.ply").language is None


def test_loader_refuses_what_is_no_scene(tmp_path):
    (tmp_path / "a.obj").write_bytes(b"x")
    with pytest.raises(InputError, match=r"a\.obj: not a scene of a known kind; supported: \.ply, .*\.sog"):
        load_scene(tmp_path / "a.obj")
    for row in formats():
        with nullcontext() if row.write else pytest.raises(InputError, match="scenes are written as"):
            check_writable(tmp_path / f"a{row.suffix}")
    for nowhere in ("nowhere", "nowhere.ply", "nowhere.sog", "n" * 5000 + ".ply", "nul\0.ply"):
        with pytest.raises(InputError, match="no such file"):
            load_scene(tmp_path / nowhere)
    write_ply(tmp_path / ("n" * 240 + ".ply"), random_gaussians(1))  # its companions' names would be too long
    assert load_scene(tmp_path / ("n" * 240 + ".ply")).language is None
    for number in (7000, 30000):
        write_ply(tmp_path / f"model/point_cloud/iteration_{number}/point_cloud.ply", random_gaussians(1))
    write_ply(tmp_path / "a/b/c/d/too_far.ply", random_gaussians(1))
    said = {
        "model": r"perhaps .*model/point_cloud/iteration_30000/point_cloud\.ply$",
        ".": r"perhaps .*/n{240}\.ply$",
        "a": r"without meta\.json is not a scene$",
    }
    for name, message in said.items():
        with pytest.raises(InputError, match=message):
            load_scene(tmp_path / name)


def test_undrawable_gaussians_are_counted_and_refused_by_strict(tmp_path, caplog, capsys):
    gaussians, path = random_gaussians(N), tmp_path / "a.ply"
    write_ply(path, gaussians)
    assert run("--strict", "inspect", path) == 0
    gaussians.means[:2] = np.nan
    write_ply(path, gaussians)
    caplog.clear()
    assert len(load_scene(path).gaussians) == N
    assert f"2 of the {N} Gaussians cannot be drawn (position not finite)" in caplog.messages[0]
    assert "--strict" in refusal(capsys, "inspect", path, "--strict")
    assert run("inspect", path) == 0


# A scene whose companions are broken opens without them, and says why.

CAMERAS, FIELD = "a.cameras.json", "a.langsplat.safetensors"


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A scene with a field and cameras."""
    path = tmp_path / "a.ply"
    save_scene(path, replace(blob_scene(phrasebook=True), path=None))
    return path


def spoil(path: Path, name: str) -> None:
    companion = path.with_name(name)
    companion.write_bytes(companion.read_bytes()[:50])


def assert_not_written(scene, name):
    before = scene.path.with_name(name).read_bytes()
    with pytest.raises(InputError, match="mend or remove that"):
        save_scene(scene.path, scene)
    assert scene.path.with_name(name).read_bytes() == before


def test_unreadable_cameras_are_left_out(path, caplog):
    spoil(path, CAMERAS)
    scene = load_scene(path)
    assert (scene.cameras, len(scene.gaussians)) == ((), 360)
    assert scene.language is not None
    (reason,) = scene.unread
    assert CAMERAS in reason
    assert "\n" not in reason
    assert reason in caplog.text
    assert load_without_language(path).unread == scene.unread
    assert QueryEngine(scene).run("book").found
    assert_not_written(scene, CAMERAS)


@pytest.mark.parametrize("other", [False, True])
def test_an_unusable_sidecar_is_left_out(path, capsys, other):
    if other:
        scene = load_scene(path)
        save_scene(path.with_name("b.ply"), scene.take([1, 0, 2]))
        path.with_name("b.langsplat.safetensors").replace(path.with_name(FIELD))
    else:
        spoil(path, FIELD)
    scene = load_scene(path)
    assert scene.language is None
    assert len(scene.cameras) == 3
    (reason,) = scene.unread
    assert FIELD in reason
    for ask in (lambda: QueryEngine(scene).run("book"), QueryScene(path, ("book",)).run):
        with pytest.raises(InputError, match="looked at, not searched") as refused:
            ask()
        assert reason in str(refused.value)
    assert_not_written(scene, FIELD)
    Inspect(path, json=True).run()
    assert json.loads(capsys.readouterr().out)["unread"] == [reason]


# What `langsplat inspect` says of scenes whose faults are known.


def test_summary_counts_faults_by_reason():
    broken = random_gaussians(10, seed=2)
    broken.means[0, 1], broken.quats_wxyz[1:3] = np.nan, 0
    found = summarise(Scene(broken))
    assert (found["gaussians"], found["invalid_rows"], [*found["invalid"].values()]) == (10, 3, [1, 2])
    assert summarise(Scene(random_gaussians(0)))["bounds"] == [[0, 0, 0], [0, 0, 0]]


def test_inspect_prints_a_table_and_json(tmp_path, capsys):
    path, extras = tmp_path / "scene.ply", {"age": np.arange(N, dtype=np.float32)}
    save_scene(path, replace(full_scene(), antialiased=True, extras=extras))
    Inspect(path).run()
    assert "yes (Mip-Splatting)" in capsys.readouterr().out
    Inspect(path, json=True).run()
    answer = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert (answer["gaussians"], answer["cameras"]) == (N, 3)
    assert answer["disk_bytes"] == sum(file.stat().st_size for file in tmp_path.iterdir())
    assert answer["memory_bytes"] == 4 * N * (3 + 3 + 4 + 1 + 12 + 1 + 3 * (3 + 1))


# ---- INRIA's cameras.json ----


def entry(**changes):
    """A camera at (1, 2, 3) that is turned by 90 degrees about its down axis: it looks along world +x."""
    plain = {"id": 0, "img_name": "frame_01", "width": 64, "height": 48, "fx": 50.0, "fy": 55.0}
    plain |= {"position": [1.0, 2.0, 3.0], "rotation": [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]}
    return {key: value for key, value in (plain | changes).items() if value is not None}


def text_of(value: Any) -> bytes:
    """As JSON, what is no text yet."""
    return (value if isinstance(value, str) else json.dumps(value)).encode()


def test_cameras_follow_the_inria_convention(put):
    camera = read_cameras(put(text_of([entry()])))[0]
    np.testing.assert_allclose(camera.position, [1, 2, 3])
    np.testing.assert_allclose(camera.rotation[2], [1, 0, 0])  # forward, in the world
    pixel, depth = camera.project(np.array([[6.0, 2.0, 3.0], [6.0, 3.0, 3.0], [6.0, 2.0, 2.0]]))
    np.testing.assert_allclose(depth, 5)
    # the middle; below it, since y points down; to the right of it, which is world -z
    np.testing.assert_allclose(pixel, [[32, 24], [32, 24 + 55 / 5], [32 + 50 / 5, 24]])
    assert camera.name == "frame_01"
    moved = read_cameras(put(text_of([entry(cx=30, cy=20.5)])))[0]
    assert (moved.cx, moved.cy) == (30, 20.5)
    write_cameras(put(b""), (replace(camera, fx=np.float32(50.5), width=np.int64(64)),))  # NumPy's numbers


@pytest.mark.parametrize(
    ("stored", "name"),
    [("a.jpg", "a"), ("a.JPEG", "a"), ("frame.01", "frame.01"), ("x/y.png", "x/y"), ("", "")],
)
def test_camera_names_lose_the_suffix_of_an_image(put, stored, name):
    assert read_cameras(put(text_of([entry(img_name=stored)])))[0].name == name


def test_cameras_may_share_a_name(put, caplog):
    """INRIA's list of NeRF's synthetic scenes has an r_0 that trained and an r_0 that did not."""
    assert len(read_cameras(put(text_of([entry(), entry(position=[0, 0, 1])])))) == 2
    assert not caplog.messages


TURNED = np.array(entry()["rotation"])
MALFORMED = {
    "not a list": {"a": 1},
    "no width": [entry(), entry(width=None)],
    "a width for gigabytes": [entry(width=10**9)],
    "a place beyond sense": [entry(position=[0, 2e9, 0])],
    "a mirror": [entry(rotation=(-TURNED).tolist())],
}


@pytest.mark.parametrize("case", MALFORMED)
def test_malformed_cameras_are_refused_in_a_line(put, case):
    assert_refused(read_cameras, put(text_of(MALFORMED[case])))

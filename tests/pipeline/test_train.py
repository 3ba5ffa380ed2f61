"""The whole path on a tiny scene: photographs in, searchable scene out, interrupted and resumed."""

import json
import os
import pickle
import shutil
import signal
import sys
from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import load_file

from langsplat_core.config import ClipConfig, CodecConfig, LiftConfig, TrainConfig
from langsplat_core.errors import EncoderError, FormatError, InputError
from langsplat_core.interrupts import raised
from langsplat_core.io import apart
from langsplat_core.io.files import write_json
from langsplat_core.io.scenes import load_scene, save_scene
from langsplat_core.pipeline.evidence import kept_photographs
from langsplat_core.pipeline.report import read_report
from langsplat_core.pipeline.stages import sole_use
from langsplat_core.pipeline.train import tasks_for, train_captures, train_scene
from langsplat_core.progress import Progress, Report, WorkCancelledError
from langsplat_core.query.engine import QueryEngine
from langsplat_core.semantics.masks import LevelMasks, MaskSource
from tests.support.fakes import blob_scene
from tests.support.file_kinds import taught_word
from tests.support.file_samples import assert_same_tree
from tests.support.processes import in_this_process, python, refusal, run, stop_at
from tests.support.tiny_models import tiny_room, tiny_settings

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_room(tmp_path_factory.mktemp("room"))


@pytest.fixture(scope="module")
def whole(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    train_scene(room, folder / "scene.ply", tiny_settings(room))
    return folder


@pytest.fixture
def trained(whole: Path, tmp_path: Path) -> Path:
    """A scene, with its work folder beside it, that a test may change."""
    shutil.copytree(whole, tmp_path, dirs_exist_ok=True)
    return tmp_path / "scene.ply"


def scene_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def test_training_keeps_a_calibration_for_drawn_rooms_alone(room, tmp_path):
    """Also by a work folder of earlier."""
    data, sidecar = tmp_path / "room", tmp_path / "scene.langsplat.safetensors"
    shutil.copytree(room, data)
    odds = {"constant": 0, "whole": 1, "finer": 1}
    (data / "encoder" / "reading.json").write_text(
        json.dumps({"found": 0.7, "calibration": dict.fromkeys(("thing", "part", "inside"), odds)})
    )
    made = []
    for drawn in (True, False):
        frames = json.loads((data / "transforms.json").read_text())
        (data / "transforms.json").write_text(json.dumps({**frames, "drawn": drawn}))
        train_scene(data, tmp_path / "scene.ply", tiny_settings(data))
        field = load_scene(tmp_path / "scene.ply").language
        made.append((field.found, field.calibration is not None, load_file(sidecar)))
    assert [(found, kept) for found, kept, _ in made] == [(0.7, True), (0.7, False)]
    for name, tensor in made[0][2].items():
        np.testing.assert_array_equal(tensor, made[1][2][name])


def test_photographs_become_a_searchable_scene(room, tmp_path):
    out = tmp_path / "scene.ply"
    report = train_scene(str(room), str(out), tiny_settings(room))
    scene = load_scene(out)
    assert scene.metres_per_unit == 0.5
    assert report.views == len(scene.cameras) == 3
    assert report.held_out == 2
    assert report.gaussians == len(scene.gaussians) > 0
    assert report.psnr is not None
    assert any("below 16:" in warning for warning in report.warnings) == (report.psnr < 16)
    assert report.observed > 0.5
    assert report.masks == "graph (no weights)"
    np.testing.assert_allclose(np.linalg.norm(scene.language.canonical, axis=1), 1, atol=1e-5)
    result = QueryEngine(scene).run("Red  Mug")  # from the phrasebook: no encoder is loaded
    assert result.relevancy.shape == (3, len(scene.gaussians))
    assert 0 < result.peak < 1


STAGES = (
    "radiance-*.ply",
    "features/*.npz",
    "member*/*.npy",
    "member*/groups.npz",
    "codec-*.npz",
    "latents-*.npz",
    "nodes-*.npz",
)


def kept_results(work: Path) -> dict[str, int]:
    """Every file that a stage keeps, and when it was written."""
    return {str(path): path.stat().st_mtime_ns for pattern in STAGES for path in sorted(work.glob(pattern))}


def test_the_same_command_repeats_no_stage(room, trained):
    work, before = trained.with_name("scene.work"), scene_in(trained.parent)
    kept, first = kept_results(work), read_report(work)
    for pattern in STAGES:
        assert list(work.glob(pattern)), pattern
    again = train_scene(room, trained, tiny_settings(room))
    assert kept_results(work) == kept
    assert scene_in(trained.parent) == before
    assert replace(again, seconds={}) == replace(first, seconds={})
    (path,), (gaussians,) = work.glob("nodes-*.npz"), work.glob("radiance-*.ply")
    tree = load_scene(trained).language.tree
    assert (tree.votes[tree.levels == 2] > 0).any()
    path.unlink()  # as in a work folder of before there were any: they alone are found again
    gaussians.with_suffix(".digest").unlink()  # as if a run had ended before it was written
    train_scene(room, trained, tiny_settings(room))
    now = kept_results(work)
    assert {name for name in now if now[name] != kept.get(name)} == {str(path), str(gaussians)}
    assert_same_tree(load_scene(trained).language.tree, tree)


def test_replacing_a_scene_of_another_training_is_said(room, tmp_path, caplog):
    out, settings = tmp_path / "scene.ply", tiny_settings(room)
    other, moved = tmp_path / "other", tmp_path / "moved"
    shutil.copytree(room, other)
    table = [(room, "one", 0), (room, "one", 0), (room, "two", 1), (room, "one", 1), (other, "one", 1)]
    for dataset, work, said in (*table, (moved, "one", 0)):
        if dataset == moved:
            other.rename(moved)
        caplog.clear()
        train_scene(dataset, out, settings, tmp_path / work, until="gaussians")
        assert caplog.text.count("was not made by") == said


def test_a_setting_repeats_only_what_depends_on_it(room, trained):
    work = trained.with_name("scene.work")
    before = kept_results(work)
    train_scene(room, trained, replace(tiny_settings(room), codec=CodecConfig(size=9)))
    added = {Path(name).name.partition("-")[0] for name in set(kept_results(work)) - set(before)}
    assert added == {"codec", "latents", "nodes"}
    train_scene(room, trained, replace(tiny_settings(room), lift=LiftConfig(backend="cpu")))
    assert len(kept_results(work)) == len(before) + 3  # who computes changes nothing
    for steps in (10, 20):
        lift, codec = LiftConfig(mode="gradient", steps=steps), CodecConfig("autoencoder", steps=30)
        train_scene(room, trained, replace(tiny_settings(room), lift=lift, codec=codec))
    # More steps of lifting do not fit the codec again.
    assert (len(list(work.glob("codec-*.npz"))), len(list(work.glob("latents-*.npz")))) == (3, 4)


CUT = [(name, True) for name in ("member*/*.npy", "member*/*.npz", "codec-*", "latents-*", "nodes-*")]


@pytest.mark.parametrize(("name", "cut"), [*CUT, ("member*/*.npy", False), ("radiance-*.ply", False)])
def test_a_damaged_stage_ends_in_one_line(room, trained, name, cut):
    """Cut off, or with one bit that is another."""
    work = trained.with_name("scene.work")
    damaged = sorted(work.glob(name))
    for path in damaged:
        data = path.read_bytes()
        path.write_bytes(data[:100] if cut else data[:-40] + bytes([data[-40] ^ 1]) + data[-39:])
    for path in {*work.glob("*.np[yz]"), *work.glob("member*/*")} - set(damaged):
        path.unlink()
    with pytest.raises(FormatError, match="delete it and run again"):
        train_scene(room, trained, tiny_settings(room))


@pytest.mark.parametrize("mode", ["mean", "one-pass", "gradient"])
def test_every_lifting_mode_trains(room, tmp_path, mode):
    linear = CodecConfig("linear", latent_dim=8)
    config = replace(tiny_settings(room), lift=LiftConfig(mode=mode, steps=30), codec=linear)
    if mode != "mean":
        with pytest.raises(InputError, match=r"add --codec\.kind autoencoder"):
            train_scene(room, tmp_path / "scene.ply", replace(config, codec=CodecConfig()))
    train_scene(room, tmp_path / "scene.ply", config)
    field = load_scene(tmp_path / "scene.ply").language
    assert field.codec.kind == "linear"
    assert np.isfinite(field.latents).all()
    assert field.tree.votes.any() == (mode == "mean")  # averaging latents needs no mask weights


def spend_an_hour(work: Path) -> None:
    """Write into a work folder that Gaussians took an hour so far."""
    (seconds,) = work.glob("seconds-*.json")
    stated = json.loads(seconds.read_bytes())
    write_json(seconds, stated | {"seconds": {"radiance": 3_600.0}})


def test_a_run_interrupted_in_every_stage_ends_with_the_same_bytes(room, whole, tmp_path):
    stages = "reading", "masks", "training", "lifting", "merging", "describing", "codebook", "averaging"
    for stage in (*stages, "building"):
        with pytest.raises(WorkCancelledError):
            train_scene(room, tmp_path / "scene.ply", tiny_settings(room), progress=stop_at(stage, 0.1))
        assert scene_in(tmp_path) == {}
    spend_an_hour(tmp_path / "scene.work")
    assert train_scene(room, tmp_path / "scene.ply", tiny_settings(room)).seconds["radiance"] >= 3_600
    assert scene_in(tmp_path) == scene_in(whole)


def test_photographs_changed_in_place_are_refused_and_timed_anew(tmp_path, caplog):
    room, out = tiny_room(tmp_path / "room"), tmp_path / "scene.ply"
    train_scene(room, out, tiny_settings(room), until="gaussians")
    for changed in (False, True):
        with pytest.raises(InputError, match="photo_1; train again") if changed else nullcontext():
            kept_photographs(out, load_scene(out))
        caplog.clear()
        kept_photographs(out, load_scene(out), dataset=room)
        assert ("something else: photo_1" in caplog.text) == changed
        spend_an_hour(tmp_path / "scene.work")
        seconds = train_scene(room, out, tiny_settings(room), until="gaussians").seconds
        assert (seconds["radiance"] < 3_600) == changed
        Image.new("RGB", (64, 48)).save(room / "images" / "photo_1.png")


def test_unusable_arguments_are_refused_before_work(room, tmp_path):
    for out in (tmp_path / "scene.splat", Path()):
        with pytest.raises(InputError, match=r"\*\.ply"):
            train_scene(room, out, tiny_settings(room))
    absent = replace(tiny_settings(room), clip=ClipConfig(model=str(tmp_path / "nothing")))
    with pytest.raises(EncoderError, match=r"--clip\.model"):
        train_scene(room, tmp_path / "scene.ply", absent)
    with pytest.raises(InputError):
        train_scene(tmp_path / "missing", tmp_path / "scene.ply", tiny_settings(room))
    with pytest.raises(InputError, match=r"^--codec\.batch "):
        train_scene(room, tmp_path / "scene.ply", TrainConfig(codec=CodecConfig("autoencoder", batch=1)))
    assert not list(tmp_path.glob("**/*.ply"))


class Blind(MaskSource):
    name = key = "blind"

    def __call__(self, image: np.ndarray, progress: Progress) -> LevelMasks:
        none = np.zeros((0, *image.shape[:2]), bool)
        return none, none, none


def test_without_any_mask_no_gaussians_are_trained(room, tmp_path):
    out, said = tmp_path / "scene.ply", []
    progress = Progress(lambda at: said.append(at.stage))
    with pytest.raises(InputError, match=r"no photograph has masks.*--masks\.source graph"):
        train_scene(room, out, tiny_settings(room), progress=progress, masks_of=lambda _: Blind())
    assert "masks and vectors" in said
    assert "training Gaussians" not in said
    assert not list(tmp_path.glob("**/*.ply"))
    train_scene(room, out, tiny_settings(room))  # in the same work folder, as the message advises
    assert load_scene(out).language is not None


def test_two_views_are_no_scene_unless_told_otherwise(room, tmp_path):
    pair = tmp_path / "pair"
    shutil.copytree(room, pair)
    transforms = json.loads((pair / "transforms.json").read_text())
    two, lost = transforms["frames"][:2], {**transforms["frames"][2], "file_path": "lost.png"}
    config = tiny_settings(room)
    for frames, points in (([*two, lost], "none.ply"), (two, transforms.get("ply_file_path"))):
        stated = {**transforms, "frames": frames, "ply_file_path": points}
        (pair / "transforms.json").write_text(json.dumps(stated))
        why = r"lost\.png.*none\.ply" if points == "none.ply" else r"photo_2\.png"  # all that was lost
        said = rf"only 2 photographs have cameras \(.*{why}.*\).*--dataset.allow-few-cameras"
        with pytest.raises(InputError, match=said):
            train_scene(pair, tmp_path / "scene.ply", config)
    told = replace(config, dataset=replace(config.dataset, allow_few_cameras=True))
    assert train_scene(pair, tmp_path / "scene.ply", told).views == 1


def test_given_gaussians_are_described_and_not_trained(room, tmp_path):
    first = tmp_path / "trained.ply"
    assert train_scene(room, first, tiny_settings(room), until="gaussians").mask_count == 0
    assert load_scene(first).language is None
    again = tmp_path / "again.ply"
    options = ["--dataset.max-side", 64, "--dataset.test-every", 4, "--masks.source", "graph"]
    options += ["--clip.model", room / "encoder", "--clip.device", "cpu", "--codec.size", 9]
    assert run("train", room, "--out", again, "--gaussians", first, *options) == 0
    assert again.read_bytes() == first.read_bytes()
    assert not list((tmp_path / "again.work").glob("radiance*"))
    assert load_scene(again).language.codec.size == 9
    assert run("train", room, "--out", again, "--gaussians", tmp_path / "missing.ply", *options) == 2
    before, age = load_scene(again), {"age": np.zeros(len(load_scene(again).gaussians))}
    taught = replace(before.language, taught=(taught_word("lamp", before.language.codec.vector_dim),))
    # the photographs say 0.5
    save_scene(first, replace(before, language=taught, antialiased=True, extras=age, metres_per_unit=0.25))
    assert run("train", room, "--out", again, "--gaussians", first, *options) == 0
    after = load_scene(again)
    assert (after.metres_per_unit, after.antialiased, list(after.extras)) == (0.25, True, ["age"])
    assert [word.name for word in after.language.taught] == ["lamp"]
    assert not np.array_equal(after.language.confidence, before.language.confidence)


def test_paper_profile_runs(room, tmp_path):
    out = tmp_path / "scene.ply"
    options = ["--dataset.max-side", 64, "--dataset.test-every", 4, "--radiance.steps", 10]
    options += ["--masks.source", "graph", "--clip.model", room / "encoder", "--clip.device", "cpu"]
    options += ["--codec.steps", 30, "--lift.steps", 20, "--phrases", "red mug"]
    assert run("train", room, "--out", out, "--profile", "paper", *options) == 0
    assert run("query", out, "red mug", "--mode", "paper") == 0
    assert load_scene(out).language.latents.shape[2] == 3


# What changes around a training between its interruption and its end, and around a program that reads.

FUTURE = 4_070_000_000  # in 2098


def interrupted(room: Path, folder: Path, config: TrainConfig) -> None:
    """A training that ends when most of its steps are done, with a checkpoint."""
    with pytest.raises(WorkCancelledError):
        train_scene(room, folder / "scene.ply", config, progress=stop_at("training Gaussians", 0.75))
    assert list((folder / "scene.work").glob("*.checkpoint.safetensors"))


def test_changed_options_and_photographs_start_fresh_stages(room: Path, tmp_path: Path) -> None:
    """The scene is that of a run in an empty folder."""
    data, config = tmp_path / "data", tiny_settings(room)
    shutil.copytree(room, data)
    interrupted(data, tmp_path, config)
    photo = data / "images" / "photo_1.png"
    pixels = np.array(Image.open(photo))
    pixels[:9] = 255 - pixels[:9]
    Image.fromarray(pixels).save(photo)
    (data / "images" / "photo_3.png").unlink()
    changed = replace(config, radiance=replace(config.radiance, seed=7))
    (tmp_path / "fresh").mkdir()
    for settings in (config, changed):
        for out in (tmp_path, tmp_path / "fresh"):
            train_scene(data, out / "scene.ply", settings)
        assert scene_in(tmp_path) == scene_in(tmp_path / "fresh")


def test_a_moved_work_folder_resumes_whatever_its_dates(room: Path, whole: Path, tmp_path: Path) -> None:
    shutil.copytree(room, tmp_path / "here" / "data")
    interrupted(tmp_path / "here" / "data", tmp_path / "here", tiny_settings(room))
    there = (tmp_path / "here").rename(tmp_path / "there")
    for path in [path for path in there.rglob("*") if path.is_file()]:
        os.utime(path, (FUTURE, FUTURE))
    reported: list[float] = []

    def watch(at: Report) -> None:
        if at.stage == "training Gaussians":
            reported.append(at.fraction)

    train_scene(there / "data", there / "scene.ply", tiny_settings(room), progress=Progress(watch))
    assert min(reported) > 0.5  # it went on from the checkpoint
    assert scene_in(there) == scene_in(whole)


def test_query_needs_no_home_locale_or_writable_folder(tmp_path: Path) -> None:
    """The scene's folder and the file are read-only, and its name is not ASCII."""
    folder = tmp_path / "büro"
    folder.mkdir()
    save_scene(folder / "tür.ply", blob_scene(phrasebook=True))
    for path in [*folder.iterdir(), folder]:
        path.chmod(0o555)
    names = ("PATH", "PYTHONPATH", "NUMBA_CACHE_DIR")
    kept = {name: os.environ[name] for name in names if name in os.environ}
    words = ("-m", "langsplat_core", "query", folder / "tür.ply", "book", "--json")
    env = kept | {"HOME": "/nonexistent", "LANG": "xx_YY.nothing", "LC_ALL": "C"}
    done = python(*words, env=env, cwd=folder, bound=True)
    folder.chmod(0o755)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)[0]["phrase"] == "book"
    assert sorted(path.suffix for path in folder.iterdir()) == [".json", ".ply", ".safetensors"]


# Several captures.


class Client(Executor):
    """A client of Dask, as far as it is used: what it is given and gives back goes through pickle."""

    def __init__(self, address: str) -> None:
        if address == "nobody:1":
            raise OSError("Timed out trying to connect")

    def get_executor(self, pure: bool) -> "Client":
        assert not pure  # it would take a second training for the first
        return self

    def submit(self, function: Callable, *task: object) -> Future:
        done, result = Future(), function(*pickle.loads(pickle.dumps(task)))
        done.set_result(pickle.loads(pickle.dumps(result)))
        return done


def several(room: Path, on: str, out: Path) -> list[object]:
    options = f"--on={on} --dataset.max-side=64 --radiance.steps=20 --dataset.hold-out=every"
    return ["train", room, "absent", "--out", out, "--clip.model", room / "encoder", *options.split()]


@pytest.mark.parametrize("on", ["local:2", "dask://somewhere:8786"])
def test_captures_are_trained_whatever_becomes_of_others(room, on, tmp_path, capsys, monkeypatch):
    if on != "local:2":
        in_this_process(monkeypatch)
        monkeypatch.setitem(sys.modules, "distributed", SimpleNamespace(Client=Client))
    assert run(*several(room, on, tmp_path)) == 2
    printed = capsys.readouterr()
    rows = {line.split()[0]: line for line in printed.out.splitlines() if line[0] != " "}
    assert rows["absent"].split()[1:3] + rows["absent"].split()[-1:] == ["-", "-", "2"]
    assert f" 5 of 5   {read_report(tmp_path / f'{room.name}.work').psnr:.2f} dB " in rows[room.name]
    assert rows[room.name].endswith(" 0")
    assert printed.err.splitlines()[-1] == "langsplat: 1 of 2 captures have no scene: absent"
    assert [path.name for path in tmp_path.glob("*.ply")] == [f"{room.name}.ply"]
    assert not list(tmp_path.glob(".wanted*"))


def test_ctrl_c_ends_all_captures_and_keeps_what_they_have(room: Path, tmp_path: Path) -> None:
    made, heard = tiny_settings(room), list[str]()
    endless = replace(made, radiance=replace(made.radiance, steps=1_000_000, capped_views=0))

    def stop(at: Report) -> None:
        heard.append(at.note)
        if heard.count(f"{room.name}: training Gaussians") == 5:
            os.kill(os.getpid(), signal.SIGTERM)

    ended = train_captures(tasks_for([room], tmp_path, endless, "gaussians"), "local:1", Progress(stop))
    with pytest.raises(KeyboardInterrupt), raised("langsplat", ""), closing(ended):
        list(ended)
    work = tmp_path / f"{room.name}.work"
    with sole_use(work):  # nobody holds it any more
        assert list(work.glob("*.checkpoint.safetensors"))


def test_lost_processes_and_twins_are_told(room, tmp_path, monkeypatch):
    def lost(*_: object, **__: object) -> None:
        raise apart.AbortedError("ended with SIGKILL")

    monkeypatch.setattr(apart, "run", lost)
    (row,) = train_captures(tasks_for([room], tmp_path, tiny_settings(room), "gaussians"), "local:1")
    assert (row.code, row.said) == (1, ("its process ended with SIGKILL",))
    with pytest.raises(InputError, match="rename one of them"):
        tasks_for([room, tmp_path / room.name], tmp_path, tiny_settings(room), "gaussians")


def test_an_engine_that_is_not_there_is_named_with_its_remedy(room, tmp_path, capsys, monkeypatch):
    for on, distributed, said in (
        ("local:0", None, "there is local:N"),
        ("slurm://x", None, "there is local:N"),
        ("dask://x:1", None, 'pip install "langsplat-viewer[dask]"'),
        ("dask://nobody:1", SimpleNamespace(Client=Client), "is `dask scheduler` running there?"),
    ):
        monkeypatch.setitem(sys.modules, "distributed", distributed)
        assert said in refusal(capsys, *several(room, on, tmp_path / "scenes"))
    assert not list(tmp_path.iterdir())

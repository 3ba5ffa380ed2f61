"""What `langsplat inspect` says of scenes whose faults are known."""

import json
from dataclasses import fields, replace

import numpy as np
import pytest

from langsplat_core.cli.scenes import Inspect
from langsplat_core.io import save_scene
from langsplat_core.io.summary import disk_bytes, duplicates, summarise
from langsplat_core.scene import NO_THING, Calibration, Gaussians, Odds, Reading, Scene
from tests.support.file_samples import random_field
from tests.support.scenes import random_camera, random_gaussians


def joined(*parts: Gaussians) -> Gaussians:
    return Gaussians(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Gaussians)))


def test_planted_faults_are_counted():
    clean = random_gaussians(40, seed=1, sh_degree=1)
    broken = random_gaussians(4, seed=2, sh_degree=1)
    broken.means[0, 1] = np.nan
    broken.quats_wxyz[1] = 0
    broken.opacity_logits[2] = np.nan
    broken.sh[3, 0, 0] = np.inf
    needles = random_gaussians(2, seed=3, sh_degree=1)
    needles.log_scales[:] = np.log([1.0, 1e-4, 1e-2])
    found = summarise(Scene(joined(clean, broken, needles, clean.take(np.arange(5)))))
    assert found.gaussians == 51
    assert found.invalid_rows == 4
    assert sum(found.invalid.values()) == 4
    assert len(found.invalid) == 4
    assert found.duplicates == 5
    assert found.needles == 2
    assert found.anisotropy[2] == pytest.approx(1e4, rel=1e-5)


def test_rows_that_differ_in_one_number_are_no_duplicates():
    gaussians = joined(*[random_gaussians(1, seed=1)] * 3)
    assert duplicates(gaussians) == 2
    gaussians.sh[1, 0, 2] += 1e-3
    assert duplicates(gaussians) == 1


def test_opacity_shares_and_energy():
    gaussians = random_gaussians(4, sh_degree=2)
    gaussians.opacity_logits[:] = [-np.inf, -6.0, 0.1, np.inf]  # opacities 0, 0.0025, 0.525, 1
    gaussians.sh[:] = 0
    gaussians.sh[:, 0] = 0.5 / 0.28209479177387814  # with the offset, colour 1 everywhere
    gaussians.sh[:, 4] = 2 / 0.28209479177387814
    found = summarise(Scene(gaussians))
    assert found.opacity_shares == (0.5, 0.0, 0.0, 0.25, 0.25)
    assert found.sh_energy == pytest.approx((0.2, 0.0, 0.8))


def test_flat_and_empty_scenes_have_an_answer():
    flat = random_gaussians(3)
    flat.log_scales[:, 0] = -np.inf
    assert summarise(Scene(flat)).anisotropy == (None, None, None)
    assert summarise(Scene(flat)).needles == 3
    empty = summarise(Scene(random_gaussians(0)))
    assert (empty.gaussians, empty.duplicates, empty.needles) == (0, 0, 0)


def test_the_command_prints_a_table_and_json(tmp_path, capsys):
    gaussians = random_gaussians(30, sh_degree=1)
    path = tmp_path / "scene.ply"
    field = random_field(30)
    extras = {"age": np.arange(30, dtype=np.float32)}
    scene = Scene(gaussians, field, (random_camera(),), antialiased=True, extras=extras)
    save_scene(path, scene)
    Inspect(path).run()
    text = capsys.readouterr().out
    for words in ("Gaussians         30\n", "yes (Mip-Splatting)", "age", "codec"):
        assert words in "\n".join(line.rstrip() for line in text.splitlines()) + "\n", words
    Inspect(path, json=True).run()
    answer = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert answer["gaussians"] == 30
    assert answer["cameras"] == 1
    assert answer["disk_bytes"] == sum(file.stat().st_size for file in tmp_path.iterdir())
    assert answer["memory_bytes"] == 4 * 30 * (3 + 3 + 4 + 1 + 12 + 1 + 3 * (field.latents.shape[2] + 1))
    flat = replace(gaussians, log_scales=np.full((30, 3), [-np.inf, 0, 0]))
    save_scene(path, Scene(flat))
    Inspect(path, json=True).run()
    json.loads(capsys.readouterr().out, parse_constant=pytest.fail)


def test_size_of_a_folder_counts_its_files(real_data):
    folder = real_data / "gaussians" / "playbot_8k_sog"
    expected = sum(file.stat().st_size for file in folder.iterdir())
    assert disk_bytes(folder) == disk_bytes(folder / "meta.json") == expected


def test_things_are_counted():
    field = random_field(40)
    things = np.array([3, 3, 9, NO_THING] * 10, np.uint16)
    plain, named = (
        summarise(Scene(random_gaussians(40), made)) for made in (field, replace(field, things=things))
    )
    assert (plain.language.things, named.language.things) == (None, 2)
    assert named.language.bytes - plain.language.bytes == things.nbytes
    assert named.memory_bytes - plain.memory_bytes == things.nbytes
    odds = Odds(0, 1, 0)
    sure = replace(field, reading=Reading(calibration=Calibration(odds, odds, odds)))
    assert not plain.language.calibrated
    assert summarise(Scene(random_gaussians(40), sure)).language.calibrated

"""Checkpoints: exact, atomic, refused when they do not belong to the run."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from langsplat_core.config import RadianceConfig
from langsplat_core.datasets.capture import Capture
from langsplat_core.errors import FormatError, InputError
from langsplat_core.scene import Gaussians, look_at
from langsplat_core.training.radiance.state import (
    PARAMETERS,
    TrainingState,
    fingerprint,
    load_checkpoint,
    save_checkpoint,
    start,
)

CPU = torch.device("cpu")


def make_state() -> TrainingState:
    rng = np.random.default_rng(0)
    arrays = [rng.normal(size=shape) for shape in ((9, 3), (9, 3), (9, 4), (9,), (9, 4, 3))]
    state = start(Gaussians(*arrays), 5, CPU)
    for name in PARAMETERS:
        state.first[name] += torch.rand_like(state.first[name])
        state.second[name] += torch.rand_like(state.second[name])
    state.grad_sum += 0.25
    state.seen += 3
    state.step, state.queue, state.non_finite = 17, [2, 0], 1
    state.updates["means"] = 17
    state.rng.standard_normal(3)
    return state


def make_capture() -> Capture:
    rng = np.random.default_rng(1)
    cameras = [look_at(eye, np.zeros(3), np.array([0, 1, 0]), (8, 6)) for eye in np.eye(3) * 4 + 0.1]
    images = [rng.integers(0, 255, (6, 8, 3), dtype=np.uint8) for _ in cameras]
    return Capture(tuple(cameras), tuple(images), np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


def test_round_trip_is_exact(tmp_path: Path) -> None:
    state = make_state()
    path = tmp_path / "run.safetensors"
    save_checkpoint(path, state, "abc")
    back = load_checkpoint(path, "abc", CPU)
    for name in PARAMETERS:
        assert torch.equal(back.values[name], state.values[name])
        assert back.values[name].requires_grad
        assert torch.equal(back.first[name], state.first[name])
        assert torch.equal(back.second[name], state.second[name])
    assert torch.equal(back.grad_sum, state.grad_sum)
    assert torch.equal(back.seen, state.seen)
    assert (back.step, back.queue, back.non_finite, back.updates) == (17, [2, 0], 1, state.updates)
    assert back.rng.standard_normal(4).tolist() == state.rng.standard_normal(4).tolist()
    assert [file.name for file in tmp_path.iterdir()] == ["run.safetensors"]  # no temporary file left


def test_a_checkpoint_of_another_run_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.safetensors"
    save_checkpoint(path, make_state(), "abc")
    with pytest.raises(InputError, match="other photographs or settings; delete it") as caught:
        load_checkpoint(path, "def", CPU)
    assert not isinstance(caught.value, FormatError)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("damage", ["truncated", "text", "empty", "foreign", "missing tensor"])
def test_a_damaged_file_gives_one_line(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "run.safetensors"
    save_checkpoint(path, make_state(), "abc")
    whole = path.read_bytes()
    if damage == "truncated":
        path.write_bytes(whole[:-20])
    elif damage == "text":
        path.write_text("not a checkpoint")
    elif damage == "empty":
        path.write_bytes(b"")
    elif damage == "foreign":
        save_file({"x": torch.zeros(2)}, path)
    else:
        path.write_bytes(whole.replace(b"values.means", b"values.meanz"))
    with pytest.raises(FormatError, match="not a usable checkpoint") as caught:
        load_checkpoint(path, "abc", CPU)
    assert "\n" not in str(caught.value)


def test_the_fingerprint_knows_what_decides_the_result() -> None:
    capture, config = make_capture(), RadianceConfig()
    base = fingerprint(capture, config, [0, 1])
    assert fingerprint(make_capture(), config, [0, 1]) == base
    assert fingerprint(capture, replace(config, checkpoint_every=7, backend="cpu"), [0, 1]) == base
    assert fingerprint(capture, replace(config, seed=1), [0, 1]) != base
    assert fingerprint(capture, config, [0, 2]) != base
    brighter = [capture.images[0] + 1, *capture.images[1:]]
    assert fingerprint(replace(capture, images=tuple(brighter)), config, [0, 1]) != base
    moved = [replace(capture.cameras[0], fx=9.0), *capture.cameras[1:]]
    assert fingerprint(replace(capture, cameras=tuple(moved)), config, [0, 1]) != base

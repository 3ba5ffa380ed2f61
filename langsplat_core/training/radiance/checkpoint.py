"""Checkpoints of radiance training: one safetensors file, written atomically, resumed exactly.

Tensors: ``values.*``, ``first.*``, ``second.*`` for every parameter, ``grad_sum`` and ``seen``; everything
else is JSON in the header. No pickle is involved, so a checkpoint from elsewhere cannot run code.
"""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file

from langsplat_core.config import RadianceConfig
from langsplat_core.datasets.capture import Capture
from langsplat_core.errors import FormatError, InputError
from langsplat_core.files import atomic_path
from langsplat_core.training.radiance.state import PARAMETERS, TrainingState

KIND = "langsplat-radiance-checkpoint-1"


def fingerprint(capture: Capture, config: RadianceConfig, train_indices: Sequence[int]) -> str:
    """A digest of everything that decides the result of a training, photographs included.

    The backend and how often checkpoints are written are left out: a run may go on elsewhere.
    """
    settings = asdict(config)
    settings.pop("checkpoint_every")
    settings.pop("backend")
    every = [camera.world_to_camera.tolist() for camera in capture.cameras]  # their spread sets the rates
    facts = [settings, every, capture.digest(train_indices)]
    return hashlib.blake2b(json.dumps(facts, sort_keys=True).encode(), digest_size=16).hexdigest()


def save_checkpoint(path: Path, state: TrainingState, made_from: str) -> None:
    """Write `state`; `made_from` is the run's `fingerprint`."""
    tensors = {"grad_sum": state.grad_sum, "seen": state.seen}
    for name in PARAMETERS:
        tensors[f"values.{name}"] = state.values[name].detach()
        tensors[f"first.{name}"] = state.first[name]
        tensors[f"second.{name}"] = state.second[name]
    header = {
        "fingerprint": made_from,
        "step": state.step,
        "updates": state.updates,
        "queue": state.queue,
        "non_finite": state.non_finite,
        "rng": state.rng.bit_generator.state,
    }
    with atomic_path(path) as temporary:
        save_file(
            {name: tensor.contiguous().cpu() for name, tensor in tensors.items()},
            temporary,
            metadata={"kind": KIND, "state": json.dumps(header)},
        )


def load_checkpoint(path: Path, made_from: str, device: torch.device) -> TrainingState:
    """Read what `save_checkpoint` wrote.

    Raises FormatError for a file that is no checkpoint and InputError for one of another run.
    """
    tensors: dict[str, torch.Tensor] = {}
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name).to(device) for name in file.keys()}  # noqa: SIM118
        if metadata.get("kind") != KIND:
            raise ValueError(f"kind {metadata.get('kind')!r}")
        header = json.loads(metadata["state"])
        if header["fingerprint"] != made_from:
            raise InputError(
                f"{path}: this checkpoint belongs to other photographs or settings; "
                "delete it to train afresh, or give the arguments it was made with"
            )
        return _rebuild(tensors, header)
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        problem = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FormatError(f"{path}: not a usable checkpoint ({problem}); delete it to train afresh") from None


def _rebuild(tensors: dict[str, torch.Tensor], header: dict[str, Any]) -> TrainingState:
    rng = np.random.default_rng()
    rng.bit_generator.state = header["rng"]
    return TrainingState(
        values={name: tensors[f"values.{name}"].requires_grad_() for name in PARAMETERS},
        first={name: tensors[f"first.{name}"] for name in PARAMETERS},
        second={name: tensors[f"second.{name}"] for name in PARAMETERS},
        updates={name: int(header["updates"][name]) for name in PARAMETERS},
        grad_sum=tensors["grad_sum"],
        seen=tensors["seen"],
        rng=rng,
        step=int(header["step"]),
        queue=[int(index) for index in header["queue"]],
        non_finite=int(header["non_finite"]),
    )

"""Adaptive density control: where Gaussians are added and removed (Kerbl et al. 2023, section 5.2).

The statistic is INRIA's: the norm of the loss gradient by the projected mean, in normalised device
coordinates (the gradient per pixel times half the image's width and height), averaged over the steps in which
the Gaussian was visible.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from langsplat_core.arrays import Array
from langsplat_core.config import RadianceConfig
from langsplat_core.training.radiance.state import PARAMETERS, TrainingState, rearrange

LARGE_SCALE = 0.1  # of the extent: Gaussians above are removed once the schedule says so
FEWEST_GAUSSIANS = 64  # pruning never leaves fewer; the most opaque ones stay


@dataclass(frozen=True)
class DensifyReport:
    """Result of one round, in Gaussians."""

    cloned: int
    split: int  # parents, each replaced by two children
    pruned: int


def accumulate(state: TrainingState, means_px_grad: Tensor, visible: Tensor, size: tuple[int, int]) -> None:
    """Add one step to the statistic.

    means_px_grad: (N, 2) loss gradient per pixel of mean position; visible: (N,) bool; size: (width, height)
    of the image.
    """
    to_ndc = means_px_grad.new_tensor([0.5 * size[0], 0.5 * size[1]])
    x, y = (torch.nan_to_num(means_px_grad, 0.0, 0.0, 0.0) * to_ndc).unbind(1)
    state.grad_sum += torch.hypot(x, y) * visible
    state.seen += visible


def densify(state: TrainingState, config: RadianceConfig, extent: float, prune_large: bool) -> DensifyReport:
    """Clone small and split large Gaussians with large gradients, and remove faint ones.

    `extent` is the cameras' extent in world units. When the cap of `config.max_gaussians` is near, the
    largest gradients go first.
    """
    values = {name: value.detach() for name, value in state.values.items()}
    opacity_logits, largest_scale = values["opacity_logits"], values["log_scales"].amax(1).exp()
    too_large = (largest_scale > LARGE_SCALE * extent) & prune_large
    remove = torch.sigmoid(opacity_logits) < config.prune_opacity
    gradient = torch.where(remove, -1.0, state.grad_sum / state.seen.clamp(min=1))
    grows = gradient >= config.densify_grad
    room = max(config.max_gaussians - int((~remove).sum()), 0)
    if int(grows.sum()) > room:
        largest = torch.argsort(gradient, descending=True, stable=True)[:room]
        grows = torch.zeros_like(grows).index_fill_(0, largest, True)
    splits = grows & (largest_scale > config.percent_dense * extent)
    clones = grows & ~splits

    children = _children(values, splits, state)
    if prune_large:
        small_enough = children["log_scales"].amax(1).exp() <= LARGE_SCALE * extent
        children = {name: child[small_enough] for name, child in children.items()}
    added = {name: torch.cat([values[name][clones & ~too_large], children[name]]) for name in PARAMETERS}
    remove |= too_large & ~splits
    keep = ~(remove | splits)
    if int(keep.sum()) + len(added["means"]) < FEWEST_GAUSSIANS:
        best = torch.argsort(opacity_logits, descending=True, stable=True)[:FEWEST_GAUSSIANS]
        keep.index_fill_(0, best, True)
    report = DensifyReport(int(clones.sum()), int(splits.sum()), int(remove.sum()))
    rearrange(state, keep.nonzero()[:, 0], added)
    return report


def _children(values: dict[str, Tensor], splits: Tensor, state: TrainingState) -> dict[str, Tensor]:
    """Two children per split Gaussian: means drawn from the parent itself, scales divided by 1.6."""
    parents = {name: value[splits].repeat_interleave(2, dim=0) for name, value in values.items()}
    draws = state.rng.standard_normal((len(parents["means"]), 3), dtype="float32")
    offsets = torch.from_numpy(draws).to(state.device) * parents["log_scales"].exp()
    # A quaternion (w, q) turns v into v + 2 w (q x v) + 2 q x (q x v).
    unit = torch.nn.functional.normalize(parents["quats_wxyz"], dim=1)
    w, q = unit[:, :1], unit[:, 1:]
    cross = torch.linalg.cross(q, offsets)
    parents["means"] = parents["means"] + (offsets + 2 * (w * cross + torch.linalg.cross(q, cross)))
    parents["log_scales"] = parents["log_scales"] - torch.log(offsets.new_tensor(1.6))
    return parents


def remove_gaussians(state: TrainingState, rows: Array) -> None:
    """Remove the Gaussians where the (N,) bool `rows` are True, unless hardly any would be left."""
    if len(state) - np.count_nonzero(rows) >= FEWEST_GAUSSIANS:
        rearrange(state, torch.from_numpy(np.flatnonzero(~rows)).to(state.device))


def reset_opacities(state: TrainingState) -> None:
    """Cap every opacity at 0.01 and forget its moments, so that floaters can be told from surfaces."""
    value = state.values["opacity_logits"].detach()
    cap = torch.logit(value.new_tensor(0.01))
    state.values["opacity_logits"] = torch.minimum(value, cap).requires_grad_()
    state.first["opacity_logits"].zero_()
    state.second["opacity_logits"].zero_()


def add_opacity_decay(state: TrainingState, strength: float) -> None:
    """Add the gradient of `strength` times the mean opacity, as Kheradmand et al. 2024."""
    logits = state.values["opacity_logits"]
    raw = logits.detach()
    slope = torch.sigmoid(raw) * torch.sigmoid(-raw) * (strength / max(len(state), 1))
    logits.grad = slope if logits.grad is None else logits.grad + slope

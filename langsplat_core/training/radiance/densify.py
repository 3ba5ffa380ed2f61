"""Adaptive density control: where Gaussians are added and removed (Kerbl et al. 2023, section 5.2).

The statistic is INRIA's: the norm of the loss gradient by the projected mean, in normalised device
coordinates (the gradient per pixel times half the picture's width and height), averaged over the steps
in which the Gaussian was visible.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from langsplat_core.config import RadianceConfig
from langsplat_core.training.radiance.state import PARAMETERS, TrainingState, rearrange

SPLIT_SHRINK = 1.6  # children of a split are smaller by this factor
SPLIT_CHILDREN = 2
RESET_OPACITY = 0.01
LARGE_SCALE = 0.1  # of the extent: Gaussians above are removed once the schedule says so
FEWEST_GAUSSIANS = 64  # pruning never leaves fewer; the most opaque ones stay


@dataclass(frozen=True)
class DensifyReport:
    """What one round did, in Gaussians."""

    cloned: int
    split: int  # parents, each replaced by two children
    pruned: int


def accumulate(state: TrainingState, means_px_grad: Tensor, visible: Tensor, size: tuple[int, int]) -> None:
    """Add one step to the statistic.

    `means_px_grad` (N, 2) is the loss gradient per pixel of mean position, `visible` (N,) bool, `size`
    the rendered (width, height).
    """
    to_ndc = means_px_grad.new_tensor([0.5 * size[0], 0.5 * size[1]])
    x, y = (torch.nan_to_num(means_px_grad, 0.0, 0.0, 0.0) * to_ndc).unbind(1)
    state.grad_sum += torch.hypot(x, y) * visible
    state.seen += visible


def densify(state: TrainingState, config: RadianceConfig, extent: float, prune_large: bool) -> DensifyReport:
    """One round: clone small and split large Gaussians with large gradients, remove faint ones.

    `extent` is the cameras' extent in world units. When the cap of `config.max_gaussians` is near, the
    largest gradients go first.
    """
    values = {name: value.detach() for name, value in state.values.items()}
    largest_scale = values["log_scales"].amax(1).exp()
    too_large = largest_scale > LARGE_SCALE * extent if prune_large else torch.zeros_like(largest_scale) > 0
    remove = torch.sigmoid(values["opacity_logits"]) < config.prune_opacity
    gradient = torch.where(remove, -1.0, state.grad_sum / state.seen.clamp(min=1))
    room = config.max_gaussians - int((~remove).sum())
    grows = _above(gradient, config.densify_grad, room)
    splits = grows & (largest_scale > config.percent_dense * extent)
    clones = grows & ~splits

    children = _children(values, splits, state)
    if prune_large:
        small_enough = children["log_scales"].amax(1).exp() <= LARGE_SCALE * extent
        children = {name: child[small_enough] for name, child in children.items()}
    added = {name: torch.cat([values[name][clones & ~too_large], children[name]]) for name in PARAMETERS}
    remove |= too_large & ~splits
    keep = _keep_some(~(remove | splits), values["opacity_logits"], len(added["means"]))
    report = DensifyReport(int(clones.sum()), int(splits.sum()), int(remove.sum()))
    rearrange(state, keep.nonzero()[:, 0], added)
    return report


def reset_opacities(state: TrainingState) -> None:
    """Cap every opacity at 0.01 and forget its moments, so that floaters can be told from surfaces."""
    value = state.values["opacity_logits"].detach()
    cap = torch.logit(value.new_tensor(RESET_OPACITY))
    state.values["opacity_logits"] = torch.minimum(value, cap).requires_grad_()
    state.first["opacity_logits"].zero_()
    state.second["opacity_logits"].zero_()


def _above(gradient: Tensor, threshold: float, room: int) -> Tensor:
    """(N,) True for the at most `room` rows with the largest gradient >= threshold."""
    chosen = gradient >= threshold
    if int(chosen.sum()) <= room:
        return chosen
    order = torch.argsort(gradient, descending=True, stable=True)[: max(room, 0)]
    return torch.zeros_like(chosen).index_fill_(0, order, True)


def _children(values: dict[str, Tensor], splits: Tensor, state: TrainingState) -> dict[str, Tensor]:
    """Two children per split Gaussian: means drawn from the parent itself, scales divided by 1.6."""
    parents = {name: value[splits].repeat_interleave(SPLIT_CHILDREN, dim=0) for name, value in values.items()}
    draws = state.rng.standard_normal((len(parents["means"]), 3), dtype="float32")
    offsets = torch.from_numpy(draws).to(state.device) * parents["log_scales"].exp()
    parents["means"] = parents["means"] + _rotate(parents["quats_wxyz"], offsets)
    parents["log_scales"] = parents["log_scales"] - torch.log(offsets.new_tensor(SPLIT_SHRINK))
    return parents


def _rotate(quats_wxyz: Tensor, vectors: Tensor) -> Tensor:
    """(N, 4) quaternions of any length turn (N, 3) vectors: v + 2 w (q x v) + 2 q x (q x v)."""
    unit = torch.nn.functional.normalize(quats_wxyz, dim=1)
    w, q = unit[:, :1], unit[:, 1:]
    cross = torch.linalg.cross(q, vectors)
    return vectors + 2 * (w * cross + torch.linalg.cross(q, cross))


def _keep_some(keep: Tensor, opacity_logits: Tensor, added: int) -> Tensor:
    """`keep`, widened to the most opaque rows when hardly any Gaussian would be left."""
    if int(keep.sum()) + added >= FEWEST_GAUSSIANS:
        return keep
    best = torch.argsort(opacity_logits, descending=True, stable=True)[:FEWEST_GAUSSIANS]
    return keep.clone().index_fill_(0, best, True)

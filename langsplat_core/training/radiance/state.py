"""What radiance training changes from step to step: parameters, Adam's moments, statistics.

All of it has one row per Gaussian, so that adding and removing Gaussians is one operation (`rearrange`)
that cannot leave the optimiser behind the parameters.
"""

from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor
from torch.optim.adam import adam

from langsplat_core.scene import Gaussians

PARAMETERS = ("means", "log_scales", "quats_wxyz", "opacity_logits", "sh_dc", "sh_rest")
ADAM_BETAS = (0.9, 0.999)
ADAM_EPSILON = 1e-15  # as INRIA: gradients of single Gaussians are tiny, 1e-8 would swallow them


@dataclass
class TrainingState:
    """N Gaussians in training. Every dictionary has the keys `PARAMETERS`."""

    values: dict[str, Tensor]  # raw parameters as in `Gaussians`; sh is split in degree 0 and the rest
    first: dict[str, Tensor]  # Adam's first moments, shaped like the values
    second: dict[str, Tensor]  # Adam's second moments
    updates: dict[str, int]  # how often Adam has updated each parameter
    grad_sum: Tensor  # (N,) norms of the gradients by the projected means, NDC, summed over `seen` views
    seen: Tensor  # (N,) float32: in how many steps since the last round the Gaussian was visible
    rng: np.random.Generator
    step: int = 0  # steps done
    queue: list[int] = field(default_factory=list)  # views still to come in this pass over the photographs
    non_finite: int = 0  # gradient entries that were not finite and were taken as zero

    def __len__(self) -> int:
        return len(self.values["means"])

    @property
    def device(self) -> torch.device:
        return self.values["means"].device

    def gaussians(self) -> Gaussians:
        """A copy as scene data."""
        v = {name: value.detach().cpu().numpy().copy() for name, value in self.values.items()}
        sh = np.concatenate([v["sh_dc"], v["sh_rest"]], axis=1)
        return Gaussians(v["means"], v["log_scales"], v["quats_wxyz"], v["opacity_logits"], sh)


def start(gaussians: Gaussians, seed: int, device: torch.device) -> TrainingState:
    """The state before the first step."""
    arrays = {
        "means": gaussians.means,
        "log_scales": gaussians.log_scales,
        "quats_wxyz": gaussians.quats_wxyz,
        "opacity_logits": gaussians.opacity_logits,
        "sh_dc": gaussians.sh[:, :1],
        "sh_rest": gaussians.sh[:, 1:],
    }
    values = {name: torch.tensor(array, device=device) for name, array in arrays.items()}
    count = len(gaussians)
    return TrainingState(
        values={name: value.requires_grad_() for name, value in values.items()},
        first={name: torch.zeros_like(value) for name, value in values.items()},
        second={name: torch.zeros_like(value) for name, value in values.items()},
        updates=dict.fromkeys(PARAMETERS, 0),
        grad_sum=torch.zeros(count, device=device),
        seen=torch.zeros(count, device=device),
        rng=np.random.default_rng(seed),
    )


def rearrange(state: TrainingState, keep: Tensor, added: dict[str, Tensor] | None = None) -> None:
    """Keep the Gaussians at the indices `keep` with their moments, then append `added` with zero ones.

    Statistics start afresh, because the rows they belong to have changed.
    """
    for name in PARAMETERS:
        old = state.values[name].detach()
        new = old.new_empty((0, *old.shape[1:])) if added is None else added[name]
        state.values[name] = torch.cat([old[keep], new]).requires_grad_()
        for moments in (state.first, state.second):
            moments[name] = torch.cat([moments[name][keep], torch.zeros_like(new)])
    state.grad_sum = torch.zeros(len(state), device=state.device)
    state.seen = torch.zeros(len(state), device=state.device)


def clean_gradients(state: TrainingState) -> None:
    """Zero and count gradient entries that are NaN or infinite: one bad pixel must not end a training."""
    for value in state.values.values():
        if value.grad is None or bool(torch.isfinite(value.grad.sum())):
            continue  # a finite sum has finite terms; an overflowing sum is looked at entry by entry
        bad = ~torch.isfinite(value.grad)
        state.non_finite += int(bad.sum())
        value.grad[bad] = 0


def add_opacity_decay(state: TrainingState, strength: float) -> None:
    """Add the gradient of `strength` times the mean opacity, as Kheradmand et al. 2024."""
    logits = state.values["opacity_logits"]
    raw = logits.detach()
    slope = torch.sigmoid(raw) * torch.sigmoid(-raw) * (strength / max(len(state), 1))
    logits.grad = slope if logits.grad is None else logits.grad + slope


def adam_step(state: TrainingState, learning_rates: dict[str, float]) -> None:
    """One Adam update (Kingma and Ba 2015) of every parameter that has a gradient; gradients are dropped.

    A parameter without gradient (harmonics of a degree not yet in use) is left alone entirely.
    """
    for name, value in state.values.items():
        if value.grad is None or value.numel() == 0:
            continue
        with torch.no_grad():
            adam(
                [value],
                [value.grad],
                [state.first[name]],
                [state.second[name]],
                [],
                [torch.tensor(float(state.updates[name]), device=state.device)],
                fused=True,
                amsgrad=False,
                beta1=ADAM_BETAS[0],
                beta2=ADAM_BETAS[1],
                lr=learning_rates[name],
                weight_decay=0.0,
                eps=ADAM_EPSILON,
                maximize=False,
            )
        state.updates[name] += 1
        value.grad = None

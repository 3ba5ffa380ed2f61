"""State of radiance training: first Gaussians, Adam's rows, density control, checkpoints."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from scipy.spatial import cKDTree
from torch import Tensor
from torch.optim.adam import adam

from langsplat_core.arrays import Array, logit
from langsplat_core.config import RadianceConfig
from langsplat_core.datasets.capture import TELLING_POINTS, Capture, random_points
from langsplat_core.errors import FormatError, InputError
from langsplat_core.io.files import atomic_path
from langsplat_core.scene import SH_COUNTS, Camera, Gaussians
from langsplat_core.scene.transform import C0
from langsplat_core.training.radiance.differentiable import PARAMETERS, parameters_of
from langsplat_core.training.radiance.losses import Transients, no_transients

# Fewer points are topped up to this number: features are found where there is detail, and the space between
# is covered better from random points than by splitting distant Gaussians (docs/photographs.md) ...
FEWEST_POINTS = 3_000
RANDOM_POINTS = 10_000  # ... or to this one, when they are too few to show where the scene is


def initial_gaussians(
    capture: Capture, train_indices: Sequence[int], sh_degree: int, max_gaussians: int, seed: int
) -> Gaussians:
    """Return isotropic Gaussians at the capture's points (Kerbl et al. 2023, section 5.1).

    Each is as large as the mean distance to three neighbours. Points that no training camera sees, repeated
    points and isolated outliers are left out. Too few are topped up with random ones that the cameras see.
    """
    rng = np.random.default_rng(seed)
    cameras = [capture.cameras[i] for i in train_indices]
    points, rgb = _usable_points(capture.points, capture.colours / 255.0, cameras)
    if len(points) > max_gaussians:
        chosen = np.sort(rng.choice(len(points), max_gaussians, replace=False))
        points, rgb = points[chosen], rgb[chosen]
    wanted = FEWEST_POINTS if len(points) >= TELLING_POINTS else RANDOM_POINTS
    missing = min(wanted, max_gaussians) - len(points)
    if missing > 0:
        more, colours = random_points(missing, points, capture, train_indices, rng)
        points, rgb = np.concatenate([points, more]), np.concatenate([rgb, colours / 255.0])

    count = len(points)
    sh = np.zeros((count, SH_COUNTS[sh_degree], 3), np.float32)
    sh[:, 0] = (rgb - 0.5) / C0
    return Gaussians(
        means=points,
        log_scales=np.repeat(np.log(_neighbour_distance(points))[:, None], 3, axis=1),
        quats_wxyz=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        opacity_logits=np.full(count, logit(np.array(0.1))),
        sh=sh,
    )


def _usable_points(points: Array, rgb: Array, cameras: Sequence[Camera]) -> tuple[Array, Array]:
    """Leave out points, with their colours, that are no good to start from; see `initial_gaussians`."""
    keep = np.flatnonzero(np.isfinite(points).all(1))
    keep = keep[np.sort(np.unique(points[keep], axis=0, return_index=True)[1])]
    keep = keep[np.any([camera.in_image(*camera.project(points[keep])) for camera in cameras], axis=0)]
    if len(keep) > 3:
        distance = _neighbour_distance(points[keep])
        keep = keep[distance <= 10 * np.median(distance)]
    return points[keep], rgb[keep]


def _neighbour_distance(points: Array) -> Array:
    """Return (N,) root mean square distance to the three nearest other points, world units, > 0."""
    if len(points) < 2:
        return np.ones(len(points))
    distances, _ = cKDTree(points).query(points, k=min(4, len(points)))
    mean = np.sqrt((distances[:, 1:] ** 2).mean(1))
    return np.maximum(mean, max(1e-3 * float(np.median(mean)), 1e-30))  # INRIA: 3e-4 in every unit


# Parameters, Adam's moments and statistics. All of it has one row per Gaussian, so that adding and removing
# Gaussians is one operation (`rearrange`) that cannot leave the optimiser behind the parameters.


@dataclass
class TrainingState:
    """N Gaussians in training. Every dictionary has the keys `PARAMETERS`."""

    values: dict[str, Tensor]  # raw parameters, see `parameters_of`
    first: dict[str, Tensor]  # Adam's first moments, shaped like the values
    second: dict[str, Tensor]  # Adam's second moments
    finished: dict[str, Tensor]  # values of the ensemble's members that are trained already
    grad_sum: Tensor  # (N,) norms of the gradients by the projected means, NDC, summed over `seen` views
    seen: Tensor  # (N,) float32 number of steps since the last densification that showed the Gaussian
    exposures: Tensor  # (V, 4, 3) affine changes of colours, of the training views, or none
    transients: Transients  # of the training views; of none when off
    rng: np.random.Generator
    updates: dict[str, int]  # how often Adam has updated each parameter
    step: int = 0  # steps done
    member: int = 0  # number of trainings before this one
    queue: list[int] = field(default_factory=list)  # views still to come in this pass over the photographs

    def __len__(self) -> int:
        return len(self.values["means"])

    @property
    def device(self) -> torch.device:
        return self.values["means"].device

    def gaussians(self) -> Gaussians:
        """Return a copy as scene data."""
        v = {name: value.detach().cpu().numpy().copy() for name, value in self.values.items()}
        sh = np.concatenate([v["sh_dc"], v["sh_rest"]], axis=1)
        return Gaussians(v["means"], v["log_scales"], v["quats_wxyz"], v["opacity_logits"], sh)


def start(gaussians: Gaussians, seed: int, device: torch.device) -> TrainingState:
    """Return the state before the first step."""
    values = parameters_of(gaussians, device)
    return TrainingState(
        values={name: value.requires_grad_() for name, value in values.items()},
        first={name: torch.zeros_like(value) for name, value in values.items()},
        second={name: torch.zeros_like(value) for name, value in values.items()},
        finished={name: torch.zeros_like(value[:0]) for name, value in values.items()},
        grad_sum=torch.zeros(len(gaussians), device=device),
        seen=torch.zeros(len(gaussians), device=device),
        exposures=torch.zeros((0, 4, 3), device=device),
        transients=no_transients(0),
        rng=np.random.default_rng(seed),
        updates=dict.fromkeys(PARAMETERS, 0),
    )


def members(state: TrainingState) -> dict[str, Tensor]:
    """Return the values of all members of an ensemble up to this one, one after the other."""
    return {name: torch.cat([state.finished[name], state.values[name].detach()]) for name in PARAMETERS}


def merged(state: TrainingState) -> Gaussians:
    """Return the Gaussians of all members, their opacities divided by the number of members."""
    values = members(state)
    values["opacity_logits"] = torch.logit(values["opacity_logits"].sigmoid() / (state.member + 1), 1e-6)
    return replace(state, values=values).gaussians()


def rearrange(state: TrainingState, keep: Tensor, added: dict[str, Tensor] | None = None) -> None:
    """Keep rows `keep` with their moments, append `added` with zero moments, and reset the statistics."""
    for name in PARAMETERS:
        old = state.values[name].detach()
        new = old.new_empty((0, *old.shape[1:])) if added is None else added[name]
        state.values[name] = torch.cat([old[keep], new]).requires_grad_()
        for moments in (state.first, state.second):
            moments[name] = torch.cat([moments[name][keep], torch.zeros_like(new)])
    state.grad_sum = torch.zeros(len(state), device=state.device)
    state.seen = torch.zeros(len(state), device=state.device)


def adam_step(state: TrainingState, learning_rates: dict[str, float]) -> None:
    """Update each parameter that has a gradient by Adam (Kingma and Ba 2015), and drop the gradients.

    Entries that are NaN or infinite count as zero: one bad pixel must not end a training.
    """
    for name, value in state.values.items():
        if value.grad is None or value.numel() == 0:
            continue
        value.grad.nan_to_num_(0.0, 0.0, 0.0)
        updates = torch.full((), float(state.updates[name]), device=state.device)  # not copied to a GPU
        with torch.no_grad():
            adam(
                *([value], [value.grad], [state.first[name]], [state.second[name]], [], [updates]),
                fused=True,
                amsgrad=False,
                beta1=0.9,
                beta2=0.999,
                lr=learning_rates[name],
                weight_decay=0.0,
                eps=1e-15,  # as INRIA: gradients of single Gaussians are tiny, 1e-8 would swallow them
                maximize=False,
            )
        state.updates[name] += 1
        value.grad = None


# Adaptive density control: where Gaussians are added and removed (Kerbl et al. 2023, section 5.2).
#
# The statistic is INRIA's: the norm of the loss gradient by the projected mean, in normalised device
# coordinates (the gradient per pixel times half the image's width and height), averaged over the steps in
# which the Gaussian was visible.

LARGE_SCALE = 0.1  # of the extent: Gaussians above are removed once the schedule says so
FEWEST_GAUSSIANS = 64  # pruning never leaves fewer; the most opaque ones stay


def accumulate(state: TrainingState, means_px_grad: Tensor, visible: Tensor, size: tuple[int, int]) -> None:
    """Add a step's statistics: (N, 2) gradients by means, 1/px, (N,) bool `visible`, image `size`, px."""
    to_ndc = means_px_grad.new_tensor([0.5 * size[0], 0.5 * size[1]])
    x, y = (torch.nan_to_num(means_px_grad, 0.0, 0.0, 0.0) * to_ndc).unbind(1)
    state.grad_sum += torch.hypot(x, y) * visible
    state.seen += visible


def densify(state: TrainingState, config: RadianceConfig, extent: float, prune_large: bool) -> None:
    """Clone small and split large Gaussians of large gradients, the largest first; remove faint ones."""
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
    keep = ~(remove | splits | too_large)
    if int(keep.sum()) + len(added["means"]) < FEWEST_GAUSSIANS:
        best = torch.argsort(opacity_logits, descending=True, stable=True)[:FEWEST_GAUSSIANS]
        keep.index_fill_(0, best, True)
    rearrange(state, keep.nonzero()[:, 0], added)


def _children(values: dict[str, Tensor], splits: Tensor, state: TrainingState) -> dict[str, Tensor]:
    """Return two children per split Gaussian: means drawn from the parent, scales divided by 1.6."""
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


# Checkpoints of radiance training: one safetensors file, written atomically, resumed exactly.
#
# Tensors: ``values.*``, ``first.*``, ``second.*`` and ``finished.*`` for every parameter, ``grad_sum``,
# ``seen``, ``exposures`` and ``watched.*``; everything else is JSON in the header. No pickle is involved, so
# a checkpoint from elsewhere cannot run code.

KIND = "langsplat-radiance-checkpoint-4"
ROWS, TENSORS = ("values", "first", "second", "finished"), ("grad_sum", "seen", "exposures")
WATCHED = tuple(Transients.__dataclass_fields__)


def fingerprint(capture: Capture, config: RadianceConfig, train_indices: Sequence[int]) -> str:
    """Return a digest of everything that decides the result of a training, photographs included.

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
    tensors = {name: getattr(state, name) for name in TENSORS}
    tensors |= {f"watched.{name}": torch.from_numpy(getattr(state.transients, name)) for name in WATCHED}
    tensors |= {f"{rows}.{name}": getattr(state, rows)[name].detach() for rows in ROWS for name in PARAMETERS}
    header = {name: getattr(state, name) for name in ("step", "member", "updates", "queue")}
    header |= {"fingerprint": made_from, "rng": state.rng.bit_generator.state}
    with atomic_path(path) as temporary:
        save_file(
            {name: tensor.contiguous().cpu() for name, tensor in tensors.items()},
            temporary,
            metadata={"kind": KIND, "state": json.dumps(header)},
        )


def load_checkpoint(path: Path, made_from: str, device: torch.device) -> TrainingState:
    """Read what `save_checkpoint` wrote; FormatError if it is none, InputError if of another run."""
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            # Copies, as files that are mapped into memory cannot be replaced on Windows.
            tensors = {name: file.get_tensor(name).to(device, copy=True) for name in file.keys()}  # noqa: SIM118
        if metadata.get("kind") != KIND:
            raise ValueError(f"kind {metadata.get('kind')!r}")
        header = json.loads(metadata["state"])
        if header["fingerprint"] != made_from:
            raise InputError(f"{path}: made with other photographs or settings; delete it, or pass those")
        rng = np.random.default_rng()
        rng.bit_generator.state = header["rng"]
        rows: Any = {part: {name: tensors[f"{part}.{name}"] for name in PARAMETERS} for part in ROWS}
        for value in rows["values"].values():
            value.requires_grad_()
        return TrainingState(
            **rows,
            **{name: tensors[name] for name in TENSORS},
            transients=Transients(*(tensors[f"watched.{name}"].cpu().numpy() for name in WATCHED)),
            member=int(header["member"]),
            rng=rng,
            updates={name: int(header["updates"][name]) for name in PARAMETERS},
            step=int(header["step"]),
            queue=[int(index) for index in header["queue"]],
        )
    except (SafetensorError, ValueError, KeyError, TypeError) as error:
        problem = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FormatError(f"{path}: not a usable checkpoint ({problem}); delete it to train afresh") from None

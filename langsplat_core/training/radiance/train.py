"""Radiance training: Gaussians fitted to photographs as in 3D Gaussian Splatting (Kerbl et al. 2023).

The schedule says when what happens and how fast parameters learn, for any number of steps. At the reference
budget this is exactly the INRIA schedule (Kerbl et al. 2023, arguments/__init__.py and train.py of the public
code). A smaller budget shortens every interval in proportion, but not below what it needs to make sense: a
gradient mean wants some views, a reset opacity wants time to recover. Steps count from 1.

Positions, scales and rotations then learn faster, by the square root of the missing factor: Adam moves a
parameter by about its rate per step, and 600 steps at rates meant for 30 000 leave Gaussians where they
began. Measured on 12 photographs at 320 px, 600 steps, held-out SSIM: 0.58 as published, 0.73 so.
"""

import logging
import math
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from langsplat_core.arrays import Array, ViewScore, psnr, sigmoid
from langsplat_core.config import INRIA, RadianceConfig, check_settings
from langsplat_core.datasets.capture import Capture, shrunk_view
from langsplat_core.errors import InputError
from langsplat_core.progress import Cancelled, Progress, Terminated, silent
from langsplat_core.scene import Camera, Gaussians
from langsplat_core.training.radiance.differentiable import Backend, DifferentiableRenderer, renderer_for
from langsplat_core.training.radiance.losses import fit_exposure, radiance_loss, ssim, with_exposure
from langsplat_core.training.radiance.state import (
    TrainingState,
    accumulate,
    adam_step,
    add_opacity_decay,
    clean_gradients,
    densify,
    fingerprint,
    initial_gaussians,
    load_checkpoint,
    no_exposures,
    remove,
    reset_opacities,
    save_checkpoint,
    start,
)
from langsplat_core.training.radiance.stereo import DepthMap, find_depths, in_free_space
from langsplat_core.training.radiance.transients import (
    EXPLAINS,
    FROM,
    drawn_depths,
    look,
    nothing_watched,
    patches,
    pixels_of,
)

log = logging.getLogger("langsplat")

FEWEST_DENSIFY_FROM = 150  # steps before positions and opacities say anything ...
DENSIFY_FROM_SHARE = 4  # ... but at most this part (a quarter) of the run
FEWEST_DENSIFY_EVERY = (20, 50)  # steps between two rounds, so that their gradients are means ...
DENSIFY_EVERY_SHARE = 24  # ... within these bounds this part of the run, so that there are some rounds
FEWEST_RESET_EVERY = 600  # steps an opacity needs to come back from 0.01
FEWEST_SH_EVERY = 100  # steps per degree of the spherical harmonics
BOOST_POWER = 0.5
FEATURE_REST_DIVISOR = 20  # higher harmonics learn this much more slowly than the base colour


@dataclass(frozen=True)
class Schedule:
    """Step numbers and rates of one training run; `steps` is its length."""

    steps: int
    densify_from: int  # densification rounds come after this step ...
    densify_until: int  # ... and before this one
    densify_every: int
    reset_every: int  # opacity resets, before `densify_until` only; 0: none
    sh_degree: int
    sh_degree_every: int
    coarse_until: int  # up to this step images have half their size
    position_lr: tuple[float, float]  # first and last, world units per step
    rates: dict[str, float]  # of all other parameters, by their names in `state`

    def densifies(self, step: int) -> bool:
        """True where a round of densification and pruning ends the step."""
        return self.densify_from < step < self.densify_until and step % self.densify_every == 0

    def clears(self, step: int) -> bool:
        """True where Gaussians that stand before known surfaces are removed after the step."""
        return self.densify_from < step <= CLEARED_UNTIL * self.steps and step % self.densify_every == 0

    def prunes_large(self, step: int) -> bool:
        """True where a round also removes Gaussians larger than a tenth of the extent."""
        return 0 < self.reset_every < step

    def resets_opacity(self, step: int) -> bool:
        """True where opacities are capped at 0.01 after the step."""
        return self.reset_every > 0 and step < self.densify_until and step % self.reset_every == 0

    def active_sh_degree(self, step: int) -> int:
        """Degree of the spherical harmonics used and trained in the step."""
        return min(self.sh_degree, step // self.sh_degree_every)

    def learning_rates(self, step: int) -> dict[str, float]:
        """Adam's rate for every parameter; that of positions decays log-linearly over the run."""
        t = min(step / self.steps, 1.0)
        first, last = (math.log(rate) for rate in self.position_lr)
        return {"means": math.exp((1 - t) * first + t * last), **self.rates}


def schedule_for(config: RadianceConfig, extent: float) -> Schedule:
    """The schedule of a run in a scene whose cameras have an `extent` of so many world units."""
    ratio = config.steps / config.reference_steps
    boost = max(1 / ratio, 1.0) ** BOOST_POWER

    def scaled(reference: int, fewest: int = 1) -> int:
        return max(round(reference * ratio), min(fewest, reference), 1)

    least, most = FEWEST_DENSIFY_EVERY
    fewest_every = max(least, min(most, config.steps // DENSIFY_EVERY_SHARE))
    return Schedule(
        steps=config.steps,
        densify_from=scaled(
            config.densify_from, min(FEWEST_DENSIFY_FROM, config.steps // DENSIFY_FROM_SHARE)
        ),
        densify_until=scaled(config.densify_until),
        densify_every=scaled(config.densify_every, fewest_every),
        reset_every=config.opacity_reset_every and scaled(config.opacity_reset_every, FEWEST_RESET_EVERY),
        sh_degree=config.sh_degree,
        sh_degree_every=scaled(config.sh_degree_every, FEWEST_SH_EVERY),
        coarse_until=round(config.coarse_fraction * config.steps),
        position_lr=(
            config.position_lr_init * extent * boost,
            config.position_lr_final * extent * boost,
        ),
        rates={
            "log_scales": config.scale_lr * boost,
            "quats_wxyz": config.rotation_lr * boost,
            "opacity_logits": config.opacity_lr,
            "sh_dc": config.feature_lr,
            "sh_rest": config.feature_lr / FEATURE_REST_DIVISOR,
        },
    )


# One step draws one photograph's view, compares, and moves every parameter by Adam; densification,
# pruning and opacity resets follow the `Schedule`. On the CPU a run is deterministic given its seed and
# resumes from a checkpoint exactly where it stopped.

STAGE = "training Gaussians"
LOSSES_SAID = 200  # mean losses reported in a run
COARSE_MIN_SIDE = 64  # px: smaller images are never halved
DENSE_POINTS = 20_000  # of depths at most, that Gaussians begin at: the rest is for splitting
FEW_VIEWS_OPACITY_DECAY = 0.01
CLEARED_UNTIL = 0.9  # of the steps: the last ones mend what a removal leaves
EXPOSING = (1 / 3, 2 / 3)  # of the steps, after which exposures of photographs are found
EVERY = 7  # pixels, of which one tells the exposure
LEAST_EXPOSURE_GAIN = 0.35  # dB over all training views that exposures of their own must explain
SMALLEST_EXTENT = 0.05  # of the distance to the scene: one camera, or cameras in one place, have no extent


class _Pictures:
    """Photographs and cameras of the training views, whole and at half size. On a GPU they are copied to it;
    else they stay as they are, which for many is in files (`capture.Album`)."""

    def __init__(self, capture: Capture, indices: Sequence[int], device: torch.device) -> None:
        def kept(image: Array) -> Array | Tensor:
            return image if device.type == "cpu" else torch.tensor(image, device=device)

        self.cameras = [capture.cameras[i] for i in indices]
        views = [(capture.cameras[i], capture.images[i], capture.mask(i)) for i in indices]
        self._fine, self._coarse = (
            [(camera, kept(image), None if mask is None else kept(mask)) for camera, image, mask in sizes]
            for sizes in (views, [_halved(*view) for view in views])
        )

    def __len__(self) -> int:
        return len(self._fine)

    def at(self, index: int, coarse: bool) -> tuple[Camera, Tensor, Tensor | None]:
        """The camera, its (H, W, 3) float image in [0, 1], and the (H, W) bool mask of pixels that count."""
        camera, picture, mask = (self._coarse if coarse else self._fine)[index]
        copy = picture if isinstance(picture, Tensor) else torch.tensor(picture)
        return camera, copy.float().div_(255), None if mask is None else torch.as_tensor(mask)


def _halved(camera: Camera, image: Array, mask: Array | None) -> tuple[Camera, Array, Array | None]:
    """The view at half its size; a small one as it is."""
    if min(camera.width, camera.height) < COARSE_MIN_SIDE:
        return camera, image, mask
    return shrunk_view(camera, image, mask, (camera.width // 2, camera.height // 2))


@dataclass(frozen=True)
class _Run:
    """Constants of a run."""

    config: RadianceConfig
    schedule: Schedule
    pictures: _Pictures
    renderer: DifferentiableRenderer
    extent: float  # world units
    depths: Sequence[DepthMap]  # of surfaces that Gaussians do not stay before; none for many views
    exposing: frozenset[int]  # steps before which exposures are found


class _Losses:
    """The mean loss over a share of the steps, since every photograph has another."""

    def __init__(self, steps: int) -> None:
        self._steps = steps
        self._latest: list[float] = []  # of the share under way
        self.mean: float | None = None

    def add(self, step: int, loss: float) -> None:
        """Add the loss of one step, counted from 1."""
        self._latest.append(loss)
        if step * LOSSES_SAID // self._steps > (step - 1) * LOSSES_SAID // self._steps:
            self.mean = float(np.mean(self._latest))
            self._latest = []


def train_radiance(
    capture: Capture,
    config: RadianceConfig,
    train_indices: Sequence[int],
    checkpoint: Path | None = None,
    progress: Progress = silent,
) -> Gaussians:
    """Fit Gaussians to the photographs at `train_indices`; returns those that can be seen.

    With a `checkpoint` path the run continues from that file if it exists, and writes it every
    `config.checkpoint_every` steps, at the end, and when it is interrupted (Ctrl-C, or `Cancelled` from
    `progress`). Raises InputError when a setting is out of its range, there is nothing to train
    on or the checkpoint belongs to another run, BackendError when the chosen backend does not work.
    """
    check_settings(config, "--radiance.")
    if not train_indices:
        raise InputError("no photographs to train on; give a capture with at least one training view")
    renderer = renderer_for(config.backend)
    made_from = fingerprint(capture, config, train_indices) if checkpoint else ""
    depths: list[DepthMap] = []
    if len(train_indices) <= config.few_views:
        config = for_few_views(config)
        depths = find_depths(capture, train_indices, progress)
        capture = _with_points(capture, depths, config)
    seed = initial_gaussians(capture, train_indices, config.sh_degree, config.max_gaussians, config.seed)
    extent = _extent(capture, seed)
    pictures = _Pictures(capture, train_indices, renderer.device)
    exposing = [] if config.exposure == "off" else [1 + round(share * config.steps) for share in EXPOSING]
    run = _Run(config, schedule_for(config, extent), pictures, renderer, extent, depths, frozenset(exposing))
    if checkpoint and checkpoint.exists():
        state = load_checkpoint(checkpoint, made_from, renderer.device)
    else:
        state = start(seed, config.seed, renderer.device)
        state.exposures = no_exposures(len(pictures), renderer.device)
        state.watched = nothing_watched(0 if config.transients == "off" else len(pictures))

    def save() -> None:
        if checkpoint:
            save_checkpoint(checkpoint, state, made_from)

    losses = _Losses(config.steps)
    with _one_torch_thread(), _interrupts_between_steps() as raise_if_interrupted:
        try:
            while state.step < config.steps:
                loss = _step(run, state)
                losses.add(state.step, loss)
                metrics = {} if losses.mean is None else {"loss": losses.mean}
                progress(STAGE, state.step / config.steps, f"{len(state)} Gaussians", **metrics)
                raise_if_interrupted()
                if state.step % config.checkpoint_every == 0 or state.step == config.steps:
                    save()
        except (KeyboardInterrupt, Cancelled):
            save()
            raise
    return _visible(state.gaussians())


def _exposures(run: _Run, state: TrainingState) -> Tensor:
    """(V, 4, 3) exposures of the training views against what they have in common, which is none. All are none
    where they explain less than `LEAST_EXPOSURE_GAIN`."""
    pairs: list[tuple[Tensor, Tensor]] = []
    with torch.no_grad():
        for index in range(len(run.pictures)):
            camera, target, mask = run.pictures.at(index, coarse=True)
            mask = _still(run, state, index, target, mask)
            image = run.renderer.render(state.values, camera, run.schedule.active_sh_degree(state.step)).image
            seen = (slice(None), slice(None)) if mask is None else mask
            pairs.append((image[seen].reshape(-1, 3)[::EVERY], target[seen].reshape(-1, 3)[::EVERY]))
    common = fit_exposure(pairs)
    pairs = [(with_exposure(image, common), target) for image, target in pairs if len(image)]
    found = torch.stack([fit_exposure([pair]) for pair in pairs])
    apart = sum(float((image - target).square().sum()) for image, target in pairs)
    left = sum(
        float((with_exposure(image, change) - target).square().sum())
        for (image, target), change in zip(pairs, found, strict=True)
    )
    gain = 10 * math.log10(max(apart, 1e-12) / max(left, 1e-12))
    log.debug("exposures of the photographs explain %.2f dB", gain)
    explains = len(pairs) == len(run.pictures) and gain >= LEAST_EXPOSURE_GAIN
    return found if explains or run.config.exposure == "on" else no_exposures(len(run.pictures), found.device)


def _judged(config: RadianceConfig) -> int:
    """The steps after which what moves no longer counts, if it is to be left out."""
    return max(round(FROM * config.steps), 1)


def _counted(
    run: _Run, state: TrainingState, index: int, image: Tensor, target: Tensor, mask: Tensor | None
) -> Tensor | None:
    """The (H, W) pixels of view `index` that count in this step, which draws `image`."""
    judged = state.step == _judged(run.config) and run.config.transients == "auto"
    if judged and state.watched.explained() < EXPLAINS:
        state.watched = nothing_watched(0)
    if not len(state.watched.moving):
        return mask
    drawn = patches(image)
    if mask is not None:
        drawn[patches(mask[..., None].float())[..., 0] < 0.5] = np.nan
    cameras = run.pictures.cameras
    depths = drawn_depths(run.renderer, state.values, cameras[index])
    look(state.watched, index, cameras, drawn, patches(target), depths)
    return _still(run, state, index, target, mask)


def _still(run: _Run, state: TrainingState, index: int, target: Tensor, mask: Tensor | None) -> Tensor | None:
    """The mask of view `index`, (H, W) bool as the (H, W, 3) `target`, without what moves."""
    moving = state.watched.moving
    if not len(moving) or state.step < _judged(run.config) or not moving[index].any():
        return mask
    still = ~pixels_of(moving[index], (target.shape[0], target.shape[1]), target.device)
    return still if mask is None else mask & still


def for_few_views(config: RadianceConfig) -> RadianceConfig:
    """Return `config` without resets of opacities, after which few photographs let what stands close before
    each camera come back first. Their decay takes what no photograph needs."""
    return replace(
        config, opacity_reset_every=0, opacity_decay=max(config.opacity_decay, FEW_VIEWS_OPACITY_DECAY)
    )


def _with_points(capture: Capture, depths: Sequence[DepthMap], config: RadianceConfig) -> Capture:
    """The capture with points of the depths beside its own, as many as leave room for splitting."""
    found = [(np.zeros((0, 3)), np.zeros((0, 3), np.uint8)), *(one.points() for one in depths)]
    points, colours = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    wanted = min(DENSE_POINTS, config.max_gaussians // 3)
    chosen = np.random.default_rng(config.seed).permutation(len(points))[:wanted]
    return replace(
        capture,
        points=np.concatenate([capture.points, points[chosen]]),
        colours=np.concatenate([capture.colours, colours[chosen]]),
    )


def evaluate_views(
    gaussians: Gaussians,
    capture: Capture,
    indices: Sequence[int],
    backend: Backend = "auto",
    small: Capture | None = None,
) -> list[ViewScore]:
    """Draw the views at `indices` and score them against the photographs; colours are clamped to [0, 1].

    `small`: the same views read at 320 px, which images are compared with too, shrunk; a photograph that is
    shrunk twice differs from one that was read at that size, by as much as good images do.
    """
    renderer = renderer_for(backend)
    state = start(gaussians, 0, renderer.device)
    pictures = _Pictures(capture, indices, renderer.device)
    scores = []
    with torch.no_grad():
        for index in range(len(pictures)):
            camera, target, mask = pictures.at(index, coarse=False)
            drawn = renderer.render(state.values, camera, gaussians.sh_degree)
            image, covered = drawn.image.clamp(0, 1), drawn.alpha >= 0.5
            if mask is not None:
                target, covered = torch.where(mask[..., None], target, image), covered[mask]
            counted = slice(None) if mask is None else mask
            decibels = psnr(image[counted].cpu().numpy(), target[counted].cpu().numpy())
            share = 1.0 if mask is None else float(mask.float().mean())
            similarity = 1 - (1 - float(ssim(image, target))) / max(share, 1e-9)
            whole = decibels, similarity, float(covered.float().mean())
            exposed = _psnr_exposed(image, target, mask)
            compared = (
                None if small is None else _psnr_small(camera, image, small.images[index], small.mask(index))
            )
            scores.append(ViewScore(camera.name, *whole, exposed, compared))
    return scores


def _psnr_small(camera: Camera, image: Tensor, photograph: Array, mask: Array | None) -> float | None:
    """PSNR of an image shrunk to the size of a photograph; None where nothing of that counts."""
    colours = (255 * image).round().byte().cpu().numpy()
    _, drawn, _ = shrunk_view(camera, colours, None, (photograph.shape[1], photograph.shape[0]))
    counted = np.ones(drawn.shape[:2], bool) if mask is None else mask
    return psnr(drawn[counted] / 255, photograph[counted] / 255) if counted.any() else None


def _psnr_exposed(image: Tensor, target: Tensor, mask: Tensor | None) -> float | None:
    """PSNR of an image whose halves, left and right, each have the exposure that fits the other best; None
    where a half has no pixel that counts."""
    counted = image.new_ones(image.shape[:2], dtype=torch.bool) if mask is None else mask
    left = torch.zeros_like(counted)
    left[:, : image.shape[1] // 2] = True
    halves = counted & left, counted & ~left
    if not all(bool(half.any()) for half in halves):
        return None
    drawn = torch.cat(
        [
            with_exposure(image[one], fit_exposure([(image[other], target[other])])).clamp(0, 1)
            for one, other in (halves, halves[::-1])
        ]
    )
    return psnr(drawn.cpu().numpy(), torch.cat([target[half] for half in halves]).cpu().numpy())


def _extent(capture: Capture, gaussians: Gaussians) -> float:
    """The cameras' extent, or a twentieth of their distance to the Gaussians when that is larger."""
    centre = np.mean([camera.position for camera in capture.cameras], axis=0)
    distance = float(np.median(np.linalg.norm(gaussians.means - centre, axis=1)))
    return max(capture.extent(), SMALLEST_EXTENT * distance)


def _step(run: _Run, state: TrainingState) -> float:
    """One photograph, one update; returns the loss before it."""
    schedule, step = run.schedule, state.step + 1
    if not state.queue:
        state.queue = [int(index) for index in state.rng.permutation(len(run.pictures))]
    if step in run.exposing:
        state.exposures = _exposures(run, state)
    index = state.queue.pop()
    camera, target, mask = run.pictures.at(index, coarse=step <= schedule.coarse_until)
    rendered = run.renderer.render(state.values, camera, schedule.active_sh_degree(step))
    image = rendered.image
    if min(run.exposing, default=step + 1) <= step:
        image = with_exposure(image, state.exposures[index])
    mask = _counted(run, state, index, image, target, mask)
    if mask is not None:  # what is masked differs from nothing, and nothing flows back from it
        image = torch.where(mask[..., None], image, image.detach())
        target = torch.where(mask[..., None], target, image.detach())
    loss = radiance_loss(image, target, run.config.lambda_dssim)
    loss.backward()
    if run.config.opacity_decay > 0:
        add_opacity_decay(state, run.config.opacity_decay)
    clean_gradients(state)
    if step < schedule.densify_until:
        accumulate(state, rendered.means_px_grad(), rendered.visible, (camera.width, camera.height))
    adam_step(state, schedule.learning_rates(step))
    if schedule.densifies(step):
        densify(state, run.config, run.extent, prune_large=schedule.prunes_large(step))
    if run.depths and schedule.clears(step):
        remove(state, in_free_space(state.values["means"].detach().cpu().numpy(), run.depths))
    if schedule.resets_opacity(step):
        reset_opacities(state)
    state.step = step
    return float(loss.detach())


def _visible(gaussians: Gaussians) -> Gaussians:
    """Without the rows that no image can show: invalid ones and those that never reach alpha 1/255."""
    return gaussians.take(gaussians.valid() & (sigmoid(gaussians.opacity_logits) >= INRIA.alpha_min))


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Torch's own threads wait by spinning and so take the cores from the rasterizer's; what torch does on
    the CPU here (loss, Adam) is small. With two cores this is a third faster, on a busy machine far more.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def _interrupts_between_steps() -> Iterator[Callable[[], None]]:
    """Hold Ctrl-C and SIGTERM back while a step runs, because half a step is no state to resume from.

    Yields a function that raises the KeyboardInterrupt or Terminated that came meanwhile. Other threads than
    the main one never receive them and need no care. SIGTERM is left to whoever wants it otherwise: it is
    held back only where it would raise.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: None
        return
    pending: list[int] = []
    held = [signal.SIGINT, *([signal.SIGTERM] if callable(signal.getsignal(signal.SIGTERM)) else [])]
    previous = {number: signal.getsignal(number) for number in held}
    for number in held:
        signal.signal(number, lambda number, _: pending.append(number))

    def raise_if_interrupted() -> None:
        if pending:
            raise Terminated if signal.SIGTERM in pending else KeyboardInterrupt

    try:
        yield raise_if_interrupted
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler if handler is not None else signal.SIG_DFL)

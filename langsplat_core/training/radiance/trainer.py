"""Radiance training: Gaussians fitted to photographs as in 3D Gaussian Splatting (Kerbl et al. 2023).

One step renders a photograph's view, compares, and moves every parameter by Adam; density control and opacity
resets follow the `Schedule`. On the CPU its seed determines a run, also a resumed one.
"""

import math
import signal
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from langsplat_core.arrays import Array, sigmoid
from langsplat_core.config import GOOD, INRIA, QUICK, RadianceConfig, check_settings
from langsplat_core.datasets.capture import Capture, shrunk_view
from langsplat_core.errors import InputError
from langsplat_core.interrupts import Terminated, handled
from langsplat_core.progress import Progress, WorkCancelledError, silent
from langsplat_core.scene import Camera, Gaussians, near_plane
from langsplat_core.training import one_torch_thread
from langsplat_core.training.radiance import differentiable, losses
from langsplat_core.training.radiance import state as training
from langsplat_core.training.radiance.state import TrainingState
from langsplat_core.training.radiance.stereo import DepthMap, find_depths, in_free_space

STAGE = "training Gaussians"
JUDGED = 3  # held-out views that are drawn while a training runs
COOLING, COOLEST = 0.3, 0.05  # last share of a short run in which rates fall, and the factor they fall to
FADING = 0.01  # least weight of the mean opacity in the loss with few views
GAIN = 0.35  # dB that exposures gain on the training views, at least, to be used
EXPOSED = 7  # one pixel in so many is enough for an exposure
LOOKS = 64  # passes over the photographs, at most, in which a run looks for transients
EXPLAINED = 0.24  # least share of the squared error that lies in transients, to leave them out
STEREO_POINTS = 20_000  # of depth maps, at most, where Gaussians begin


@dataclass(frozen=True)
class Schedule:
    """Step numbers and rates of one training run of any length; steps count from 1.

    At the reference budget this is the INRIA schedule (arguments/__init__.py and train.py of the public
    code). A smaller budget shortens every interval in proportion, but not below what it needs to make sense.
    Positions, scales and rotations then learn faster, by the square root of the missing factor: else 600
    steps leave Gaussians where they began (held-out SSIM of 12 photographs at 320 px: 0.58, 0.73 so).
    """

    steps: int  # in all
    joint_from: int  # after this step free space is not cleared, and an ensemble's members train together
    densify_from: int  # densification rounds come after this step ...
    densify_until: int  # ... and before this one
    densify_every: int
    reset_every: int  # opacity resets, before `densify_until` only; 0: none
    transients_from: int  # from this step on transients do not count: a fifth of the run has to find them
    sh_degree: int
    sh_degree_every: int
    coarse_until: int  # up to this step images have half their size
    position_lr: tuple[float, float]  # first and last, world units per step
    cools: bool  # all rates fall at the end: else the last photographs move held-out views by 0.3 dB
    rates: dict[str, float]  # of all other parameters, by their names in `state`

    def densifies(self, step: int) -> bool:
        """Return True where a round of densification and pruning ends the step."""
        return self.densify_from < step < self.densify_until and step % self.densify_every == 0

    def work(self, step: int) -> float:
        """Return the share of the work up to a step; a step on a whole image counts as two on a half."""
        done, whole = (count + max(count - self.coarse_until, 0) for count in (step, self.steps))
        return done / whole

    def resets_opacity(self, step: int) -> bool:
        """Return True where opacities are capped at 0.01 after the step."""
        return self.reset_every > 0 and step < self.densify_until and step % self.reset_every == 0

    def finds_exposures(self, step: int) -> bool:
        """Return True where exposures are found before the step: after a third of the run and after two."""
        return step in (1 + round(self.steps / 3), 1 + round(2 * self.steps / 3))

    def active_sh_degree(self, step: int) -> int:
        """Return the degree of the spherical harmonics used and trained in the step."""
        return min(self.sh_degree, step // self.sh_degree_every)

    def learning_rates(self, step: int) -> dict[str, float]:
        """Return Adam's rate for every parameter; that of positions decays log-linearly over the run."""
        t = min(step / self.steps, 1.0)
        first, last = (math.log(rate) for rate in self.position_lr)
        cool = min(max((1 - t) / COOLING, COOLEST), 1.0) if self.cools else 1.0
        rates = {"means": math.exp((1 - t) * first + t * last), **self.rates}
        return {name: cool * rate for name, rate in rates.items()}


def schedule_for(config: RadianceConfig, extent: float) -> Schedule:
    """Return the schedule of a run in a scene whose cameras have an `extent` of so many world units."""
    steps, ratio = config.steps, config.steps / config.reference_steps
    boost = max(1 / ratio, 1.0) ** 0.5

    def scaled(reference: int, fewest: int = 1) -> int:
        return max(round(reference * ratio), min(fewest, reference), 1)

    return Schedule(
        steps=steps,
        joint_from=int(0.9 * steps),
        # Positions and opacities say nothing before, but a short run spends no more than a quarter on that.
        densify_from=scaled(config.densify_from, min(150, steps // 4)),
        densify_until=scaled(config.densify_until),
        # Enough steps that gradients are means, and few enough that there are some rounds.
        densify_every=scaled(config.densify_every, max(20, min(50, steps // 24))),
        # An opacity needs 600 steps to come back from 0.01.
        reset_every=config.opacity_reset_every and scaled(config.opacity_reset_every, 600),
        transients_from=max(round(steps / 5), 1),
        sh_degree=config.sh_degree,
        sh_degree_every=scaled(config.sh_degree_every, 100),
        coarse_until=round(config.coarse_fraction * steps),
        position_lr=(
            config.position_lr_init * extent * boost,
            config.position_lr_final * extent * boost,
        ),
        cools=ratio < 1,
        rates={
            "log_scales": config.scale_lr * boost,
            "quats_wxyz": config.rotation_lr * boost,
            "opacity_logits": config.opacity_lr,
            "sh_dc": config.feature_lr,
            "sh_rest": config.feature_lr / 20,
        },
    )


def train_radiance(
    capture: Capture,
    config: RadianceConfig,
    train_indices: Sequence[int],
    checkpoint: Path | None = None,
    progress: Progress = silent,
    held_out: Sequence[int] = (),
) -> Gaussians:
    """Fit Gaussians to the photographs at `train_indices`; return the visible ones.

    `progress` gets the mean PSNR of up to `JUDGED` views at `held_out`. With a `checkpoint` path the run
    continues from that file if it exists, and writes it every `config.checkpoint_every` steps, at the end,
    and when it is interrupted (Ctrl-C, or an error of `progress`). InputError for a setting out of its range,
    nothing to train on or a checkpoint of another run, BackendError for a backend that does not work.
    """
    check_settings(config, "--radiance.")
    if not train_indices:
        raise InputError("no photographs to train on; give a capture with at least one training view")
    made_from = training.fingerprint(capture, config, train_indices) if checkpoint else ""
    depths: list[DepthMap] = []
    if len(train_indices) <= config.few_views:
        # After a reset, Gaussians close before each of few cameras come back first. A decay of opacities
        # removes what no photograph needs instead.
        config = replace(config, opacity_reset_every=0, opacity_decay=max(config.opacity_decay, FADING))
        depths = find_depths(capture, train_indices, progress)
    members = max(config.ensemble, 1)
    config = replace(config, max_gaussians=max(config.max_gaussians // members, 1))
    first = _first_gaussians(capture, train_indices, depths, config)
    centre = np.mean([camera.position for camera in capture.cameras], axis=0)
    distance = float(np.median(np.linalg.norm(first.means - centre, axis=1)))
    extent = max(capture.extent(), 0.05 * distance)  # cameras may stand in one place
    near = near_plane(first, capture.cameras)
    renderer = differentiable.renderer_for(config.backend, config.formation(near))
    views = _Views(capture, train_indices, renderer.device)
    judged = held_out[:: -(-len(held_out) // JUDGED) or 1]
    run = _Run(config, schedule_for(config, extent), views, judged, renderer, extent, depths, members)
    if checkpoint and checkpoint.exists():
        state = training.load_checkpoint(checkpoint, made_from, renderer.device)
    else:
        state = training.start(first, config.seed, renderer.device)
        state.transients = losses.no_transients(0 if config.transients == "off" else len(views))

    recent: list[float] = []  # losses since the last mean
    metrics: dict[str, float] = {}
    signals: list[int] = []  # held back while a step runs: half a step is no state to resume from
    with one_torch_thread(), handled(lambda number, _: signals.append(number)):
        try:
            while not run.is_finished(state):
                state = run.current(state, capture, train_indices)
                recent.append(run.step(state))
                # Photographs differ in their loss: progress gets the mean over each 200th of the run.
                if state.step * 200 // config.steps > (state.step - 1) * 200 // config.steps:
                    metrics, recent = metrics | {"loss": float(np.mean(recent))}, []
                metrics = metrics | run.held_out(state, capture)
                progress(STAGE, run.work(state), f"{len(state)} Gaussians", **metrics)
                if signals:
                    raise Terminated if signal.SIGTERM in signals else KeyboardInterrupt
                if checkpoint and (state.step % config.checkpoint_every == 0 or state.step == config.steps):
                    training.save_checkpoint(checkpoint, state, made_from)
        except (KeyboardInterrupt, WorkCancelledError):
            if checkpoint:
                training.save_checkpoint(checkpoint, state, made_from)
            raise
    gaussians = state.gaussians()  # without those that no image can show
    return gaussians.take(gaussians.valid() & (sigmoid(gaussians.opacity_logits) >= INRIA.alpha_min))


class _Views:
    """Photographs and cameras of training views, whole and halved; on a GPU, copied to its memory.

    Halved images are drawn with the whole ones' focal lengths, so that both fit the same Gaussians.
    """

    def __init__(self, capture: Capture, indices: Sequence[int], device: torch.device) -> None:
        def kept(image: Array | None) -> Array | Tensor | None:
            return image if image is None or device.type == "cpu" else torch.tensor(image, device=device)

        self.cut_out = capture.cut_out
        self.cameras = [capture.cameras[i] for i in indices]
        self.focals = [float(np.sqrt(camera.fx * camera.fy)) for camera in self.cameras]
        views = [(capture.cameras[i], capture.images[i], capture.mask(i)) for i in indices]
        halved = [_halved(*view) for view in views]
        self._fine = [(camera, kept(image), kept(mask)) for camera, image, mask in views]
        self._coarse = [(camera, kept(image), kept(mask)) for camera, image, mask in halved]

    def __len__(self) -> int:
        return len(self._fine)

    def at(self, index: int, coarse: bool) -> tuple[Camera, Tensor, Tensor | None]:
        """Return the camera, its (H, W, 3) float image in [0, 1], and the (H, W) bool mask of what counts."""
        camera, photograph, mask = (self._coarse if coarse else self._fine)[index]
        copy = photograph if isinstance(photograph, Tensor) else torch.tensor(photograph)
        return camera, copy.float().div_(255), None if mask is None else torch.as_tensor(mask)


def _halved(camera: Camera, image: Array, mask: Array | None) -> tuple[Camera, Array, Array | None]:
    if min(camera.width, camera.height) < 64:
        return camera, image, mask
    return shrunk_view(camera, image, mask, (camera.width // 2, camera.height // 2))


@dataclass(frozen=True)
class _Run:
    """Data that stay the same over all steps."""

    config: RadianceConfig
    schedule: Schedule
    views: _Views
    judged: Sequence[int]  # views of the capture, held out
    renderer: differentiable.DifferentiableRenderer
    extent: float  # world units
    depths: Sequence[DepthMap]  # before whose surfaces Gaussians are removed; none for many views
    members: int  # trainings that are merged, and then trained together; 1: a single one

    def is_finished(self, state: TrainingState) -> bool:
        """Return True after the last step of the last training."""
        return state.step >= self.config.steps and state.member == (self.members if self.members > 1 else 0)

    def work(self, state: TrainingState) -> float:
        """Return the share of the work that is done; a joint step on all members counts as a step on one."""
        done = state.member + self.schedule.work(state.step)
        if self.members == 1:
            return done
        skipped = self.schedule.work(self.schedule.joint_from)  # by the joint training
        return (done - skipped * (state.member == self.members)) / (self.members + 1 - skipped)

    def current(self, state: TrainingState, capture: Capture, indices: Sequence[int]) -> TrainingState:
        """Return `state` or, once its training is finished, the initial state of the next one.

        That is the next member's and, after the last member, that of the joint training.
        """
        if state.step < self.config.steps:
            return state
        member = state.member + 1
        seeded = replace(self.config, seed=self.config.seed + (member << 32))  # a seed of no other run
        if member < self.members:
            first = _first_gaussians(capture, indices, self.depths, seeded)
            after = training.start(first, seeded.seed, self.renderer.device)
            after.finished = training.members(state)
        else:
            after = training.start(training.merged(state), seeded.seed, self.renderer.device)
            after.step = self.schedule.joint_from
        after.member, after.exposures, after.transients = member, state.exposures, state.transients
        return after

    def step(self, state: TrainingState) -> float:
        """Update the Gaussians by one photograph; return the loss before the update."""
        step = state.step + 1
        if not state.queue:
            state.queue = [int(index) for index in state.rng.permutation(len(self.views))]
        if self.config.exposure != "off" and self.schedule.finds_exposures(step):
            state.exposures = self.find_exposures(state)
        loss = self.gradients(state, step, state.queue.pop())
        training.add_opacity_decay(state, self.config.opacity_decay)
        training.adam_step(state, self.schedule.learning_rates(step))
        self.control_density(state, step)
        state.step = step
        return float(loss)

    def gradients(self, state: TrainingState, step: int, index: int) -> Tensor:
        """Find the gradients of a step by view `index`, and what densification needs; return the loss."""
        camera, target, mask = self.views.at(index, coarse=step <= self.schedule.coarse_until)
        degree = self.schedule.active_sh_degree(step)
        rendered = self.renderer.render(state.values, camera, degree, self.views.focals[index])
        image = rendered.image
        if len(state.exposures):
            image = losses.with_exposure(image, state.exposures[index])
        self.observe_transients(state, index, image, target, mask)
        # In empty background, black Gaussians would look like none: alpha counts there.
        loss = rendered.alpha.masked_fill(mask, 0).mean() if self.views.cut_out and mask is not None else 0.0
        mask = self.counted(state, index, None if self.views.cut_out else mask, camera)
        if mask is not None:  # masked pixels are their own target, without a gradient
            image = torch.where(mask[..., None], image, image.detach())
            target = torch.where(mask[..., None], target, image.detach())
        loss = loss + losses.radiance_loss(image, target, self.config.lambda_dssim)
        loss.backward()
        if step < self.schedule.densify_until:
            size = camera.width, camera.height
            training.accumulate(state, rendered.means_px_grad(), rendered.visible, size)
        return loss.detach()

    def control_density(self, state: TrainingState, step: int) -> None:
        """Add and remove Gaussians after a step, clear free space, and reset opacities, where it is time."""
        schedule = self.schedule
        if schedule.densifies(step):
            training.densify(state, self.config, self.extent, prune_large=0 < schedule.reset_every < step)
        clears = schedule.densify_from < step <= schedule.joint_from  # the last steps fill the gaps
        if self.depths and clears and step % schedule.densify_every == 0:
            means = state.values["means"].detach().cpu().numpy()
            keep = np.flatnonzero(~in_free_space(means, self.depths))
            if len(keep) >= training.FEWEST_GAUSSIANS:
                training.rearrange(state, torch.from_numpy(keep).to(state.device))
        if schedule.resets_opacity(step):
            training.reset_opacities(state)

    def held_out(self, state: TrainingState, capture: Capture) -> dict[str, float]:
        """Return the mean PSNR of the views that are judged, dB, a dozen times in a run; else nothing."""
        if not self.judged or state.step % max(self.config.steps // 12, 1):
            return {}
        scores = differentiable.evaluate_views(state.gaussians(), capture, self.judged, self.config.backend)
        return {"psnr": float(np.mean([score.psnr for score in scores]))}

    def find_exposures(self, state: TrainingState) -> Tensor:
        """Return (V, 4, 3) exposures of the training views; none if they explain too little."""
        pairs, degree = [], self.schedule.active_sh_degree(state.step)
        for index in range(len(self.views)):
            camera, target, mask = self.views.at(index, coarse=True)
            mask = self.counted(state, index, mask, camera)
            with torch.no_grad():
                image = self.renderer.render(state.values, camera, degree, self.views.focals[index]).image
            counted = (slice(None), slice(None)) if mask is None else mask
            chosen = image[counted].reshape(-1, 3)[::EXPOSED], target[counted].reshape(-1, 3)[::EXPOSED]
            pairs.append(chosen)
        exposures, gain = losses.fit_exposures(pairs)
        return exposures if gain >= GAIN or self.config.exposure == "on" else exposures[:0]

    def observe_transients(
        self, state: TrainingState, index: int, image: Tensor, target: Tensor, mask: Tensor | None
    ) -> None:
        """Judge the patches of view `index`, of which this step renders `image`.

        Transients that explain less than `EXPLAINED` are given up for the rest of the run.
        """
        judged = state.step == self.schedule.transients_from and self.config.transients == "auto"
        if judged and state.transients.explained() < EXPLAINED:
            state.transients = losses.no_transients(0)
        every = max(self.config.steps // (LOOKS * len(self.views)), 1)  # in passes
        # Each observation counts as much as all before: a sixteenth of older ones would be left.
        since = self.schedule.transients_from - 4 * every * len(self.views)
        looks = state.step >= since and state.step // len(self.views) % every == 0
        if len(state.transients.moving) and looks:
            rendered = losses.patch_means(image)
            if mask is not None:
                rendered[losses.patch_means(mask[..., None].float())[..., 0] < 0.5] = np.nan
            cameras = self.views.cameras
            depths = differentiable.rendered_depths(self.renderer, state.values, cameras[index])
            state.transients.observe(index, cameras, rendered, losses.patch_means(target), depths)

    def counted(self, state: TrainingState, index: int, mask: Tensor | None, camera: Camera) -> Tensor | None:
        """Return (H, W) bool pixels of view `index` that count, of those of its `mask`; None: all of them."""
        moving = state.transients.moving
        if not len(moving) or state.step < self.schedule.transients_from or not moving[index].any():
            return mask
        size = camera.height, camera.width
        still = state.transients.still_pixels(index, size, self.renderer.device)
        return still if mask is None else mask & still


def _first_gaussians(
    capture: Capture, indices: Sequence[int], depths: Sequence[DepthMap], config: RadianceConfig
) -> Gaussians:
    """Return the initial Gaussians: at the capture's points and at a sample of the points of depth maps."""
    found = [(np.zeros((0, 3)), np.zeros((0, 3), np.uint8)), *(one.points() for one in depths)]
    points, colours = (np.concatenate(arrays) for arrays in zip(*found, strict=True))
    chosen = np.random.default_rng(config.seed).permutation(len(points))
    chosen = chosen[: min(STEREO_POINTS, config.max_gaussians // 3)]
    capture = replace(
        capture,
        points=np.concatenate([capture.points, points[chosen]]),
        colours=np.concatenate([capture.colours, colours[chosen]]),
    )
    return training.initial_gaussians(capture, indices, config.sh_degree, config.max_gaussians, config.seed)


# From some number of steps on held-out views get worse; it grows with the photographs (docs/experiments.md).
VISITS = 64  # steps for each of few photographs, after which held-out views gain no more ...
MEMBERS = 2  # ... but of another training, merged with it: an ensemble (Lakshminarayanan et al. 2017)


def supported(config: RadianceConfig, views: int) -> RadianceConfig:
    """Return the settings of a training on so many views: `config`, or what few views support."""
    if views > config.capped_views or config.steps < GOOD["steps"]:
        return config
    most = {**GOOD, "steps": max(VISITS * views, QUICK["steps"])}
    capped = {name: min(most[name], getattr(config, name)) for name in most if name != "opacity_decay"}
    return replace(config, ensemble=config.ensemble or MEMBERS, **capped)

"""When what happens during radiance training, for any number of steps.

At the reference budget this is exactly the INRIA schedule (Kerbl et al. 2023, arguments/__init__.py and
train.py of the public code). A smaller budget shortens every interval in proportion, but not below what
the step needs to make sense: a gradient mean wants every view at least once, a reset opacity wants time
to recover. Steps count from 1.
"""

import math
from dataclasses import dataclass

from langsplat_core.config import RadianceConfig

FEWEST_DENSIFY_FROM = 50  # steps before positions and opacities say anything
FEWEST_DENSIFY_EVERY = 25  # steps between two rounds; more when there are more views
FEWEST_RESET_EVERY = 600  # steps an opacity needs to come back from 0.01
FEWEST_SH_EVERY = 100  # steps per degree of the spherical harmonics


@dataclass(frozen=True)
class Schedule:
    """Step numbers of one training run; `steps` is its length."""

    steps: int
    densify_from: int  # densification rounds come after this step ...
    densify_until: int  # ... and before this one
    densify_every: int
    reset_every: int  # opacity resets, before `densify_until` only
    prune_large_from: int  # after this step Gaussians larger than a tenth of the extent are removed
    sh_degree: int
    sh_degree_every: int
    coarse_until: int  # up to this step pictures have half their size
    position_lr_init: float  # already times the cameras' extent
    position_lr_final: float

    def densifies(self, step: int) -> bool:
        """True where a round of densification and pruning ends the step."""
        return self.densify_from < step < self.densify_until and step % self.densify_every == 0

    def resets_opacity(self, step: int) -> bool:
        """True where opacities are capped at 0.01 after the step."""
        return step < self.densify_until and step % self.reset_every == 0

    def active_sh_degree(self, step: int) -> int:
        """Degree of the spherical harmonics used and trained in the step."""
        return min(self.sh_degree, step // self.sh_degree_every)

    def position_lr(self, step: int) -> float:
        """World units per step, decaying log-linearly from the first to the last step."""
        t = min(step / self.steps, 1.0)
        return math.exp((1 - t) * math.log(self.position_lr_init) + t * math.log(self.position_lr_final))


def schedule_for(config: RadianceConfig, views: int, extent: float) -> Schedule:
    """The schedule of a run over `views` training views around cameras of `extent` world units."""
    ratio = config.steps / config.reference_steps

    def scaled(reference: int, fewest: int = 1) -> int:
        return max(round(reference * ratio), min(fewest, reference), 1)

    densify_until = scaled(config.densify_until)
    return Schedule(
        steps=config.steps,
        densify_from=scaled(config.densify_from, FEWEST_DENSIFY_FROM),
        densify_until=densify_until,
        densify_every=scaled(config.densify_every, max(FEWEST_DENSIFY_EVERY, views)),
        reset_every=scaled(config.opacity_reset_every, FEWEST_RESET_EVERY),
        prune_large_from=scaled(config.opacity_reset_every),
        sh_degree=config.sh_degree,
        sh_degree_every=scaled(config.sh_degree_every, FEWEST_SH_EVERY),
        coarse_until=round(config.coarse_fraction * config.steps),
        position_lr_init=config.position_lr_init * extent,
        position_lr_final=config.position_lr_final * extent,
    )

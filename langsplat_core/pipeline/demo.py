"""The bundled scene: a procedural room, photographed by our renderer, trained by our pipeline.

Nothing is planted: the pipeline sees the photographs, their cameras and noisy points, never the truth.
"""

from pathlib import Path

from langsplat_core.config import (
    ClipConfig,
    CodecConfig,
    CompactConfig,
    DatasetConfig,
    MaskConfig,
    RadianceConfig,
    TrainConfig,
)
from langsplat_core.datasets.synthetic.dataset import write_dataset
from langsplat_core.datasets.synthetic.rooms import Tier
from langsplat_core.pipeline.compact import CompactReport, compact_scene
from langsplat_core.pipeline.train import train_scene
from langsplat_core.progress import Progress, silent

SEED = 2
VIEWS = 72
SIZE = (640, 480)
MAX_LOSS = 0.1  # dB that compaction may cost


def demo_config(steps: int) -> TrainConfig:
    """Settings of the bundled scene: a low SH degree and a cap on the count keep the file small."""
    return TrainConfig(
        dataset=DatasetConfig(max_side=max(SIZE), test_every=9),
        radiance=RadianceConfig(steps=steps, sh_degree=1, max_gaussians=110_000),
        masks=MaskConfig(source="graph"),
        clip=ClipConfig(model="demo"),
        codec=CodecConfig(steps=6_000),
    )


def build_demo(
    out: Path,
    seed: int = SEED,
    tier: Tier = "clutter",
    steps: int = 6_000,
    progress: Progress = silent,
) -> CompactReport:
    """Render the room of `seed` and `tier`, train, and drop what the photographs do not miss.

    Photographs and truth stay in `<out>.work/photographs`, the scene as trained in `<out>.work/trained.ply`.
    """
    work = out.with_name(out.stem + ".work")
    photographs, trained = work / "photographs", work / "trained.ply"
    if not (photographs / "transforms.json").exists():
        write_dataset(photographs, seed, VIEWS, SIZE, progress, tier)
    train_scene(photographs, trained, demo_config(steps), work, progress)
    return compact_scene(trained, out, CompactConfig(max_psnr_loss=MAX_LOSS), photographs, progress)

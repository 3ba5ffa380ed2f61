"""The bundled scene: a procedural room, photographed by our renderer, trained by our pipeline.

Nothing is planted: the pipeline sees the photographs, their cameras and noisy points, never the truth.
"""

from pathlib import Path

from langsplat_core.config import (
    ClipConfig,
    CodecConfig,
    DatasetConfig,
    MaskConfig,
    RadianceConfig,
    TrainConfig,
)
from langsplat_core.datasets.synthetic.dataset import write_dataset
from langsplat_core.pipeline.train import TrainReport, train_scene
from langsplat_core.progress import Progress, silent

SEED = 2
VIEWS = 72
SIZE = (640, 480)


def demo_config(steps: int) -> TrainConfig:
    """Settings of the bundled scene: a low SH degree and a cap on the count keep the file small."""
    return TrainConfig(
        dataset=DatasetConfig(max_side=max(SIZE), test_every=9),
        radiance=RadianceConfig(steps=steps, sh_degree=1, max_gaussians=110_000),
        masks=MaskConfig(source="graph"),
        clip=ClipConfig(model="demo"),
        codec=CodecConfig(steps=6_000),
    )


def build_demo(out: Path, seed: int = SEED, steps: int = 6_000, progress: Progress = silent) -> TrainReport:
    """Render and train; photographs and truth stay in `<out>.work/photographs`."""
    work = out.with_name(out.stem + ".work")
    photographs = work / "photographs"
    if not (photographs / "transforms.json").exists():
        write_dataset(photographs, seed, VIEWS, SIZE, progress)
    return train_scene(photographs, out, demo_config(steps), work, progress)

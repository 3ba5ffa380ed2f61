"""The bundled scene: a procedural room, photographed by our renderer, trained by our pipeline.

The pipeline sees the photographs, their cameras, noisy points and, in place of SAM, the outlines of things
and parts. Their names and colours it never sees: those come from the encoder.
"""

from pathlib import Path

from assets.making.dataset import write_dataset
from assets.making.truth import TruthMasks, read_truth
from langsplat_core.config import (
    ClipConfig,
    DatasetConfig,
    MaskConfig,
    RadianceConfig,
    TrainConfig,
)
from langsplat_core.extensions.compaction.compact import BudgetConfig, compact_scene
from langsplat_core.pipeline.train import train_scene
from langsplat_core.progress import Progress, silent

SEED = 2
VIEWS = 72
SIZE = (640, 480)
MAX_LOSS = 0.25  # dB that compaction may cost


# A low SH degree and a cap on the count keep the file small.
CONFIG = TrainConfig(
    dataset=DatasetConfig(max_side=max(SIZE), test_every=9, hold_out="every"),
    radiance=RadianceConfig(steps=6_000, sh_degree=1, max_gaussians=110_000),
    masks=MaskConfig(source="graph"),
    clip=ClipConfig(model="demo"),
)


def build_scene(out: Path, gaussians: Path | None = None, progress: Progress = silent) -> str:
    """Render the room, train a scene, and drop what its photographs do not miss.

    Given `gaussians`, a scene of that room, only its language field is made anew. Returns a line about what
    was made. Photographs and truth stay in `<out>.work/photographs`, the scene as trained in
    `<out>.work/trained.ply`.
    """
    work = out.with_name(out.stem + ".work")
    photographs, trained = work / "photographs", work / "trained.ply"
    if not (photographs / "transforms.json").exists():
        write_dataset(photographs, SEED, VIEWS, SIZE, progress)
    made = train_scene(
        photographs,
        out if gaussians else trained,
        CONFIG,
        work,
        progress,
        masks_of=lambda capture: TruthMasks(capture, read_truth(photographs)),
        gaussians_from=gaussians,
    )
    if gaussians:
        return f"{made.gaussians} Gaussians of {gaussians}, {made.codec} of {made.codec_size}"
    report = compact_scene(trained, out, BudgetConfig(max_psnr_loss=MAX_LOSS), photographs, progress)
    kept, before = report.after, report.before.gaussians
    return f"{kept.gaussians} Gaussians of {before} trained, held-out {kept.psnr:.2f} dB"

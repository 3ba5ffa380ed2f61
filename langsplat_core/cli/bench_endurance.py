"""`langsplat bench endurance`: a large scene, large pictures and many phrases in one process."""

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.cli.bench_files import save_figures
from langsplat_core.cli.checks import OutFolder
from langsplat_core.errors import InputError
from langsplat_core.io.scenes import load_scene
from langsplat_core.lab.config import EnduranceConfig
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.engine import no_field
from langsplat_core.semantics.encoders import load_text_encoder


@dataclass(frozen=True)
class BenchEndurance:
    """Draw pictures of a scene made large and ask it phrase after phrase, in one process: time, peak memory,
    and whether memory grows. Some ten minutes of the processor and 8 GB as it stands."""

    scene: tyro.conf.Positional[Path]
    """A scene with a language field, and its cameras beside it."""
    config: Annotated[EnduranceConfig, tyro.conf.arg(name="")] = field(default_factory=EnduranceConfig)
    out: OutFolder = Path("bench_out")
    """Folder for endurance.md and endurance.json."""

    def run(self) -> None:
        scene = load_scene(self.scene)
        if scene.language is None or not scene.cameras:
            reason = no_field(scene) if scene.language is None else "it has no cameras beside it"
            raise InputError(f"{self.scene}: {reason}")
        from langsplat_core.lab.speed.endurance import endurance_table, measure_endurance

        encoder = load_text_encoder(scene.language.encoder_id)
        with TerminalProgress() as progress:
            stretches = measure_endurance(scene, encoder, self.config, progress)
        table = endurance_table(self.config, stretches)
        save_figures(self.out, "endurance", table, [asdict(stretch) for stretch in stretches])
        print(table)

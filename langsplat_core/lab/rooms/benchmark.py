"""The benchmark on procedural rooms: freshly rendered, trained by the ordinary pipeline, compared with the
truth; and an error budget, which swaps one stage at a time for one that makes no mistake."""

from pathlib import Path

from assets.making.scene import SEED
from langsplat_core.config import check_settings
from langsplat_core.errors import InputError
from langsplat_core.lab.config import BenchmarkConfig
from langsplat_core.lab.rooms.report import RoomReport
from langsplat_core.lab.rooms.room import Room, labelled, room_encoder
from langsplat_core.progress import Progress, silent


def run_benchmark(config: BenchmarkConfig, work: Path, progress: Progress = silent) -> list[RoomReport]:
    """Measure every tier and seed. What is in `work` from an earlier run with the same settings is not made
    again. Raises InputError for settings that cannot be measured."""
    _check(config)
    encoder = room_encoder(config.encoder, config.text_vectors)
    reports = []
    for tier in config.tiers:
        for seed in config.seeds:
            label = f"{tier} {seed}, "
            room = Room(config, tier, seed, work, encoder, labelled(progress, label))
            reports.append(room.report())
    return reports


def _check(config: BenchmarkConfig) -> None:
    check_settings(config)
    if not config.tiers:
        raise InputError("eval synthetic: name at least one of --tiers")
    if SEED in config.seeds:
        raise InputError(
            f"--seeds {SEED} is the bundled scene's room, on which things were tuned; take another seed"
        )

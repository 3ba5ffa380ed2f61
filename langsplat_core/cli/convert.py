"""`langsplat convert`: one scene file to another, carrying the language field along."""

from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from langsplat_core.formats import (
    check_writable,
    load_scene,
    load_without_language,
    rematch_language,
    save_scene,
)


@dataclass(frozen=True)
class Convert:
    """Write any readable scene as .ply, .spz or .splat, with language field and cameras beside it if it has
    them. A .ply (INRIA's) keeps everything, .spz is ten times smaller and rounded, .splat is without view
    dependence."""

    source: tyro.conf.Positional[Path]
    """Scene to read: .ply, compressed .ply, .spz, .splat, .ksplat, SOG folder, meta.json or .sog."""
    out: tyro.conf.Positional[Path]
    """Scene to write: .ply, .spz or .splat."""
    rematch: Path | None = None
    """A language sidecar (*.langsplat.safetensors) made before the Gaussians were edited: its field is
    carried over to the Gaussians of SOURCE by nearest position."""

    def run(self) -> None:
        check_writable(self.out)  # before minutes are spent on reading
        if self.rematch is None:
            scene = load_scene(self.source)
        else:
            scene = load_without_language(self.source)
            scene = replace(scene, language=rematch_language(self.rematch, scene.gaussians.means))
        save_scene(self.out, replace(scene, path=self.out))
        field = "with a language field" if scene.language else "without a language field"
        print(f"{self.out}: {len(scene.gaussians)} Gaussians, {field}")

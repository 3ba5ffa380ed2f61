"""`langsplat export`: a scene as a page for a browser."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from langsplat_core.errors import InputError
from langsplat_core.io.files import check_output_file
from langsplat_core.io.language import read_words
from langsplat_core.io.scenes import load_scene
from langsplat_core.pipeline.webpage import write_page
from langsplat_core.progress import TerminalProgress
from langsplat_core.query.engine import QueryEngine
from langsplat_core.semantics.encoders import load_text_encoder


@dataclass(frozen=True)
class Export:
    """Write a scene as one HTML file that any browser shows and searches, without a network or a server."""

    scene: tyro.conf.Positional[Path]
    """Any readable scene."""
    out: tyro.conf.Positional[Path]
    """Page to write, *.html."""
    title: str = ""
    """Heading of the page, by default the scene's name."""
    words: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Your own taught words, *.safetensors, beside those of the scene."""
    encoder: str = ""
    """Text encoder folder or hub id, in place of the one the scene names."""

    def run(self) -> None:
        if self.out.suffix.lower() not in (".html", ".htm"):
            raise InputError(f"{self.out}: pages are written as .html; choose such a name")
        check_output_file(self.out)
        words = None if self.words is None else read_words(self.words)
        with TerminalProgress() as progress:
            progress("reading the scene", 0.0)
            scene = load_scene(self.scene)
            engine = None
            if scene.language is not None:
                engine = QueryEngine(scene, load_text_encoder, encoder_id=self.encoder, words=words)
            title = self.title or self.out.stem
            report = write_page(self.out, scene, engine, title, progress)
        if report.why_not:
            asked = f"nothing can be searched: {report.why_not}"
        elif report.free_text:
            asked = "any words of the scene's encoder can be searched"
        else:
            asked = f"{report.phrases:,} phrases can be searched"
        print(f"{self.out}: {report.gaussians:,} Gaussians, {report.bytes / 1e6:.2f} MB; {asked}")

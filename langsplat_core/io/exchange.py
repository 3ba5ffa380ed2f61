"""Scenes of other programs that are no single file: what an extension adds to `langsplat convert`."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from langsplat_core.config import CodecConfig
from langsplat_core.progress import Progress
from langsplat_core.scene import Scene


@dataclass(frozen=True)
class ImportRequest:
    """Files that another method has of one scene, and what they do not say themselves."""

    paths: tuple[Path, ...]
    encoder: str | None  # hub id or folder of the text encoder of the vectors; None: the method's own
    levels: tuple[str, ...]  # of the files with features, in their order; empty: files and folders tell
    phrases: tuple[str, ...]  # are stored encoded
    codec: CodecConfig  # for whole vectors


@dataclass(frozen=True)
class Importer:
    """A reader of files that another method has of a scene."""

    suffixes: tuple[str, ...]  # lower case, of files that no format of scenes has
    read: Callable[[ImportRequest, Progress], tuple[Scene, tuple[str, ...]]]  # with lines to print


@dataclass(frozen=True)
class ExportRequest:
    """A scene to be written for another program."""

    sources: tuple[Path, ...]  # files or folders that the command line named, one at least
    load: Callable[[], Scene]  # reads `sources` as a scene
    out: Path  # folder to write, which can be written to


@dataclass(frozen=True)
class Exporter:
    """A writer of files for another program: a word of `langsplat convert --to`."""

    about: str  # what is written, a sentence
    write: Callable[[ExportRequest, Progress], tuple[str, ...]]  # returns lines to print

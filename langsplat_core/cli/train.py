"""`langsplat train`: photographs -> scene.ply with a language field."""

import contextlib
import io
import logging
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import tyro

from langsplat_core.cli.arguments import OutFolder, check_codec, named
from langsplat_core.cli.run import one_line
from langsplat_core.config import (
    PAPER,
    TrainConfig,
    TrainPreset,
    TrainProfile,
    Until,
    check_settings,
    named_values,
    with_preset,
)
from langsplat_core.errors import InputError, printable_line, shortened
from langsplat_core.io.hostile import is_video, read_text
from langsplat_core.progress import TerminalProgress, silent

log = logging.getLogger("langsplat")


@dataclass(frozen=True)
class Train:
    """Train a searchable scene from photographs.

    DATASET is a COLMAP folder, a nerfstudio transforms.json, a video or a plain folder of photographs; of
    several each makes a scene of its own. An interrupted run continues where it stopped.
    """

    dataset: tyro.conf.Positional[tuple[Path, ...]]
    """Folder of photographs, video, COLMAP project folder, or transforms.json; several make a scene each."""
    out: Path
    """Scene to write, *.ply, with its language field and cameras beside it; of several datasets a folder."""
    on: Annotated[str, tyro.conf.arg(metavar="WHERE")] = ""
    """What trains several datasets: local:N, N at a time on this machine, or the workers of dask://HOST:PORT."""
    work: OutFolder | None = None
    """Folder for intermediate results (default: <out>.work)."""
    profile: TrainProfile = "default"
    """"paper" starts from the published method's settings; options beside it still count."""
    preset: TrainPreset = "full"
    """quick: minutes on a CPU; good: half an hour; full: as published, for a GPU; options beside it count."""
    progress: Literal["bars", "lines"] = "bars"
    """On standard error: bars, or for other programs lines of JSON (stage, fraction, note, metrics)."""
    config_file: Annotated[Path | None, tyro.conf.arg(name="config", metavar="FILE.toml")] = None
    """A file of options, `preset = "good"` or `radiance.steps = 7000`; options beside it count more."""
    gaussians: Annotated[Path | None, tyro.conf.arg(metavar="SCENE")] = None
    """Take the Gaussians of this scene, trained elsewhere from the same cameras, and describe them."""
    until: Until = "language field"
    """"gaussians" writes a scene without a language field; the same command without this adds that."""
    config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=TrainConfig)

    def run(self) -> None:
        self._say_unused()
        if self.on or len(self.dataset) != 1:
            self._train_several()
            return
        # They import torch: seconds that --help need not pay.
        from langsplat_core.pipeline.report import PAGE, work_folder
        from langsplat_core.pipeline.stages import join_processes
        from langsplat_core.pipeline.train import train_scene

        processes = join_processes()
        shown = TerminalProgress(self.progress == "lines") if processes.is_main else nullcontext(silent)
        with shown as progress:
            report = train_scene(
                self.dataset[0],
                self.out,
                self.config,
                self.work,
                progress,
                processes=processes,
                gaussians_from=self.gaussians,
                until=self.until,
            )
        if not processes.is_main:
            return
        names = shortened(view.name for view in report.held_out_views)
        small = "" if report.psnr_small is None else f", {report.psnr_small:.2f} dB at 320 px"
        psnr = "none held out, so that nothing was measured"
        if report.psnr is not None:
            psnr = f"held-out PSNR {report.psnr:.2f} dB{small} ({report.held_out_rule}: {names})"
        described = (
            f"{report.mask_count} masks by {report.masks}, encoder {report.encoder}; "
            f"{report.codec} of {report.codec_size}, relevancy error {report.relevancy_error:.4f} "
            f"(99 % below {report.relevancy_error_p99:.3f})"
        )
        print(
            f"{self.out}: {report.gaussians} Gaussians from {report.views} photographs, {psnr}; "
            f"{described if report.masks else 'no language field'}; {sum(report.seconds.values()):.0f} s"
        )
        for warning in report.warnings:
            print(f"warning: {warning}")
        print(f"photographs beside what the scene shows: {(self.work or work_folder(self.out)) / PAGE}")

    def _say_unused(self) -> None:
        """Say which settings have no effect beside the others; a file for many captures may hold some."""
        config, usual = self.config, PAPER if self.profile == "paper" else TrainConfig()
        pairs = zip(named_values(config), named_values(usual), strict=True)
        given = [name for (name, value, _), (_, other, _) in pairs if value != other]
        masks, mode = config.masks, config.lift.mode
        graph = masks.source == "graph" or (masks.source == "auto" and not masks.sam)
        for pattern, unused, by in (
            (r"--dataset\.frames", not any(map(is_video, self.dataset)), "photographs"),
            (r"--masks\.(?!source)", graph, "--masks.source graph"),
            (r"--lift\.(steps|lr|start|seed)", mode != "gradient", f"--lift.mode {mode}"),
        ):
            if names := [name for name in given if unused and re.match(pattern, name)]:
                log.warning("%s: of no effect with %s", ", ".join(names), by)

    def _train_several(self) -> None:
        from langsplat_core.pipeline.train import Trained, tasks_for, train_captures

        if not self.dataset or self.work or self.gaussians:
            raise InputError("give a DATASET; --work and --gaussians are of one alone")
        if self.out.suffix.lower() == ".ply":
            raise InputError(f"--out {self.out}: of --on and of several datasets it is a folder; name one")
        tasks, rows = tasks_for(self.dataset, self.out, self.config, self.until), list[Trained]()
        try:
            with (
                TerminalProgress(self.progress == "lines") as progress,
                closing(train_captures(tasks, self.on or "local:1", progress)) as ended,
            ):
                rows.extend(ended)
        finally:  # also of Ctrl-C, as far as it came
            if rows:
                print("capture               located   held out  seconds  exit")
            for row in rows:
                print(f"{row.name:<18} {row.located:>10} {row.psnr:>10} {row.seconds:>8.0f} {row.code:>5}")
                for line in row.said:
                    print(f"  {printable_line(line)}")
        if failed := [row.name for row in rows if row.code]:
            raise InputError(f"{len(failed)} of {len(tasks)} captures have no scene: {shortened(failed)}")


def train_command(args: Sequence[str]) -> type[Train]:
    """Return `Train` with the settings of the profile and preset that `args` name as defaults."""
    profile, preset = named(args, "--profile")[0], named(args, "--preset")[0]
    config = PAPER if profile == "paper" else TrainConfig()
    check_codec(args, config.codec.kind)
    if preset in get_args(TrainPreset):
        config = with_preset(config, preset)  # type: ignore[arg-type]  # it is one of them

    @dataclass(frozen=True)
    class ProfiledTrain(Train):
        config: Annotated[TrainConfig, tyro.conf.arg(name="")] = field(default_factory=lambda: config)

    ProfiledTrain.__doc__ = Train.__doc__
    return ProfiledTrain


def with_file(args: Sequence[str]) -> list[str]:
    """Return the words of `langsplat train ...` behind those of --config's file; InputError names its key."""
    if not (name := named(args, "--config")[0]):
        return list(args)
    text, complaint = read_text(Path(name)), io.StringIO()
    try:
        words = list(_words(tomllib.loads(text)))
        alone = ["photographs", *words, "--out=s.ply"]  # first, so that the file is blamed for what is in it
        with contextlib.redirect_stderr(complaint):
            check_settings(tyro.cli(train_command(words), prog=name, args=alone, add_help=False))
    except SystemExit:
        raise InputError(f"{name}: {printable_line(one_line(complaint.getvalue()), 200)}") from None
    except (ValueError, InputError) as error:  # a TOMLDecodeError is a ValueError
        raise InputError(f"{name}: cannot be used as --config: {printable_line(error, 190)}") from None
    return [args[0], *words, "--config", name, *args[1:]]  # an option, so that no list takes the dataset


def _words(table: Mapping[str, Any], before: str = "") -> Iterator[str]:
    """Yield a TOML table as words of a command line; ValueError for words that look like an option."""
    for key, value in table.items():
        values = list(map(str, value)) if isinstance(value, list) else []
        if f"{before}{key}" == "config" or key[:1].isdigit() or any(text[:1] == "-" for text in values):
            raise ValueError(f"{key}: names another file, is a number, or begins with a dash")
        if isinstance(value, dict):
            yield from _words(value, f"{before}{key}.")
        elif isinstance(value, bool):
            yield f"--{before}{'' if value else 'no-'}{key}"
        elif isinstance(value, list):
            yield from (f"--{before}{key}", *values)
        else:
            yield f"--{before}{key}={value}"

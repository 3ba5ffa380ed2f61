"""3D-OVS (Liu et al. 2023): one mask picture per view and class.

<scene>/segmentations/classes.txt           one class a line
<scene>/segmentations/<view>/<class>.png    bright inside, of any size
<scene>/images/<view>.jpg                   the photograph, whose grid is scored
"""

from pathlib import Path

from langsplat_core.errors import FormatError, InputError
from langsplat_core.evaluation.protocols.labels import (
    Benchmark,
    Frame,
    Label,
    LabelledScene,
    MaskFile,
    photograph_of,
)
from langsplat_core.parsing.pictures import picture_size

WANTED = "expected segmentations/classes.txt in it, or in folders of it, one per scene"


def read_3d_ovs(folder: Path) -> Benchmark:
    """The labels in `folder`: one scene's, or several scenes' folders.

    What a view has a picture of is asked there. Raises InputError for a folder of another layout and
    FormatError for a scene that breaks it.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; {WANTED}")
    scenes = [folder] if _is_scene(folder) else [path for path in sorted(folder.iterdir()) if _is_scene(path)]
    if not scenes:
        other = (folder / "label").is_dir() or (folder.parent / "label" / folder.name).is_dir()
        hint = "it looks like LERF-OVS: use `langsplat eval lerf-ovs`; " if other else ""
        raise InputError(f"{folder}: not in the layout of 3D-OVS; {hint}{WANTED}")
    return Benchmark("3d-ovs", {scene.resolve().name: _read_scene(scene) for scene in scenes})


def _is_scene(folder: Path) -> bool:
    return (folder / "segmentations" / "classes.txt").is_file()


def _read_scene(folder: Path) -> LabelledScene:
    classes = read_classes(folder / "segmentations" / "classes.txt")
    views = sorted(path for path in (folder / "segmentations").iterdir() if path.is_dir())
    stray = [
        f"{view.name}: {path.stem} (not in classes.txt)"
        for view in views
        for path in sorted(view.glob("*.png"))
        if path.stem not in classes
    ]
    frames = [_read_frame(folder, view, classes) for view in views]
    labelled = tuple(frame for frame in frames if frame.labels)
    if not labelled:
        raise FormatError(f"{folder / 'segmentations'}: no <view>/<class>.png for any line of classes.txt")
    return LabelledScene(folder.resolve().name, labelled, folder, tuple(stray))


def read_classes(path: Path) -> tuple[str, ...]:
    """One class a line, each once; FormatError where there is none or the file is no text."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise FormatError(f"{path}: not a text file; expected one class a line") from None
    classes = tuple(dict.fromkeys(line.strip() for line in lines if line.strip()))
    if not classes:
        raise FormatError(f"{path}: is empty; expected one class a line")
    return classes


def _read_frame(folder: Path, view: Path, classes: tuple[str, ...]) -> Frame:
    files = {name: view / f"{name}.png" for name in classes if (view / f"{name}.png").is_file()}
    photograph = photograph_of(folder / "images", view.name)
    grid = photograph or next(iter(files.values()), None)
    labels = tuple(Label(name, MaskFile(path), None) for name, path in files.items())
    return Frame(view.name, (1, 1) if grid is None else picture_size(grid), labels, photograph)

"""Letters: the window's own font, and behind it others for what that does not have."""

import sys
from importlib.util import find_spec
from pathlib import Path

from imgui_bundle import hello_imgui

SIZE = 15.0  # window units
FOLDERS = {
    "linux": ("/usr/share/fonts", "/usr/local/share/fonts", "~/.local/share/fonts", "~/.fonts"),
    "darwin": ("/System/Library/Fonts", "/Library/Fonts", "~/Library/Fonts"),
    "win32": ("C:/Windows/Fonts",),
}
# Fonts with the scripts of East Asia and others with many, the first that is there is taken.
WIDE = (
    *("NotoSansCJK-Regular.ttc", "NotoSansCJK-VF.ttc", "NotoSansCJKjp-Regular.otf", "SourceHanSans.ttc"),
    *(
        "DroidSansFallbackFull.ttf",
        "DroidSansFallback.ttf",
        "wqy-microhei.ttc",
        "wqy-zenhei.ttc",
        "unifont.ttf",
    ),
    *("Arial Unicode.ttf", "PingFang.ttc", "Hiragino Sans GB.ttc", "msyh.ttc", "YuGothM.ttc", "malgun.ttf"),
)
BUNDLED = {  # package -> its file; pictographs, and letters: Latin, Greek, Cyrillic, Hebrew, Arabic, more
    "matplotlib": "mpl-data/fonts/ttf/DejaVuSans.ttf",
    "imgui_bundle": "demos_assets/fonts/NotoEmoji-Regular.ttf",
}


def load() -> None:
    """The callback of hello_imgui: its default font, with what else there is merged into it. Letters are
    drawn into the texture when they first appear, so that a large font costs nothing until then."""
    hello_imgui.imgui_default_settings.load_default_font_with_font_awesome_icons()
    merged = hello_imgui.FontLoadingParams()
    merged.merge_to_last_font, merged.inside_assets = True, False
    for path in fallbacks():
        hello_imgui.load_font(str(path), SIZE, merged)


def fallbacks() -> list[Path]:
    """Font files to look letters up in, in this order."""
    found = (*(_bundled(package, file) for package, file in BUNDLED.items()), _installed())
    return [path for path in found if path is not None]


def _bundled(package: str, file: str) -> Path | None:
    spec = find_spec(package)
    if spec is None or spec.origin is None:
        return None
    path = Path(spec.origin).parent / file
    return path if path.is_file() else None


def _installed() -> Path | None:
    files: dict[str, Path] = {}
    for folder in FOLDERS.get(sys.platform, ()):
        for path in Path(folder).expanduser().rglob("*.[to]t[fc]"):
            files.setdefault(path.name, path)
    return next((files[name] for name in WIDE if name in files), None)

"""Pages in a real browser: Debian's Chromium, without a screen, a graphics card or a network."""

import base64
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from langsplat_core.arrays import Array
from langsplat_core.scene import Camera

CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--no-sandbox --disable-gpu --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--disable-quic --no-first-run --disable-background-networking --disable-component-update --disable-sync"
)
IMAGE = """async ([camera, display, phrase]) => {
  const bytes = await (await langsplat).image(camera, display, phrase);
  let letters = "";
  for (let i = 0; i < bytes.length; i += 8192) letters += String.fromCharCode(...bytes.subarray(i, i + 8192));
  return btoa(letters);
}"""


class Tab:
    """A page that is open, with all that it asked for and said."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.requests: list[str] = []
        self.faults: list[str] = []
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("pageerror", lambda error: self.faults.append(str(error)))

    def open(self, path: Path) -> None:
        """Open a file and wait until its scene is there."""
        self.page.goto(path.as_uri())
        self.page.evaluate("langsplat.then(() => 0)")

    def run(self, script: str, argument: Any = None) -> Any:
        """What a function in JavaScript returns."""
        return self.page.evaluate(script, argument)

    def ask(self, phrase: str, level: str = "auto") -> dict[str, Any]:
        """The page's answer to a phrase, and the number of its members."""
        found: dict[str, Any] = self.run(
            """async ([phrase, level]) => {
              const { page, ask } = await langsplat, answer = ask(phrase, level);
              const { values, members } = page.language.spread(answer, answer.level);
              return { ...answer, values: null, codes: null, members: members.reduce((a, b) => a + b, 0),
                       mean: values.reduce((a, b) => a + b, 0) / values.length };
            }""",
            [phrase, level],
        )
        return found

    def image(self, camera: Camera, origin: Array, display: str = "rgb", phrase: str = "") -> Array:
        """(H, W, 3) uint8 of a camera, which stands `origin` (3,) away from where the page has it."""
        pose = {"rotation": camera.rotation.ravel().tolist(), "position": (camera.position - origin).tolist()}
        inner = {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
        letters = self.run(IMAGE, [pose | inner, display, phrase])
        image = np.frombuffer(base64.b64decode(letters), np.uint8)
        return image.reshape(camera.height, camera.width, 4)[..., :3]


@contextmanager
def open_browser() -> Iterator[Any]:
    """A browser; the test is skipped where there is none."""
    found = next(filter(None, map(shutil.which, CHROMIUM)), None)
    if found is None:
        pytest.skip("no Chromium here: apt-get install chromium")
    driver = pytest.importorskip("playwright.sync_api", reason="no playwright here: pip install playwright")
    with driver.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=found, args=FLAGS.split())
        yield browser
        browser.close()


@contextmanager
def open_tab(browser: Any, path: Path, **settings: Any) -> Iterator[Tab]:
    """A file open in a profile of its own; settings: of playwright's `new_context`."""
    context = browser.new_context(offline=True, **{"viewport": {"width": 480, "height": 360}} | settings)
    try:
        tab = Tab(context.new_page())
        tab.open(path)
        yield tab
    finally:
        context.close()

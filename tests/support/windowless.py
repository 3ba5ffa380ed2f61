"""A viewer without a window: a fake picture, fake files, and frames on demand."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from langsplat_core.errors import FormatError
from langsplat_core.scene import Scene
from langsplat_viewer.actions import editing, opening, queries, settings, viewpoint
from langsplat_viewer.camera.controls import extent_of, from_camera, orbit
from langsplat_viewer.camera.flight import Flight, Keyframe, pose_of
from langsplat_viewer.canvas import Canvas
from langsplat_viewer.marks import unmarked
from langsplat_viewer.rendering.renderer import Backend, open_renderer
from langsplat_viewer.rendering.request import Clip, RenderRequest, Splats
from langsplat_viewer.session import MarkBits
from langsplat_viewer.state import GLIDE_SECONDS, OpenScene, ViewerState
from langsplat_viewer.viewer import Services, Viewer
from tests.support.fakes import PER_BLOB, WORDS, FakeEncoder, blob_scene

SCENES = {
    "blobs.ply": blob_scene(),
    "plain.ply": blob_scene(field=False),
    "bare.ply": blob_scene(with_cameras=False),
    "book.ply": blob_scene(phrasebook=True),
}


class FakeSurface:
    """A picture of one colour whose surface is a plane through the origin."""

    def point_at(self, u: float, v: float):
        return None if u > 0.9 else np.array([u - 0.5, v - 0.5, 0.0])

    def depths(self):
        """Nothing is drawn, so that nothing is hidden."""
        return np.zeros((12, 16), np.float32)

    def capture(self, request: RenderRequest):
        return np.full((6, 8, 3), 77, np.uint8)


class FakeRenderer:
    """Notes the requests it draws, and takes as long as it is told to, on a clock of its own."""

    def __init__(self, seconds: float = 0.0, seconds_merged: float = 0.0, backend: str = "opengl") -> None:
        """An image takes `seconds`, one of merged Gaussians `seconds_merged`."""
        self.backend, self.seconds, self.seconds_merged = backend, seconds, seconds_merged
        self.drawn: list[RenderRequest] = []
        self.now = 0.0
        self.nothing = False  # whether images show nothing

    def clock(self) -> float:
        return self.now

    def ahead(self, request: RenderRequest) -> None:
        return None

    def draw(self, request: RenderRequest, targets) -> None:
        self.drawn.append(request)
        self.now += self.seconds if request.merged is None else self.seconds_merged
        for target in targets:
            target.write(bytes((255, 0, 0, 255)) * target.width * target.height)

    def shows_nothing(self) -> bool:
        return self.nothing

    def depth_at(self, request: RenderRequest, x_px: float, y_px: float) -> float | None:
        """Only in the right half of the image there is a surface; merged Gaussians are farther away."""
        return None if x_px <= request.camera.width / 2 else 2.0 if request.merged is None else 3.0


def render_image(request: RenderRequest, backend: Backend = "auto") -> np.ndarray:
    """Return the (H, W, 3) uint8 image, row 0 on top, (H, W, 4) of a transparent one."""
    with open_renderer(backend) as renderer:
        return renderer.read(request)


def picture(path: Path) -> np.ndarray:
    """Return (H, W, 3), of a transparent one (H, W, 4), numbers of an image file."""
    return np.asarray(Image.open(path)).astype(int)


def load(path: Path) -> Scene:
    if path.name not in SCENES:
        raise FormatError(f"{path}: broken; export it again")
    return SCENES[path.name]


@contextmanager
def new_viewer() -> Iterator[Viewer]:
    """Nothing is open."""
    made = Viewer(Services(load, lambda encoder_id: FakeEncoder()), surface=FakeSurface())
    yield made
    made.worker.close()


def settle(viewer: Viewer) -> None:
    """Frames until the worker has nothing left to do."""

    def frame() -> None:
        viewer.take_results()
        viewpoint.tick(viewer, 0.0)

    repeat(frame, lambda: viewer.worker.current is not None)
    frame()


def repeat(step: Callable[[], object], goes_on: Callable[[], object]) -> None:
    """Steps, one after another, as long as something goes on."""
    end = time.monotonic() + 120
    while goes_on():
        assert time.monotonic() < end, "it never finished"
        step()
        time.sleep(0.002)


def act(action: Callable[..., object], viewer: Viewer, *arguments: object, **options: object) -> None:
    """Do something, and wait until the worker has done what that began."""
    action(viewer, *arguments, **options)
    settle(viewer)


def go(action: Callable[..., object], viewer: Viewer, *arguments: object) -> None:
    """Do something, and let the camera that it sends gliding arrive."""
    action(viewer, *arguments)
    arrive(viewer)


def open_scene(viewer: Viewer, path: Path | str) -> None:
    """Open a scene, and wait until it is shown."""
    act(opening.open_scene, viewer, Path(path))


def ask(viewer: Viewer, *phrases: str) -> None:
    """Search for phrases, and wait for the answers; several are shown together."""
    viewer.put(adds=viewer.state.session.adds or len(phrases) > 1)
    for phrase in phrases:
        queries.ask(viewer, phrase)
    settle(viewer)


def recorded(viewer: Viewer) -> None:
    """Until the recorder has nothing left to do."""
    repeat(viewer.take_results, lambda: viewer.recorder.current is not None)
    viewer.take_results()


def arrive(viewer: Viewer) -> None:
    """Let a gliding camera arrive."""
    viewpoint.tick(viewer, viewer.clock + 2 * GLIDE_SECONDS)


def phrases(viewer: Viewer) -> list[str]:
    """Of the queries, in their order."""
    return [query.phrase for query in viewer.state.session.queries]


def result(viewer: Viewer, which: int = -1):
    """The result of a query of the list, with its threshold."""
    return viewer.state.result(viewer.state.session.queries[which])


def answer(viewer: Viewer, which: int = -1):
    """The answer to a query of the list."""
    return viewer.state.answer(viewer.state.session.queries[which])


def errors(viewer: Viewer) -> list[str]:
    return [message.text for message in viewer.state.messages if message.is_error]


CHANGES = {  # of what is seen, after a search
    "display": lambda v: settings.set_display(v, "depth"),
    "hidden query": lambda v: queries.show(v, v.state.session.queries[0].phrase, shown=False),
    "splats": lambda v: v.change(splats=Splats(0.5)),
    "near cut": lambda v: settings.set_clip(v, Clip(1.0)),
    "marks": editing.select_all,
    "size": lambda v: settings.resize(v, 100, 80),
    "view": lambda v: viewpoint.look_from(v, "left"),
}


def on_screen(canvas: Canvas) -> list[np.ndarray]:
    """Return (H, W, 3) bytes of each pane."""
    raw = [(np.frombuffer(texture.read(), np.uint8), texture.size) for texture in canvas.textures]
    return [pixels.reshape(height, width, 4)[::-1, :, :3] for pixels, (width, height) in raw]


def rest(canvas: Canvas, state: ViewerState, now: float) -> None:
    """Update until the fine picture is there, whoever rasterizes it."""
    repeat(lambda: None, lambda: canvas.update(state, now) and canvas.waits)


# The scene of three blobs: what is selected, hidden and deleted in it, and a flight around it.

STRAYS = 0.06  # of a blob, in a picture: what is nearer to the eye is farther from the middle


def blob(word: str) -> np.ndarray:
    """Return (360,) bool: the Gaussians of one blob."""
    return np.repeat([word == other for other in WORDS], PER_BLOB)


def means(viewer: Viewer) -> np.ndarray:
    return viewer.state.open.scene.gaussians.means


def put_scene(viewer: Viewer, scene: Scene) -> None:
    """Show another scene from where one is seen, if one is."""
    seen = viewer.state.open or OpenScene(Path("a.ply"), scene, scene, None, None)
    viewer.state.open = replace(seen, scene=scene)


def put_marks(viewer: Viewer, **masks: np.ndarray) -> None:
    """Mark nothing but the (N,) `selected`, `hidden` and `deleted` that are given."""
    viewer.put(marks=MarkBits().of(replace(unmarked(viewer.state.count), **masks)))


def names(rows: np.ndarray) -> str:
    """The blobs of which `rows` hold all but strays; "?" beside them where one is there in part."""
    shares = rows.reshape(len(WORDS), PER_BLOB).mean(1)
    whole = [word for word, share in zip(WORDS, shares, strict=True) if share >= 1 - STRAYS]
    partly = ["?"] if ((shares > STRAYS) & (shares < 1 - STRAYS)).any() else []
    return " ".join(whole + partly)


def marked(viewer: Viewer) -> tuple[str, str, str]:
    """Selected, hidden, deleted."""
    marks = viewer.state.marks
    return names(marks.selected), names(marks.hidden), names(marks.deleted)


def flight(away: float = 0.0) -> Flight:
    """A second around the blobs; `away`: turned by so much, radians, everything is behind the camera."""
    view = from_camera(blob_scene().cameras[0], extent_of(blob_scene()))
    keys = []
    for seconds, yaw in ((0.0, 0.0), (0.5, 0.2), (1.0, 0.5)):
        pose = pose_of(orbit(view, yaw, 0))
        if away:
            pose = replace(pose, rotation=pose.rotation * np.array([[-1.0], [1.0], [-1.0]]))
        keys.append(Keyframe(seconds, pose))
    return Flight(tuple(keys))

"""Which pictures the state asks for, and what they depend on."""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.config import Display, PictureConfig
from langsplat_core.display.displays import DISPLAYS, HeatRanges, compose
from langsplat_core.errors import BackendError
from langsplat_core.io.ply import SH_C0
from langsplat_core.progress import Progress, watched
from langsplat_core.query.answers import QueryResult
from langsplat_core.raster import load_rasterizer
from langsplat_core.scene import LEVELS, Camera, Gaussians, Scene
from langsplat_core.scene.gaussians import Merged, merged
from langsplat_viewer.camera.controls import OrbitCamera
from langsplat_viewer.drawing.channels import ArrayChannels, Clip, Layers, Sight, Splats, Split, drawn_scene
from langsplat_viewer.drawing.renderer import Rasterized, Rasterizing, Renderer
from langsplat_viewer.jobs import Worker
from langsplat_viewer.marks import Marks
from langsplat_viewer.state import ViewerState

# Which pictures the scene's area shows, and where. No window and no graphics device here.
#
# A picture beside another is the state as it would be if that were the only one: a copy in which another
# display is chosen. So whatever decides what a display shows holds for it too.

_AT_LEVEL: WeakKeyDictionary[QueryResult, tuple[QueryResult, ...]] = WeakKeyDictionary()


def shown_pictures(state: ViewerState) -> tuple[ViewerState, ...]:
    """From left to right, the state that each picture shows; only `state` itself where nothing is split."""
    split = state.seeing.split
    if split.mode == "wipe":
        return state, _with_display(state, split.second, split.second_level)
    if split.mode == "levels":
        return tuple(_with_level(state, level) for level in range(len(LEVELS)))
    return (state,)


def columns(split: Split) -> int:
    """In how many columns the area is divided; the two pictures of a wipe lie over each other."""
    return len(LEVELS) if split.mode == "levels" else 1


def picture_size(state: ViewerState) -> tuple[int, int]:
    """Of one picture, pixels; all have the same."""
    width, height = state.size
    return max(width // columns(state.seeing.split), 1), height


def within_picture(split: Split, u: float) -> float:
    """A place across the area, as a fraction of its width -> the same as a fraction of the picture there."""
    count = columns(split)
    return u * count - min(max(int(u * count), 0), count - 1)


def joined(split: Split, images: Sequence[Array]) -> Array:
    """(H, W, C) pictures of `pictures` -> one, as the area shows them."""
    if split.mode == "wipe" and len(images) > 1:
        line = round(split.at * images[0].shape[1])
        return np.concatenate([images[0][:, :line], images[1][:, line:]], 1)
    return np.concatenate(list(images), 1)


def labels(state: ViewerState) -> tuple[str, ...]:
    """What to write over each picture."""
    return tuple(_label(picture) for picture in shown_pictures(state))


def _label(picture: ViewerState) -> str:
    row = DISPLAYS[picture.picture.display]
    by_level = row.extra == "latent" or picture.seeing.split.mode == "levels"
    return f"{row.label}, {LEVELS[picture.latent_level]}" if by_level else row.label


def _with_display(state: ViewerState, display: Display, latent_level: int) -> ViewerState:
    shown = copy(state)
    shown.picture, shown.latent_level = replace(state.picture, display=display), latent_level
    return shown


def _with_level(state: ViewerState, level: int) -> ViewerState:
    asks = DISPLAYS[state.picture.display].needs_query
    shown = _with_display(state, "relevancy" if asks else "latent", level)
    if asks:
        shown.queries = [
            query if query.result is None else replace(query, result=at_level(query.result, level))
            for query in state.queries
        ]
    return shown


def at_level(result: QueryResult, level: int) -> QueryResult:
    """The same answer as if it were for another level; the same object whenever it is asked for. Its heat
    range stays, so that the same colour means the same relevancy at all levels."""
    if result not in _AT_LEVEL:
        _AT_LEVEL[result] = tuple(replace(result, level=index) for index in range(len(LEVELS)))
    return _AT_LEVEL[result][level]


# What the pictures on screen depend on, as one value. The canvas draws when it is another than the last;
# what the renderer has of it is handed over again where that part is another.
#
# Scenes, marks, answers and cameras count as equal only where they are the same objects, which the value
# holds: the id of one that is gone may be given to the next.


@dataclass(frozen=True)
class Model:
    """Which Gaussians are drawn, and how."""

    scene: Scene
    marks: Marks
    splats: Splats


@dataclass(frozen=True)
class Look:
    """What one picture shows of them."""

    layers: tuple[object, ...]  # `ViewerState.layers_key`
    picture: PictureConfig
    heat_ranges: HeatRanges


@dataclass(frozen=True)
class Depiction:
    """All of it."""

    model: Model
    clip: Clip
    view: OrbitCamera
    size: tuple[int, int]  # of each picture at rest, pixels
    looks: tuple[Look, ...]  # from left to right

    def is_placed_as(self, other: "Depiction") -> bool:
        """Whether one projection of the Gaussians serves both."""
        return replace(self, looks=()) == replace(other, looks=())


def depiction(state: ViewerState, shown: Sequence[ViewerState]) -> Depiction:
    """Of a state with a scene and a view; `shown` are its `splitting.pictures`."""
    assert state.scene is not None
    assert state.view is not None
    return Depiction(
        Model(state.scene, state.selection.marks, state.seeing.splats),
        state.seeing.clip,
        state.view,
        picture_size(state),
        tuple(Look(one.layers_key(), one.shown_picture(), one.heat_ranges()) for one in shown),
    )


# The scene as pictures show it: without what is hidden or deleted, and with the selection in its own colour.
#
# Renderers know nothing of marks: they draw another scene, which is made when the marks change and kept until
# they change again. Of a scene without marks it is the scene itself.

TINT = np.array([1.0, 0.15, 0.85], np.float32)  # unlike the colours of queries, and rare in photographs
STRENGTH = 0.6  # of the tint; the rest is the thing's own colour, so that its shape stays readable


@dataclass(frozen=True, eq=False)
class MarkedScene:
    """A scene and marks, and what is drawn for them."""

    source: Scene
    marks: Marks
    scene: Scene  # what is drawn, M Gaussians
    rows: Array | None  # (M,) int64 which of the source's they are; None: all
    selected: Array  # (M,) bool
    untinted: Scene  # of the same Gaussians, in their own colours

    def layer(self, values: Array | None, is_colour: bool = False) -> Array | None:
        """(N, C) values of the source's Gaussians -> (M, C) of those drawn; colours are tinted as theirs."""
        if values is None:
            return None
        taken: Array = values if self.rows is None else values[self.rows]
        if not is_colour or not self.selected.any():
            return taken
        mixed = np.array(taken, np.float32)
        mixed[self.selected] += STRENGTH * (TINT - mixed[self.selected])
        return mixed


def marked_scene(source: Scene, marks: Marks, before: MarkedScene | None = None) -> MarkedScene:
    """What is drawn of `source`. `before`, the last one made, is used as far as it fits: where only the
    selection changed, only colours are made anew. Marks for another number of Gaussians count as none."""
    if before is not None and before.source is source and before.marks is marks:
        return before
    if len(marks.selected) != len(source.gaussians):
        return MarkedScene(source, marks, source, None, np.zeros(len(source.gaussians), bool), source)
    rows, untinted = _shown(source, marks, before)
    selected = marks.selected if rows is None else marks.selected[rows]
    scene = tinted(untinted, selected) if selected.any() else untinted
    return MarkedScene(source, marks, scene, rows, selected, untinted)


def layers_of(state: ViewerState, marked: MarkedScene) -> Layers:
    """What one picture shows beside colours, of the Gaussians that are drawn."""
    return Layers(marked.layer(state.latent_rgb(), is_colour=True), marked.layer(state.relevancies()))


def _shown(source: Scene, marks: Marks, before: MarkedScene | None) -> tuple[Array | None, Scene]:
    if before is not None and before.source is source:
        last = before.marks
        if last.hidden is marks.hidden and last.deleted is marks.deleted:
            return before.rows, before.untinted
    shown = marks.shown
    if shown.all():
        return None, source
    rows = np.flatnonzero(shown)
    # Pictures need neither the language field nor what else a file holds.
    return rows, replace(source, gaussians=source.gaussians.take(rows), language=None, extras={})


def tinted(scene: Scene, selected: Array) -> Scene:
    """With the colours of the `selected` (N,) bool mixed with `TINT`, from every side: a colour is linear in
    its coefficients, so that mixing these mixes it, but for what is clamped at black."""
    sh = scene.gaussians.sh.copy()
    sh[selected] *= 1 - STRENGTH
    sh[selected, 0] += STRENGTH * (TINT - 0.5) / SH_C0
    return replace(scene, gaussians=replace(scene.gaussians, sh=sh))


# The fine picture of a large scene, rasterized on a thread of its own.


class Background:
    """Rasterizes one picture at a time: what is wanted now. What comes of others is dropped."""

    def __init__(self, clock: Callable[[], float]) -> None:
        """`clock` in seconds."""
        self.worker = Worker()
        self._clock = clock
        self._wanted: Rasterizing | None = None
        self._made: Rasterized | None = None
        self._problem = ""

    @property
    def waits(self) -> bool:
        """Whether something is wanted that has not been taken yet."""
        return self._wanted is not None

    def get(self, wanted: Rasterizing) -> Rasterized | None:
        """What came of it, once; None while it is being made, which this begins. Raises BackendError, once,
        where it failed."""
        if wanted != self._wanted:
            self.drop()
            self._wanted = wanted
            self.worker.submit("", self._work(wanted), self._keep, self._say)
        self.worker.poll()
        made, problem = self._made, self._problem
        if made is not None or problem:
            self.drop()
        if problem:
            raise BackendError(problem)
        return made

    def drop(self) -> None:
        """Nothing is wanted any more."""
        self.worker.cancel()
        self.worker.poll()  # so that nothing of a job that was left is held
        self._wanted, self._made, self._problem = None, None, ""

    def _work(self, wanted: Rasterizing) -> Callable[[Progress], Rasterized]:
        def work(report: Progress) -> Rasterized:
            began = self._clock()
            with watched() as laps:
                finish = wanted.work(report)
            return Rasterized(wanted, finish, 1e3 * (self._clock() - began), laps)

        return work

    def _keep(self, made: Rasterized) -> None:
        self._made = made

    def _say(self, problem: str) -> None:
        self._problem = problem


# What a renderer has been given: handed over when it changes, and only then.


class Stage:
    """One renderer and what it has: the scene, cuts and layers of a depiction."""

    def __init__(self, renderer: Renderer) -> None:
        self.renderer = renderer
        self._given: tuple[Depiction, Merged | None] | None = None
        self._layers: tuple[Layers, ...] = ()  # of each of its pictures

    def prepare(
        self,
        wanted: Depiction,
        shown: Sequence[ViewerState],
        marked: MarkedScene,
        camera: Camera,
        instead: Merged | None = None,
    ) -> list[Layers | None]:
        """Have the renderer ready to draw all pictures, the states `shown`; returns their layers,
        None for those that it has. `instead`: what is drawn in place of `marked.scene`, of which it was made.
        """
        self._hand_over(wanted, shown, marked, instead)
        if len(shown) > 1:
            self.renderer.prepare(camera, self._pictures(wanted))
        return self._own_layers()

    def ahead(
        self, wanted: Depiction, shown: Sequence[ViewerState], marked: MarkedScene, camera: Camera
    ) -> Rasterizing | None:
        """What of these pictures another thread can do; None where nothing is left of it."""
        self._hand_over(wanted, shown, marked, None)
        return self.renderer.ahead(camera, self._pictures(wanted))

    def _own_layers(self) -> list[Layers | None]:
        return [None, *self._layers[1:]]

    def _pictures(self, wanted: Depiction) -> list[tuple[PictureConfig, Layers | None]]:
        looks = [look.picture for look in wanted.looks]
        return list(zip(looks, self._own_layers(), strict=True))

    def let_go(self, scene: Scene) -> None:
        """Hold nothing of another scene than this one."""
        if self._given is not None and self._given[0].model.scene is not scene:
            self._given, self._layers = None, ()

    def _hand_over(
        self, wanted: Depiction, shown: Sequence[ViewerState], marked: MarkedScene, instead: Merged | None
    ) -> None:
        """What is another than what the renderer has; layers are kept, as their arrays stay the same objects
        while nothing changes."""
        given, self._given = self._given, None  # stays so if the renderer fails
        before = None if given is None or given[1] is not instead else given[0]
        is_new = before is None or before.model != wanted.model
        if is_new:
            self.renderer.set_scene(_scene_of(marked, wanted, instead))
        if before is None or before.clip != wanted.clip:
            self.renderer.set_clip(wanted.clip)
        kept = () if before is None else tuple(zip(before.looks, self._layers, strict=True))
        layers = tuple(
            kept[place][1]
            if place < len(kept) and kept[place][0].layers == look.layers
            else _layers_for(one, marked, instead)
            for place, (look, one) in enumerate(zip(wanted.looks, shown, strict=True))
        )
        if is_new or layers[0] is not self._layers[0]:
            self.renderer.set_layers(layers[0].latent_rgb, layers[0].relevancies)
        self._layers, self._given = layers, (wanted, instead)


def _scene_of(marked: MarkedScene, wanted: Depiction, instead: Merged | None) -> Scene:
    scene = marked.scene
    if instead is not None:
        scene = replace(scene, gaussians=instead.gaussians, language=None, extras={})
    return drawn_scene(scene, wanted.model.splats)


def _layers_for(state: ViewerState, marked: MarkedScene, instead: Merged | None) -> Layers:
    layers = layers_of(state, marked)
    if instead is None:
        return layers
    return Layers(instead.values(layers.latent_rgb), instead.values(layers.relevancies))


class Merger:
    """Merges the Gaussians of a scene on a thread of its own; nobody waits for it."""

    def __init__(self) -> None:
        self._worker = Worker()
        self._source: Gaussians | None = None  # whose merged scene is made, or is there
        self._made: Merged | None = None

    def want(self, gaussians: Gaussians) -> None:
        """Begin with these, unless that was done."""
        if self._source is gaussians:
            return
        self._worker.cancel()
        self._source, self._made = gaussians, None
        # Where it fails, for want of memory, pictures stay as they are.
        self._worker.submit("", lambda report: merged(gaussians, report), self._keep, lambda _: None)

    def _keep(self, made: Merged) -> None:
        self._made = made

    def made_of(self, gaussians: Gaussians) -> Merged | None:
        """What has been made of these, if it is ready."""
        self._worker.poll()
        return self._made if self._source is gaussians else None

    @property
    def is_running(self) -> bool:
        """Whether it is at work."""
        return self._worker.is_running

    def close(self) -> None:
        """Begin nothing more."""
        self._worker.close()


# The picture that is shown as the reference rasterizer draws it, in float64. No window here.

LONGEST_SIDE = 160  # pixels: the reference takes as long for more, but what is shown is drawn in the window


def small(state: ViewerState) -> ViewerState:
    """The same in a small window of the same shape."""
    factor = min(LONGEST_SIDE / max(state.size), 1.0)
    shown = copy(state)
    shown.size = max(round(state.size[0] * factor), 1), max(round(state.size[1] * factor), 1)
    return shown


def reference_of(state: ViewerState) -> Callable[[], Array]:
    """What draws the state as it is now, (H, W, C) uint8, whatever becomes of it: for another thread."""
    assert state.scene is not None
    assert state.view is not None
    shown = shown_pictures(state)
    marked = marked_scene(state.scene, state.selection.marks)
    scene = drawn_scene(marked.scene, state.seeing.splats)
    sight = Sight(scene, state.view.camera(*picture_size(state)), state.seeing.clip)
    pictures = [(one.shown_picture(), one.heat_ranges()) for one in shown]
    layers = [layers_of(one, marked) for one in shown]
    split = state.seeing.split

    def draw() -> Array:
        channels = ArrayChannels(load_rasterizer("reference"))
        wanted = [held.channel(picture) for held, (picture, _) in zip(layers, pictures, strict=True)]
        drawn = channels.render_all(sight, wanted)
        images = [compose(found, *look) for found, look in zip(drawn, pictures, strict=True)]
        return joined(split, images)

    return draw

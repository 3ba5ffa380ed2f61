"""What a renderer has been given: handed over when it changes, and only then."""

from collections.abc import Sequence
from dataclasses import replace

from langsplat_core.config import PictureConfig
from langsplat_core.scene import Camera, Gaussians, Scene
from langsplat_core.scene.merging import Merged, merged
from langsplat_viewer.drawing.channels import Layers
from langsplat_viewer.drawing.looking import drawn_scene
from langsplat_viewer.drawing.renderer import Rasterizing, Renderer
from langsplat_viewer.jobs import Worker
from langsplat_viewer.pictures.depiction import Depiction
from langsplat_viewer.pictures.marked_scene import MarkedScene, layers_of
from langsplat_viewer.state import ViewerState


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

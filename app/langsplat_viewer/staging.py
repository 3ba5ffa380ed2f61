"""What a renderer has been given: handed over when it changes, and only then."""

from collections.abc import Sequence
from dataclasses import replace

from langsplat_core.scene import Camera, Gaussians, Scene
from langsplat_core.scene.merging import Merged, merged
from langsplat_viewer.channels import Layers
from langsplat_viewer.jobs import Worker
from langsplat_viewer.looking import drawn_scene
from langsplat_viewer.marked_scene import MarkedScene, layers_of
from langsplat_viewer.renderer import Renderer
from langsplat_viewer.seeing import UNCLIPPED, Splats
from langsplat_viewer.state import ViewerState


class Stage:
    """One renderer and what it has."""

    def __init__(self, renderer: Renderer) -> None:
        self.renderer = renderer
        self.clip = UNCLIPPED
        self._scene: tuple[Scene | Merged, Splats] | None = None
        self._layers: list[tuple[tuple[object, ...], Layers | None]] = []  # of each picture, with their key

    def prepare(
        self,
        shown: Sequence[ViewerState],
        marked: MarkedScene,
        camera: Camera,
        instead: Merged | None = None,
    ) -> list[Layers | None]:
        """Have the renderer ready to draw all pictures; returns the layers of each. `instead`: what is drawn
        in place of `marked.scene`, of which it was made."""
        self._set_scene(marked, shown[0].seeing.splats, instead)
        if shown[0].seeing.clip != self.clip:
            self.clip = shown[0].seeing.clip
            self.renderer.set_clip(self.clip)
        self._set_layers(shown, marked, instead)
        layers = [layers for _, layers in self._layers]
        if len(shown) > 1:
            looks = [one.shown_picture() for one in shown]
            self.renderer.prepare(camera, list(zip(looks, layers, strict=True)))
        return layers

    def _set_scene(self, marked: MarkedScene, splats: Splats, instead: Merged | None) -> None:
        source = marked.scene if instead is None else instead
        if self._scene is not None and self._scene[0] is source and self._scene[1] == splats:
            return
        self._scene, self._layers = (source, splats), []
        scene = marked.scene
        if instead is not None:
            scene = replace(scene, gaussians=instead.gaussians, language=None, extras={})
        self.renderer.set_scene(drawn_scene(scene, splats))

    def _set_layers(self, shown: Sequence[ViewerState], marked: MarkedScene, instead: Merged | None) -> None:
        """Those of the first picture are the renderer's; those of the others are kept here, as their arrays
        stay the same objects while nothing changes."""
        del self._layers[len(shown) :]
        for place, one in enumerate(shown):
            if place < len(self._layers) and self._layers[place][0] == one.layers_key():
                continue
            layers: Layers | None = layers_of(one, marked)
            assert layers is not None
            if instead is not None:
                layers = Layers(instead.values(layers.latent_rgb), instead.values(layers.relevancies))
            if place == 0:
                self.renderer.set_layers(layers.latent_rgb, layers.relevancies)
                layers = None
            self._layers[place : place + 1] = [(one.layers_key(), layers)]


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

    def close(self) -> None:
        """Begin nothing more."""
        self._worker.close()

"""The scene as pictures show it: without what is hidden or deleted, and with the selection in its own colour.

Renderers know nothing of marks: they draw another scene, which is made when the marks change and kept until
they change again. Of a scene without marks it is the scene itself.
"""

from dataclasses import dataclass, replace

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.formats.inria_layout import SH_C0
from langsplat_core.scene import Scene
from langsplat_viewer.drawing.channels import Layers
from langsplat_viewer.marks.selecting import Marks
from langsplat_viewer.state import ViewerState

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

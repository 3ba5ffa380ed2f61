"""The photograph of a training camera over the picture of the scene, and the slider that fades it in."""

import moderngl
from imgui_bundle import ImVec2, imgui

from langsplat_core.arrays import Array
from langsplat_viewer import actions
from langsplat_viewer.files.photographs import corners
from langsplat_viewer.panels.area import Area
from langsplat_viewer.panels.style import leave_room, muted, small_wrapped, tip
from langsplat_viewer.viewer import Viewer


def draw_slider(viewer: Viewer) -> None:
    """How much of it is seen, and why it is not."""
    state = viewer.state
    leave_room("Photograph", 11)
    flags = imgui.SliderFlags_.always_clamp
    changed, fade = imgui.slider_float("Photograph", state.settings.fade, 0.0, 1.0, "%.2f", flags)
    if changed:
        actions.fade_photograph(viewer, fade)
    tip("Lay the photograph of the training camera over the picture")
    if state.settings.fade == 0:
        return
    photograph = actions.photograph_here(state)
    if photograph is None:
        small_wrapped("stand at a training camera to see its photograph", muted())
    elif photograph.reason:
        small_wrapped(photograph.reason, muted())
        if imgui.button("Folder of photographs ..."):
            actions.ask_for_photographs(viewer)


class Overlay:
    """Holds the photograph as a texture."""

    def __init__(self, ctx: moderngl.Context) -> None:
        self._ctx = ctx
        self._image: Array | None = None  # what the texture has
        self._texture: moderngl.Texture | None = None

    def draw(self, viewer: Viewer, area: Area) -> None:
        """Over every picture in the area, where one stands at its camera."""
        state = viewer.state
        photograph = actions.photograph_here(state)
        if state.settings.fade == 0 or photograph is None or photograph.image is None or state.view is None:
            return
        texture = self._upload(photograph.image)
        count = state.settings.split.columns
        width, paint = area.width / count, imgui.get_background_draw_list()
        shown = state.view.camera(max(round(width), 1), max(round(area.height), 1))
        left, top, right, bottom = corners(photograph.camera, shown)
        tint = imgui.get_color_u32((1.0, 1.0, 1.0, state.settings.fade))
        for column in range(count):
            x = area.left + column * width
            end = ImVec2(x + width, area.top + area.height)
            paint.push_clip_rect(ImVec2(x, area.top), end, True)
            low, high = ImVec2(x + left, area.top + top), ImVec2(x + right, area.top + bottom)
            reference = imgui.ImTextureRef(texture.glo)
            paint.add_image(reference, low, high, ImVec2(0, 0), ImVec2(1, 1), tint)
            paint.pop_clip_rect()

    def _upload(self, image: Array) -> moderngl.Texture:
        if self._texture is None or self._image is not image:
            if self._texture is not None:
                self._texture.release()
            height, width = image.shape[:2]
            texture = self._ctx.texture((width, height), 3, image.tobytes(), alignment=1)
            texture.build_mipmaps()
            texture.filter = moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR
            texture.repeat_x = texture.repeat_y = False
            self._texture, self._image = texture, image
        return self._texture

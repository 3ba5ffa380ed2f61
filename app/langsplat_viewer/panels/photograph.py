"""The photograph of a training camera over the picture of the scene, and the slider that fades it in."""

import moderngl
from imgui_bundle import ImVec2, imgui

from langsplat_core.arrays import Array
from langsplat_viewer import actions, staging
from langsplat_viewer.files.photographs import corners
from langsplat_viewer.panels.area import Area
from langsplat_viewer.viewer import Viewer


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
        if state.seeing.fade == 0 or photograph is None or photograph.image is None or state.view is None:
            return
        texture = self._upload(photograph.image)
        count = staging.columns(state.seeing.split)
        width, paint = area.width / count, imgui.get_background_draw_list()
        shown = state.view.camera(max(round(width), 1), max(round(area.height), 1))
        left, top, right, bottom = corners(photograph.camera, shown)
        tint = imgui.get_color_u32((1.0, 1.0, 1.0, state.seeing.fade))
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

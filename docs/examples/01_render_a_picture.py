"""Draw the bundled scene: once as a training camera sees it, once from a place of one's own.

    python docs/examples/01_render_a_picture.py [FOLDER]

`render` gives colours premultiplied by alpha, without a background; here they are laid on grey.
"""

import sys
from importlib.resources import files
from pathlib import Path

import numpy as np
from PIL import Image

from langsplat_core import Camera, Scene, load_scene, look_at, render


def save_picture(scene: Scene, camera: Camera, path: Path) -> None:
    seen = render(scene, camera)
    picture = seen.colours + 0.5 * (1 - seen.alpha[..., None])
    Image.fromarray((255 * np.clip(picture, 0, 1)).astype(np.uint8)).save(path)
    print(f"{path}: {camera.width} x {camera.height}, {seen.alpha.mean():.0%} covered")


def main() -> None:
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    out.mkdir(parents=True, exist_ok=True)
    scene = load_scene(Path(str(files("langsplat_assets"))) / "demo" / "scene.ply")
    save_picture(scene, scene.cameras[3].resized(320, 240), out / "photograph.png")
    photograph = scene.cameras[3]
    eye = 0.5 * (photograph.position + scene.cameras[5].position)  # world units
    own = look_at(eye, eye + photograph.rotation[2], scene.up(), (320, 240))  # row 2: the way it looks
    save_picture(scene, own, out / "own_place.png")


if __name__ == "__main__":
    main()

"""Ask the bundled scene for a phrase: is it there, where, how large, and how sure is the answer.

    python docs/examples/02_ask_a_phrase.py [FOLDER]

Relevancy is a number per Gaussian and level; drawn like a further colour channel, it is the heat map.
"""

import sys
from importlib.resources import files
from pathlib import Path

import numpy as np
from PIL import Image

from langsplat_core import QueryEngine, load_scene, load_text_encoder, render, run_phrase

LEVELS = ("subpart", "part", "whole")


def main() -> None:
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    out.mkdir(parents=True, exist_ok=True)
    scene = load_scene(Path(str(files("langsplat_assets"))) / "demo" / "scene.ply")
    engine = QueryEngine(scene, load_text_encoder)  # the encoder is loaded when a phrase first needs it
    for phrase in ("blue gift", "yellow banana"):
        answer = run_phrase(engine, phrase).answer
        verdict = "found" if answer.found else "not here"
        print(f"{phrase}: {verdict}, score {answer.peak:.2f}, level {LEVELS[answer.level]}")
        if answer.found and answer.place is not None:
            print(f"  place {np.round(answer.place, 2)}, world units")
            heat = answer.relevancy[answer.level][:, None]  # (N, 1)
            values = render(scene, scene.cameras[3].resized(320, 240), values=heat).values[..., 0]
            Image.fromarray((255 * np.clip(values, 0, 1)).astype(np.uint8)).save(out / "relevancy.png")


if __name__ == "__main__":
    main()

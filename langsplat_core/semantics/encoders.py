"""Image-text encoders by hub id, folder or file: a new family is one file and one row here."""

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType

from langsplat_core.errors import EncoderError
from langsplat_core.extras import optional_imports
from langsplat_core.semantics.encoder import OPEN_MODEL, Encoder, Family, PhraseEncoder
from langsplat_core.semantics.families.clip import CLIP
from langsplat_core.semantics.families.siglip import NAFLEX, SIGLIP
from langsplat_core.semantics.families.tips import TIPS
from langsplat_core.semantics.layouts import open_weights
from langsplat_core.semantics.weights import Weights, model_type, torch_device, weights_path

DEMO = "demo"
DEMO_ELSEWHERE = (
    "the demo encoder was made for drawn rooms, and this scene is not marked as one: on photographs its "
    "answers are guesses, without percentages. Real weights: "
    f"langsplat train DATASET --out scene.ply --clip.model {OPEN_MODEL}"
)
FAMILIES: Mapping[str, Family] = MappingProxyType(  # by `model_type` of config.json
    {"clip": CLIP, "siglip": SIGLIP, "siglip2": NAFLEX, "tipsv2": TIPS}
)


@optional_imports(EncoderError)
def load_text_encoder(model: str, device: str = "cpu") -> PhraseEncoder:
    """Load the text half of `model`: a folder, a file, a hub id, or "demo" for the bundled encoder.

    The device is the CPU unless told otherwise, because a phrase takes it a few milliseconds.
    Raises EncoderError where the weights are absent or are those of no family here.
    """
    weights = open_weights(model, model_path(model, "--encoder"), torch_device(device))
    return PhraseEncoder(weights, _family(weights).text(weights))


@optional_imports(EncoderError)
def load_encoder(model: str, device: str = "auto", batch: int = 32) -> Encoder:
    """Load both halves of `model`: a folder, a file, a hub id, or "demo" for the bundled encoder.

    batch: pictures per forward pass.
    Raises EncoderError where the weights are absent or are those of no family here.
    """
    weights = open_weights(model, model_path(model, "--clip.model"), torch_device(device))
    family = _family(weights)
    text = PhraseEncoder(weights, family.text(weights))
    return Encoder(text, family.pictures(weights), weights.device, batch)


def model_path(model: str, option: str) -> Path:
    """Where the files of `model` lie; `option` is what messages name, see `weights.weights_path`."""
    if model != DEMO:
        return weights_path(model, option)
    folder = Path(str(files("langsplat_assets") / "demo_encoder"))
    if not folder.is_dir():
        raise EncoderError(f"the bundled demo encoder is missing ({folder}); reinstall, or pass {option}")
    return folder


def _family(weights: Weights) -> Family:
    named = model_type(weights)
    if named not in FAMILIES:
        known = ", ".join(FAMILIES)
        raise EncoderError(
            f"{weights.id}: its {named!r} model is no image-text encoder known here; known are {known}"
        )
    return FAMILIES[named]

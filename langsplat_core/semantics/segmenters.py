"""Segmenters by hub id, folder or file: a new family is one file and one row here."""

from collections.abc import Callable, Mapping
from types import MappingProxyType

from langsplat_core.errors import EncoderError
from langsplat_core.semantics.families.sam import Sam, SamHq
from langsplat_core.semantics.families.sam2 import Sam2
from langsplat_core.semantics.layouts import open_weights
from langsplat_core.semantics.segmenter import Segmenter
from langsplat_core.semantics.weights import Weights, model_type, torch_device, weights_path

FAMILIES: Mapping[str, Callable[[Weights], Segmenter]] = MappingProxyType(  # by `model_type` of config.json
    {"sam": Sam, "sam2": Sam2, "sam2_video": Sam2, "sam_hq": SamHq}
)


def load_segmenter(model: str, device: str = "auto") -> Segmenter:
    """Load `model`: a folder in Hugging Face layout, a file of segment_anything or sam2, or a hub id.

    Raises EncoderError where the weights are absent or are those of no family here.
    """
    weights = open_weights(model, weights_path(model, "--masks.sam"), torch_device(device))
    named = model_type(weights)
    if named not in FAMILIES:
        known = ", ".join(FAMILIES)
        raise EncoderError(f"{model}: its {named!r} model is no segmenter known here; known are {known}")
    return FAMILIES[named](weights)

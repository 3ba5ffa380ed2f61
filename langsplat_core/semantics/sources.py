"""What finds masks, by name: a new source is one file and one row here."""

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Literal

from langsplat_core.config import MaskConfig
from langsplat_core.errors import InputError
from langsplat_core.semantics.masks import MaskSource


def _graph(config: MaskConfig, device: str) -> MaskSource:
    from langsplat_core.semantics.masks import GraphMasks  # scikit-image: a second

    return GraphMasks()


def _sam(config: MaskConfig, device: str) -> MaskSource:
    if not config.sam:
        raise InputError(
            "masks.source sam: name the weights too, such as `--masks.sam facebook/sam-vit-huge`"
        )
    from langsplat_core.semantics.sam import load_sam  # torch: seconds

    return load_sam(config, device)


MASK_SOURCES: Mapping[str, Callable[[MaskConfig, str], MaskSource]] = MappingProxyType(
    {"graph": _graph, "sam": _sam}
)


def load_mask_source(config: MaskConfig, device: Literal["auto", "cpu", "cuda"] = "auto") -> MaskSource:
    """The source that `config` asks for; "auto" is SAM where `config.sam` names weights, else the graph.

    Raises EncoderError where SAM's weights are absent, InputError where they are not named at all.
    """
    named = config.source if config.source != "auto" else ("sam" if config.sam else "graph")
    return MASK_SOURCES[named](config, device)

"""Finding and reading the weights of a model: a folder, a file, or a model of the Hugging Face hub."""

import json
import os
import pickle
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, TypeVar, cast, get_args

from langsplat_core import registry
from langsplat_core.config import Device
from langsplat_core.errors import EncoderError, expect
from langsplat_core.io.files import shown
from langsplat_core.io.hostile import FromFile

T = TypeVar("T")
CONFIG = "config.json"
SAFE = ["model.safetensors", "model-*.safetensors"]
PICKLED = ["pytorch_model.bin", "pytorch_model-*.bin"]  # transformers reads these with weights_only
OPEN_CLIP_CONFIG = "open_clip_config.json"
OPEN_CLIP = ["open_clip_model.safetensors", "open_clip_pytorch_model.bin"]  # either, the first is preferred


@dataclass(frozen=True, eq=False)
class Converted:
    """Weights of another layout with the names of transformers."""

    config: dict[str, Any]  # of config.json
    tensors: Mapping[str, Any]  # name -> torch.Tensor
    preprocessor: dict[str, Any]  # of preprocessor_config.json


@dataclass(frozen=True)
class Weights:
    """The files of a model, and the device that it runs on."""

    id: str  # hub id or folder, as the user gave it
    folder: Path  # with the weights, in Hugging Face layout unless `converted`, and the tokenizer
    device: str  # of torch: "cpu", "cuda:0"
    converted: Converted | None = None  # if they are in another layout than Hugging Face's


Layout = Callable[[str, Path], Converted | None]  # id for messages, file -> None for a file in another layout


def open_weights(model: str, path: Path, device: str) -> Weights:
    """Return the weights at a path from `weights_path`, for a device as `torch_device` takes it.

    Other layouts than Hugging Face's are read by extensions. EncoderError for a damaged or unknown file.
    """
    device = torch_device(device)
    if path.is_dir() and _is_hugging_face(path):
        return Weights(model, path, device)
    file = path if path.is_file() else next(path / name for name in OPEN_CLIP if (path / name).is_file())
    layouts: Mapping[str, Layout] = registry.parts("layouts")
    for layout in layouts.values():
        if (converted := layout(model, file)) is not None:
            return Weights(model, file.parent, device, converted)
    raise EncoderError(
        f"{model}: its weights are of no layout known here ({'; '.join(layouts) or 'none'}); for another "
        "model pass a folder or hub id in Hugging Face layout"
    )


def weights_path(model: str, option: str) -> Path:
    """Return the folder or file that holds `model`, downloaded if it is a hub id that is not cached.

    model: an existing folder or file, or a hub id "owner/name"; option: the setting to name in messages, such
    as "--clip.model". Existing paths are never looked up on the hub; with HF_HUB_OFFLINE set, or if the name
    comes from a file and not from the user, nothing is. Raises EncoderError that says what to pass or run.
    """
    expect(model, str | os.PathLike, "a folder, a file, a hub id, or demo")
    path, said = local_path(model), shown(model)
    if os.path.isfile(path):
        plain = any(path.match(pattern) for pattern in SAFE + PICKLED)
        return path.parent if plain and _is_hugging_face(path.parent) else path
    if os.path.isdir(path):
        if not _is_complete(path):
            raise EncoderError(
                f"{said}: no {CONFIG} with model.safetensors in this folder; {option} wants a model folder "
                f"in Hugging Face layout, or that of open_clip with {OPEN_CLIP_CONFIG} and {OPEN_CLIP[0]}"
            )
        return path
    if not re.fullmatch(r"[^./~][^/]*/[^/]+(?<!\.safetensors)(?<!\.bin)(?<!\.pt)(?<!\.pth)", model):
        raise EncoderError(f"{said}: no such file, no such folder; pass `{option} FOLDER`, a file, a hub id")
    return _from_hub(model, option)


def local_path(model: str) -> Path:
    """Return the path of `model` if it is a local one; names from files get no `~` and no network share."""
    if not isinstance(model, FromFile):
        return Path(os.path.expanduser(model))
    return Path(os.devnull if model[:2].replace("\\", "/") == "//" else model)


def _is_hugging_face(folder: Path) -> bool:
    return bool(weight_files(folder)) and (folder / CONFIG).is_file()


def _is_complete(folder: Path) -> bool:
    weights = any((folder / name).is_file() for name in OPEN_CLIP)
    return _is_hugging_face(folder) or (weights and (folder / OPEN_CLIP_CONFIG).is_file())


def _from_hub(model: str, option: str) -> Path:
    from huggingface_hub import constants, errors, snapshot_download

    offline, unasked = constants.HF_HUB_OFFLINE, isinstance(model, FromFile)
    reason = "HF_HUB_OFFLINE is set" if offline else "a scene's word fetches nothing"
    here_or_there = (True,) if offline or unasked else (True, False)
    for local_only, kind in product(here_or_there, (SAFE, PICKLED, OPEN_CLIP[:1], OPEN_CLIP[1:])):
        try:
            patterns = ["*.json", "*.txt", *kind]
            found = Path(snapshot_download(model, allow_patterns=patterns, local_files_only=local_only))
            if _is_complete(found):
                return found
            reason = reason if local_only else "it has no weights for transformers"
        except (OSError, ValueError, errors.HTTPError) as error:  # HTTPError of the hub's current client
            reason = reason if local_only else type(error).__name__
    supply, give = ("was not asked", shown(model)) if unasked else ("cannot supply it", "FOLDER")
    raise EncoderError(
        f"{shown(model)}: neither a folder nor in the local cache, and the hub {supply} ({reason}); "
        f"run `hf download {shown(model)}` where there is a network, or pass `{option} {give}`"
        + (", or `--clip.model demo` to try without weights" if option == "--clip.model" else "")
    )


def weight_files(folder: Path) -> list[Path]:
    """Return the files with a folder's weights: safetensors, else pickles, as transformers prefers them."""
    kinds = (sorted(path for pattern in kind for path in folder.glob(pattern)) for kind in (SAFE, PICKLED))
    return next(filter(None, kinds), [])


# Building a model. transformers fills parameters that the weights lack with random numbers, without an error.


def family_of(weights: Weights, families: Mapping[str, T], kind: registry.Kind) -> T:
    """Return the row for config.json's `model_type` in `families`, else the part `kind` of an extension."""
    if weights.converted:
        named = str(weights.converted.config["model_type"])
    else:
        try:
            settings = json.loads((weights.folder / CONFIG).read_text(encoding="utf-8"))
        except (OSError, ValueError, RecursionError) as error:
            raise EncoderError(f"{weights.id}: {CONFIG} cannot be read ({error})") from error
        named = str(settings.get("model_type", ""))[:40] if isinstance(settings, dict) else ""
    if named in families:
        return families[named]
    more = registry.references(kind)
    if named not in more:
        what, known = kind.replace("_", " "), ", ".join((*families, *more))
        raise EncoderError(f"{weights.id}: {named!r} is none of the {what} known here, which are {known}")
    return cast("T", registry.part(kind, named))


def load_config(kind: Any, weights: Weights, name: str) -> Any:
    """Return the configuration of `weights` as transformers' class `kind`; name: for messages."""
    with loading_errors(weights.id, name):
        if weights.converted:
            return kind.from_dict(deepcopy(weights.converted.config))
        _check_counts(weights.id, json.loads((weights.folder / CONFIG).read_text(encoding="utf-8")))
        return kind.from_pretrained(weights.folder, local_files_only=True)


# Largest allowed counts of parts, which would be built one by one for hours, and side of images in px.
_PARTS = ("num_hidden_layers", "blocks_per_stage", "iou_head_depth", "num_multimask_outputs")
LARGEST = {**dict.fromkeys((*_PARTS, "num_point_embeddings"), 512), "image_size": 1 << 14}


def _check_counts(id: str, settings: Any) -> None:
    """Raise EncoderError if a count in a configuration, or in a part of it, exceeds `LARGEST`."""
    for name, value in settings.items() if isinstance(settings, dict) else ():
        _check_counts(id, value)
        most = LARGEST.get(name)
        values = value if isinstance(value, list) else [value]
        if most and not all(isinstance(n, int) and 1 <= n <= most for n in values if n is not None):
            raise EncoderError(
                f"{id}: {CONFIG}: {name} is {json.dumps(value)[:40]}, which is not within 1 to {most}; take "
                "the file that belongs to the weights"
            )


def _check_size(kind: Any, weights: Weights, config: Any) -> None:
    """Raise EncoderError if a model of this configuration has more numbers than its files have bytes."""
    import torch

    with torch.device("meta"):
        asked = sum(parameter.numel() for parameter in kind(config).parameters())
    held = sum(path.stat().st_size for path in weight_files(weights.folder))
    if asked > held:
        raise EncoderError(
            f"{weights.id}: {CONFIG} states a model of {asked} numbers, its weights have {held} bytes; take "
            "the file that belongs to them"
        )


def load_model(kind: Any, weights: Weights, config: Any) -> Any:
    """Return a transformers model of class `kind` in float32 on the device of `weights`, for inference.

    Raises EncoderError if weights are missing or have another shape, if the folder has more layers than the
    model, and if converted weights have any unused tensors, as their deduced configuration may be wrong.
    """
    import torch

    options = {"local_files_only": True, "ignore_mismatched_sizes": True, "output_loading_info": True}
    with loading_errors(weights.id, kind.__name__):
        if not weights.converted:
            _check_size(kind, weights, config)
        source = None if weights.converted else weights.folder
        tensors = dict(weights.converted.tensors) if weights.converted else None
        model, report = kind.from_pretrained(
            source, config=config, state_dict=tensors, dtype=torch.float32, **options
        )
    wrong = sorted(report["missing_keys"]) or sorted(str(key[0]) for key in report["mismatched_keys"])
    if not wrong:
        halves = {name.partition(".")[0] for name in model.state_dict()}
        outer = f"{model.base_model_prefix}."  # prefix of a half's names if the whole model was saved
        more = (
            name
            for name in report["unexpected_keys"]
            if {name.partition(".")[0], name.removeprefix(outer).partition(".")[0]} & halves
        )
        layer = re.compile(r"(?:layers|blocks)\.\d+\.")
        wrong = sorted(name for name in more if weights.converted or layer.search(name))
    if wrong:
        raise EncoderError(f"{weights.id}: {len(wrong)} weights do not fit {kind.__name__}; one: {wrong[0]}")
    return model.eval().to(weights.device)


@contextmanager
def loading_errors(id: str, kind: str) -> Iterator[None]:
    """Silence transformers while it reads a folder, and turn its errors into EncoderError."""
    from huggingface_hub.errors import StrictDataclassError
    from transformers.utils import logging

    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity(logging.CRITICAL)
    logging.disable_progress_bar()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (EncoderError, MemoryError):
        raise
    except Exception as error:  # tokenizers raises no narrower class for a damaged file
        # Its own text only names the class; the reason is in its cause.
        told = (error.__cause__ or error) if isinstance(error, StrictDataclassError) else error
        # torch's own text advises to run the file.
        pickled = isinstance(error, pickle.UnpicklingError) or "weights_only" in str(error)
        reason = "a pickle that holds more than tensors, which is not run" if pickled else _first_line(told)
        raise EncoderError(f"{id}: not {kind} weights that can be loaded ({reason})") from error
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()


@contextmanager
def asking_errors(what: str) -> Iterator[None]:
    """Turn errors of inference into EncoderError: loading only compares sizes."""
    import torch

    try:
        yield
    except torch.OutOfMemoryError:
        raise
    except (TypeError, AttributeError, LookupError, ArithmeticError, ValueError, RuntimeError) as error:
        reason = _first_line(error)
        raise EncoderError(f"{what}: cannot be asked; does {CONFIG} belong to it? ({reason})") from error


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]


def torch_device(device: str) -> str:
    """Return the torch device of "auto", "cpu" or "cuda"; "auto" is the current CUDA device, if any."""
    if device == "cpu":
        return device  # without importing torch, which a small text encoder does not need
    if device not in get_args(Device):
        raise EncoderError(f"device {device}: choose one of {', '.join(get_args(Device))}")
    import torch

    if torch.cuda.is_available():
        return f"cuda:{torch.cuda.current_device()}"
    if device == "cuda":
        raise EncoderError("device cuda: PyTorch sees no CUDA device here; use `--clip.device cpu`")
    return "cpu"

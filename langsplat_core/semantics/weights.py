"""Finding and reading the weights of a model: a folder, a file, or a model of the Hugging Face hub."""

import json
import math
import pickle
import re
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from langsplat_core import registry
from langsplat_core.errors import EncoderError

CONFIG = "config.json"
SMALL_FILES = ["*.json", "*.txt"]
SAFE = ["model.safetensors", "model-*.safetensors"]
PICKLED = ["pytorch_model.bin", "pytorch_model-*.bin"]  # transformers reads these with weights_only
OPEN_CLIP_CONFIG = "open_clip_config.json"
OPEN_CLIP = ["open_clip_model.safetensors", "open_clip_pytorch_model.bin"]  # either, the first is preferred
FILES = (".safetensors", ".bin", ".pt", ".pth")  # what no hub id ends with
# What transformers, safetensors and torch raise for files that are no weights.
UNREADABLE = (
    *(OSError, ValueError, TypeError, LookupError, AttributeError, AssertionError, ImportError),
    *(RuntimeError, EOFError, pickle.PickleError, zipfile.BadZipFile, ArithmeticError),
)


@dataclass(frozen=True, eq=False)
class Converted:
    """Weights of another layout as transformers names them, see `layouts.open_weights`."""

    config: dict[str, Any]  # of config.json
    tensors: Mapping[str, Any]  # name -> torch.Tensor
    preprocessor: dict[str, Any]  # of preprocessor_config.json


@dataclass(frozen=True)
class Weights:
    """A model that was found, and where it shall run."""

    id: str  # hub id or folder, as it was asked for
    folder: Path  # in Hugging Face layout, or that of `converted`, with what lies beside the weights
    device: str  # of torch: "cpu", "cuda:0"
    converted: Converted | None = None  # where they are in another layout than Hugging Face's


Layout = Callable[
    [str, Path], Converted | None
]  # id for messages, file -> None where it is of another layout


def open_weights(id: str, path: Path, device: str) -> Weights:
    """Return the weights at `path`, a folder or a file that `weights_path` found.

    Other layouts than Hugging Face's are read by extensions. Raises EncoderError for a file that is damaged,
    or of no layout known here.
    """
    if path.is_dir() and is_hugging_face(path):
        return Weights(id, path, device)
    file = path if path.is_file() else next(path / name for name in OPEN_CLIP if (path / name).is_file())
    layouts: Mapping[str, Layout] = registry.parts("layouts")
    for layout in layouts.values():
        converted = layout(id, file)
        if converted is not None:
            return Weights(id, file.parent, device, converted)
    known = "; ".join(layouts) or "none"
    raise EncoderError(
        f"{id}: its weights are of no layout known here ({known}); for another model pass a folder or hub id "
        "in Hugging Face layout"
    )


def weights_path(model: str, option: str) -> Path:
    """Return the folder or file that holds `model`, downloaded when it is a hub id that is not cached yet.

    model: an existing folder or file, or a hub id "owner/name"; option: the setting to name in messages, such
    as "--clip.model". What exists is never looked up on the hub, and with HF_HUB_OFFLINE set nothing is.
    Raises EncoderError saying what to pass or to run.
    """
    path = Path(model).expanduser()
    if path.is_file():
        plain = any(path.match(pattern) for pattern in SAFE + PICKLED)
        return path.parent if plain and is_hugging_face(path.parent) else path
    if path.is_dir():
        if not _complete(path):
            raise EncoderError(
                f"{model}: no {CONFIG} with model.safetensors in this folder; {option} wants a model folder "
                f"in Hugging Face layout, or that of open_clip with {OPEN_CLIP_CONFIG} and {OPEN_CLIP[0]}"
            )
        return path
    if not _is_hub_id(model):
        raise EncoderError(
            f"{model}: no such file, no such folder; pass `{option} FOLDER`, a file or a hub id such as "
            "owner/name"
        )
    return _from_hub(model, option)


def _is_hub_id(model: str) -> bool:
    return (
        model.count("/") == 1 and not model.startswith((".", "~", "/")) and not model.endswith(("/", *FILES))
    )


def is_hugging_face(folder: Path) -> bool:
    """Return True where a folder holds weights and their configuration as transformers saves them."""
    weights = any(next(folder.glob(pattern), None) for pattern in SAFE + PICKLED)
    return weights and (folder / CONFIG).is_file()


def _complete(folder: Path) -> bool:
    weights = any((folder / name).is_file() for name in OPEN_CLIP)
    return is_hugging_face(folder) or (weights and (folder / OPEN_CLIP_CONFIG).is_file())


def _from_hub(model: str, option: str) -> Path:
    from huggingface_hub import constants, errors, snapshot_download

    reason = "HF_HUB_OFFLINE is set"
    for local_only in (True,) if constants.HF_HUB_OFFLINE else (True, False):
        for weights in (SAFE, PICKLED, OPEN_CLIP[:1], OPEN_CLIP[1:]):
            try:
                patterns = SMALL_FILES + weights
                found = snapshot_download(model, allow_patterns=patterns, local_files_only=local_only)
            except (OSError, ValueError, errors.HTTPError) as error:  # of whichever client the hub uses
                reason = reason if local_only else type(error).__name__
                continue
            if _complete(Path(found)):
                return Path(found)
            reason = reason if local_only else "it has no weights for transformers"
    raise EncoderError(
        f"{model}: neither a folder nor in the local cache, and the hub cannot supply it ({reason}); "
        f"run `hf download {model}` where there is a network, or pass `{option} FOLDER`"
    )


def model_type(weights: Weights) -> str:
    """Return the architecture that the folder's config.json names, "" where it names none.

    Raises EncoderError for a file that is no JSON.
    """
    if weights.converted:
        return str(weights.converted.config["model_type"])
    try:
        settings = json.loads((weights.folder / CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise EncoderError(f"{weights.id}: {CONFIG} cannot be read ({error})") from error
    return str(settings.get("model_type", ""))[:40] if isinstance(settings, dict) else ""


def load_config(kind: Any, weights: Weights, name: str) -> Any:
    """Return the configuration of `weights` as transformers' class `kind`.

    `name` is the family's in messages. Raises EncoderError where it cannot be read.
    """
    with loading_errors(weights.id, name):
        if weights.converted:
            return kind.from_dict(deepcopy(weights.converted.config))
        _check_counts(weights)
        return kind.from_pretrained(weights.folder, local_files_only=True)


# Names in config.json of the numbers of parts that are built one by one, each with tensors of its own.
COUNTS = frozenset({
    "num_hidden_layers", "blocks_per_stage", "iou_head_depth", "num_multimask_outputs",
    "num_point_embeddings",
})  # fmt: skip
LARGEST_IMAGE = 1 << 14  # pixels a side
_LAYER = re.compile(r"(?:layers|blocks)\.\d+\.")


def _check_counts(weights: Weights) -> None:
    """Raise EncoderError where config.json states more parts than the weights have tensors, or huge images.

    Building such parts could take hours, before anybody compares.
    """
    settings = json.loads((weights.folder / CONFIG).read_text(encoding="utf-8"))
    largest = dict.fromkeys(COUNTS, len(_shapes(weights))) | {"image_size": LARGEST_IMAGE}
    for name, value in _named_values(settings):
        values = value if isinstance(value, list) else [value]
        most = largest.get(name, 0)
        if most and not all(isinstance(n, int) and 1 <= n <= most for n in values if n is not None):
            raise EncoderError(
                f"{weights.id}: {CONFIG}: {name} is {json.dumps(value)[:40]}, its weights allow 1 to {most}; "
                "take the file that belongs to them"
            )


def _named_values(settings: Any) -> Iterator[tuple[str, Any]]:
    """Yield the name and value of every setting, part by part."""
    for name, value in settings.items() if isinstance(settings, dict) else ():
        yield from _named_values(value) if isinstance(value, dict) else ((name, value),)


def _check_size(kind: Any, weights: Weights, config: Any) -> None:
    """Raise EncoderError where a model of this configuration holds more numbers than its weights.

    transformers would fill memory with random ones, before anybody compares. The model is built on torch's
    meta device, where it takes no room.
    """
    import torch

    with torch.device("meta"):
        asked = sum(parameter.numel() for parameter in kind(config).parameters())
    held = sum(math.prod(shape) for shape in _shapes(weights).values())
    if asked > held:
        raise EncoderError(
            f"{weights.id}: {CONFIG} states a model of {asked} numbers, its weights have {held}; take the "
            "file that belongs to them"
        )


def _shapes(weights: Weights) -> dict[str, tuple[int, ...]]:
    """Return the shapes of all tensors of a folder, by name; of pickles without reading their numbers."""
    from safetensors import safe_open

    found: dict[str, tuple[int, ...]] = {}
    for path in _weight_files(weights.folder):
        if path.suffix == ".safetensors":
            with safe_open(path, framework="np") as file:
                found |= {name: tuple(file.get_slice(name).get_shape()) for name in file.keys()}  # noqa: SIM118
        else:
            found |= {name: tuple(tensor.shape) for name, tensor in unpickled(path).items()}
    return found


def _weight_files(folder: Path) -> list[Path]:
    """Return the files with a folder's weights: of both kinds the first, which transformers prefers, too."""
    for patterns in (SAFE, PICKLED):
        if paths := sorted(path for pattern in patterns for path in folder.glob(pattern)):
            return paths
    return []


def unpickled(path: Path) -> dict[str, Any]:
    """Return the tensors of a file of torch, by name, read when they are used where the file allows."""
    import torch

    mapped = zipfile.is_zipfile(path)  # files of PyTorch before 1.6 are none, and are read whole
    return torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)


def load_model(kind: Any, weights: Weights, config: Any) -> Any:
    """Return a transformers model of class `kind` in float32 on the device of `weights`, ready to be asked.

    Raises EncoderError where the folder lacks some of its weights or has them in another shape: transformers
    alone would fill those with random numbers. Nor may it have more layers than the model, and converted
    weights anything more: what was deduced from them may be wrong.
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
    if not wrong:  # a layer more, or of converted weights anything more
        halves = {name.partition(".")[0] for name in model.state_dict()}
        more = (name for name in report["unexpected_keys"] if name.partition(".")[0] in halves)
        wrong = sorted(name for name in more if weights.converted or _LAYER.search(name))
    if wrong:
        raise EncoderError(
            f"{weights.id}: not weights of {kind.__name__}: {len(wrong)} do not fit, such as {wrong[0]}"
        )
    return model.eval().to(weights.device)


def read_scalar(weights: Weights, name: str) -> float:
    """Read a number that is among the weights, without loading the rest of them; NaN where it is not there.

    Half a model (a text tower) has no place for what belongs to the pair, such as a logit scale.
    """
    from safetensors import safe_open

    value = math.nan
    with loading_errors(weights.id, "readable"):
        for path in _weight_files(weights.folder):
            if path.suffix == ".safetensors":
                with safe_open(path, framework="pt") as file:
                    tensor = file.get_tensor(name) if name in file.keys() else None  # noqa: SIM118
            else:
                tensor = unpickled(path).get(name)
            value = value if tensor is None else float(tensor)
    return value


@contextmanager
def loading_errors(id: str, kind: str) -> Iterator[None]:
    """While transformers reads a folder: nothing on the terminal, and one line in place of its tracebacks."""
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
        # Its own text names the class that complains; why it does stands in its cause.
        told = (error.__cause__ or error) if isinstance(error, StrictDataclassError) else error
        lines = str(told).strip().splitlines() or [type(error).__name__]
        # torch's own words advise to run the file.
        pickled = isinstance(error, pickle.UnpicklingError) or "weights_only" in str(error)
        reason = "a pickle that holds more than tensors, which is not run" if pickled else lines[0][:200]
        raise EncoderError(f"{id}: not {kind} weights that can be loaded ({reason})") from error
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()


@contextmanager
def asking_errors(what: str) -> Iterator[None]:
    """Turn the errors of asking a loaded model into EncoderError.

    Loading compares no more than sizes; whether a configuration fits its weights may show later.
    """
    import torch

    try:
        yield
    except torch.OutOfMemoryError:
        raise
    except (TypeError, AttributeError, LookupError, ArithmeticError, ValueError, RuntimeError) as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
        raise EncoderError(f"{what}: cannot be asked; does {CONFIG} belong to it? ({reason})") from error


def torch_device(device: str) -> str:
    """Device that "auto" means here: cuda where PyTorch sees one, else cpu.

    EncoderError for an absent device. By its number: which one is current is a matter of each thread.
    """
    if device == "cpu":
        return device  # without importing torch, which a small text encoder does without
    import torch

    if torch.cuda.is_available():
        return f"cuda:{torch.cuda.current_device()}"
    if device == "cuda":
        raise EncoderError("device cuda: PyTorch sees no CUDA device here; use `--clip.device cpu`")
    return "cpu"

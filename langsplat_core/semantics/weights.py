"""Finding and reading the weights of a model: a folder, or a model of the Hugging Face hub."""

import json
import pickle
import warnings
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from langsplat_core.errors import EncoderError

CONFIG = "config.json"
SMALL_FILES = ["*.json", "*.txt"]
SAFE = ["model.safetensors", "model-*.safetensors"]
PICKLED = ["pytorch_model.bin", "pytorch_model-*.bin"]  # transformers reads these with weights_only
# What transformers, safetensors and torch raise for files that are no weights.
UNREADABLE = (
    *(OSError, ValueError, TypeError, LookupError, AttributeError, AssertionError, ImportError),
    *(RuntimeError, EOFError, pickle.PickleError, zipfile.BadZipFile, ArithmeticError),
)


@dataclass(frozen=True)
class Weights:
    """A model that was found, and where it shall run."""

    id: str  # hub id or folder, as it was asked for
    folder: Path  # in Hugging Face layout
    device: str  # of torch: "cpu", "cuda"


def weights_folder(model: str, option: str) -> Path:
    """The folder that holds `model`, downloaded from the hub when it is a hub id that is not cached yet.

    model: an existing folder, or a hub id "owner/name"; option: the setting to name in messages, such as
    "--clip.model". A folder is never looked up on the hub, and with HF_HUB_OFFLINE set nothing is.
    Raises EncoderError saying what to pass or to run.
    """
    folder = Path(model).expanduser()
    if folder.is_dir():
        if not _complete(folder):
            raise EncoderError(
                f"{model}: no {CONFIG} with model.safetensors in this folder; {option} wants a model folder "
                "in Hugging Face layout"
            )
        return folder
    if not _is_hub_id(model):
        raise EncoderError(f"{model}: no such folder; pass `{option} FOLDER` or a hub id such as owner/name")
    return _from_hub(model, option)


def _is_hub_id(model: str) -> bool:
    return model.count("/") == 1 and not model.startswith((".", "~", "/")) and not model.endswith("/")


def _complete(folder: Path) -> bool:
    weights = any(next(folder.glob(pattern), None) for pattern in SAFE + PICKLED)
    return weights and (folder / CONFIG).is_file()


def _from_hub(model: str, option: str) -> Path:
    from huggingface_hub import constants, errors, snapshot_download

    reason = "HF_HUB_OFFLINE is set"
    for local_only in (True,) if constants.HF_HUB_OFFLINE else (True, False):
        for weights in (SAFE, PICKLED):
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
    """The architecture that the folder's config.json names, "" where it names none.

    Raises EncoderError for a file that is no JSON.
    """
    try:
        settings = json.loads((weights.folder / CONFIG).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise EncoderError(f"{weights.id}: {CONFIG} cannot be read ({error})") from error
    return str(settings.get("model_type", "")) if isinstance(settings, dict) else ""


def load_model(kind: Any, weights: Weights, config: Any) -> Any:
    """A transformers model of class `kind` in float32 on the device of `weights`, ready to be asked.

    Raises EncoderError where the folder lacks some of its weights or has them in another shape:
    transformers alone would fill those with random numbers.
    """
    import torch

    options = {"local_files_only": True, "ignore_mismatched_sizes": True, "output_loading_info": True}
    with loading_errors(weights.id, kind.__name__):
        model, report = kind.from_pretrained(weights.folder, config=config, dtype=torch.float32, **options)
    wrong = sorted(report["missing_keys"]) or sorted(str(key[0]) for key in report["mismatched_keys"])
    if wrong:
        raise EncoderError(
            f"{weights.id}: not weights of {kind.__name__}: {len(wrong)} do not fit, such as {wrong[0]}"
        )
    return model.eval().to(weights.device)


def read_scalars(weights: Weights, names: Iterable[str]) -> dict[str, float]:
    """Those of the named numbers that are among the weights, without loading the rest of them.

    Half a model (a text tower) has no place for what belongs to the pair, such as a logit scale.
    """
    with loading_errors(weights.id, "readable"):
        for patterns, read in ((SAFE, _safe_scalars), (PICKLED, _pickled_scalars)):
            paths = sorted(path for pattern in patterns for path in weights.folder.glob(pattern))
            if paths:  # transformers, too, prefers the first kind where both are there
                return {name: value for path in paths for name, value in read(path, tuple(names)).items()}
    return {}


def _safe_scalars(path: Path, names: tuple[str, ...]) -> dict[str, float]:
    from safetensors import safe_open

    with safe_open(path, framework="pt") as file:
        return {name: float(file.get_tensor(name)) for name in names if name in file.keys()}  # noqa: SIM118


def _pickled_scalars(path: Path, names: tuple[str, ...]) -> dict[str, float]:
    import torch

    mapped = zipfile.is_zipfile(path)  # files of PyTorch before 1.6 are none, and are read whole
    tensors = torch.load(path, map_location="cpu", weights_only=True, mmap=mapped)
    return {name: float(tensors[name]) for name in names if name in tensors}


@contextmanager
def loading_errors(id: str, kind: str) -> Iterator[None]:
    """While transformers reads a folder: nothing on the terminal, and one line in place of its tracebacks."""
    from safetensors import SafetensorError
    from transformers.utils import logging

    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity(logging.CRITICAL)
    logging.disable_progress_bar()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (*UNREADABLE, SafetensorError) as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        # torch's own words advise to run the file.
        pickled = isinstance(error, pickle.UnpicklingError) or "weights_only" in str(error)
        reason = "a pickle that holds more than tensors, which is not run" if pickled else lines[0][:200]
        raise EncoderError(f"{id}: not {kind} weights that transformers can load ({reason})") from error
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()


def torch_device(device: str) -> str:
    """What "auto" means here: cuda where PyTorch sees one, else cpu. EncoderError for an absent device."""
    if device == "cpu":
        return device  # without importing torch, which a small text encoder does without
    import torch

    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cuda" and not torch.cuda.is_available():
        raise EncoderError("device cuda: PyTorch sees no CUDA device here; use `--clip.device cpu`")
    return device

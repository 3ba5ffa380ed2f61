"""Finding the weights of an encoder: a folder, or a model of the Hugging Face hub."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from langsplat_core.errors import EncoderError

CONFIG = "config.json"
SMALL_FILES = ["*.json", "*.txt"]
SAFE = ["model.safetensors", "model-*.safetensors"]
PICKLED = ["pytorch_model.bin", "pytorch_model-*.bin"]  # transformers reads these with weights_only


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


def load_model(kind: Any, id: str, folder: Path, config: Any) -> Any:
    """A transformers model of class `kind` in float32, ready to be asked.

    Raises EncoderError where the folder lacks some of its weights or has them in another shape:
    transformers alone would fill those with random numbers.
    """
    import torch

    options = {"local_files_only": True, "ignore_mismatched_sizes": True, "output_loading_info": True}
    with loading_errors(id, kind.__name__):
        model, report = kind.from_pretrained(folder, config=config, dtype=torch.float32, **options)
    wrong = sorted(report["missing_keys"]) or sorted(str(key[0]) for key in report["mismatched_keys"])
    if wrong:
        raise EncoderError(
            f"{id}: not weights of {kind.__name__}: {len(wrong)} do not fit, such as {wrong[0]}"
        )
    return model.eval()


@contextmanager
def loading_errors(id: str, kind: str) -> Iterator[None]:
    """While transformers reads a folder: nothing on the terminal, and one line in place of its tracebacks."""
    from safetensors import SafetensorError
    from transformers.utils import logging

    level, bars = logging.get_verbosity(), logging.is_progress_bar_enabled()
    logging.set_verbosity(logging.CRITICAL)
    logging.disable_progress_bar()
    try:
        yield
    except (OSError, ValueError, TypeError, KeyError, RuntimeError, SafetensorError, EOFError) as error:
        lines = str(error).strip().splitlines() or [type(error).__name__]
        raise EncoderError(f"{id}: not {kind} weights that transformers can load ({lines[0]})") from error
    finally:
        logging.set_verbosity(level)
        if bars:
            logging.enable_progress_bar()


def torch_device(device: str) -> str:
    """What "auto" means here: cuda where PyTorch sees one, else cpu. EncoderError for an absent device."""
    import torch

    if device == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cuda" and not torch.cuda.is_available():
        raise EncoderError("device cuda: PyTorch sees no CUDA device here; use `--clip.device cpu`")
    return device

"""Optional packages: the extra of the distribution that brings each, and one line where one is missing."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType

from langsplat_core.errors import BackendError, LangSplatError

EXTRAS: Mapping[str, str] = MappingProxyType(  # name as imported -> extra, as in pyproject.toml
    {
        "torch": "train",
        "pycolmap": "train",
        "skimage": "train",
        "transformers": "encoders",
        "tokenizers": "encoders",
        "huggingface_hub": "encoders",
        "ftfy": "encoders",
        "open3d": "geometry",
        "matplotlib": "plots",
        "gsplat": "cuda",
    }
)


def remedy(package: str) -> str:
    """The command that installs a package of `EXTRAS`."""
    return f'pip install "langsplat-viewer[{EXTRAS[package]}]"'


@contextmanager
def optional_imports(error: type[LangSplatError] = BackendError) -> Iterator[None]:
    """Turn a failed import of a package of `EXTRAS`, in the body or in the function that this decorates, into
    `error` with the line that installs it."""
    try:
        yield
    except ModuleNotFoundError as missing:
        package = (missing.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        raise error(f"this needs {package}: {remedy(package)}") from None

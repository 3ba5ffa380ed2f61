"""Phrases as rows of token numbers of one length, by the tokenizer.json that lies beside the weights.

The file is read as it is, by the `tokenizers` library: what transformers' own classes add around it (which
side is padded, whether an end token is there) differs between its versions, and one needs SentencePiece.
"""

import html
import json
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Any

from langsplat_core.errors import EncoderError, InputError
from langsplat_core.semantics.weights import Weights

FILE = "tokenizer.json"
STATED_IN = ("tokenizer_config.json", "special_tokens_map.json")  # which token pads, which one ends
USUAL = {"eos_token": ("</s>", "<eos>"), "pad_token": ("<pad>", "</s>")}


@dataclass(frozen=True, eq=False)
class Tokens:
    """A tokenizer that always fills its rows."""

    tokenizer: Any  # tokenizers.Tokenizer
    length: int  # tokens per phrase
    pad: int
    end: int  # put behind every phrase

    @property
    def is_unigram(self) -> bool:
        """Whether it is of SentencePiece's unigram kind, as SigLIP's is and SigLIP 2's is not."""
        return type(self.tokenizer.model).__name__ == "Unigram"

    def rows(self, texts: list[str]) -> Any:
        """Return the (B, length) int64 tensor of token numbers. Raises as `check_whole`."""
        import torch

        ids = torch.full((len(texts), self.length), self.pad)
        for row, found in enumerate(self.tokenizer.encode_batch(texts, add_special_tokens=False)):
            check_whole(texts[row], found.ids, self.length - 1, {self.end})
            ids[row, : len(found.ids) + 1] = torch.tensor([*found.ids, self.end])
        return ids


def load_tokens(weights: Weights, length: int) -> Tokens:
    """Read the folder's tokenizer; EncoderError where it is absent or lacks tokens that pad and end."""
    path = weights.folder / FILE
    if not path.is_file():
        raise EncoderError(f"{weights.id}: no {FILE} in this folder, which its phrases are read with")
    tokenizer = read_tokenizer(weights)
    pad = _number(weights, tokenizer, "pad_token")
    return Tokens(tokenizer, length, pad, _number(weights, tokenizer, "eos_token"))


def text_cleaner() -> Callable[[str], str]:
    """What open_clip does to a text before its tokenizer reads it: broken Unicode is mended, curly quotes and
    ligatures are made plain, names of HTML replaced, spaces made single.

    The function raises InputError where no letter and no digit is left.
    """
    import ftfy

    def clean(text: str) -> str:
        plain = " ".join(html.unescape(html.unescape(ftfy.fix_text(text))).split())
        if not any(map(str.isalnum, plain)):
            raise InputError(f"empty phrase {text!r}: type a word or a few, such as 'red mug'")
        return plain

    return clean


def check_whole(text: str, ids: Sequence[int], room: int, ends: Collection[int]) -> None:
    """Refuse a phrase of which a model would not see all.

    ids: its tokens without those that begin and end a phrase; room: how many the model reads; ends: tokens
    that end a phrase, which some tokenizers give for every mark that they cannot read. Raises InputError for
    a phrase that is too long, EncoderError for one that would end early.
    """
    if len(ids) > room:
        raise InputError(
            f"'{text[:40]} ...' is too long: {len(ids)} tokens; this encoder reads {room}, so use fewer words"
        )
    if not set(ends).isdisjoint(ids):
        raise EncoderError(f"{text[:80]!r} holds marks that this encoder cannot read; use plain words")


def read_tokenizer(weights: Weights) -> Any:
    """The folder's `tokenizers.Tokenizer`, which neither cuts nor pads. EncoderError for a damaged file."""
    from tokenizers import Tokenizer

    try:
        tokenizer = Tokenizer.from_file(str(weights.folder / FILE))
        tokenizer.no_truncation()
        tokenizer.no_padding()
        return tokenizer
    except Exception as error:  # the library raises no narrower class for a damaged file
        reason = (str(error).splitlines() or ["unreadable"])[0]
        raise EncoderError(f"{weights.id}: {FILE} is no tokenizer ({reason})") from error


def _number(weights: Weights, tokenizer: Any, role: str) -> int:
    """The number of the token with a role: as the folder states it, else by its usual names."""
    stated = [_stated(weights, name, role) for name in STATED_IN]
    for token in (*stated, *USUAL[role]):
        number = None if token is None else tokenizer.token_to_id(token)
        if number is not None:
            return int(number)
    raise EncoderError(f"{weights.id}: its tokenizer has no {role}, such as {USUAL[role][0]}")


def _stated(weights: Weights, name: str, role: str) -> str | None:
    path = weights.folder / name
    try:
        token = json.loads(path.read_text(encoding="utf-8")).get(role)
    except (OSError, ValueError, AttributeError):
        return None
    content = token.get("content") if isinstance(token, dict) else token
    return content if isinstance(content, str) else None

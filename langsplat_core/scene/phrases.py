"""How phrases are written: the one place that says which marks of a text count, where one phrase ends and the
next begins, and when two of them are the same.

Quotes and punctuation around words are marks of writing and no part of a phrase: an encoder that met them
would answer another question, and the demo encoder's tokenizer would end the phrase there.
"""

import re
import unicodedata

_SEPARATE = re.compile(r"[;\n]|,(?!\s*(?:(?:but|and)\s+)?(?:not|without|except)\b)", re.IGNORECASE)
_APOSTROPHES = str.maketrans(dict.fromkeys("’‘ʼ′＇´`", "'"))


def split_phrases(text: str) -> list[str]:
    """The phrases in a line, tidy, separated by ";" or ","; "mug, not red" is one. Empty ones are left
    out."""
    return [part for part in (tidy(part) for part in _SEPARATE.split(text)) if part]


def tidy(text: str) -> str:
    """A phrase as it is shown: words without quotes and punctuation around them, single spaces; commas stay
    behind their words."""
    return " ".join(tokens(text)).replace(" ,", ",").lstrip(", ")


def phrase_key(text: str) -> str:
    """What a phrase is looked up and encoded by: its words, in lower case as CLIP's tokenizers have them."""
    return " ".join(token for token in tokens(text) if token != ",").lower()


def tokens(text: str) -> list[str]:
    """Words without quotes and punctuation around them, and commas, none at the end."""
    text = "".join(
        " " if unicodedata.category(mark) in ("Cc", "Cs") else mark for mark in text.translate(_APOSTROPHES)
    )
    text = re.sub(r"(?<=\w)\s+'s\b", "'s", text)
    found = []
    for piece in re.findall(r",|[^\s,;]+", text):
        word = "," if piece == "," else _bare(piece)
        if word:
            found.append(word)
    while found and found[-1] == ",":
        found.pop()
    return found


def _bare(word: str) -> str:
    """`word` without punctuation around it; a possessive's apostrophe stays. "" where it is nothing else."""
    if word == "&":
        return word
    kinds = [unicodedata.category(mark) for mark in word]
    marks = [kind[0] in "PZ" or kind == "Cf" for kind in kinds]
    if all(marks):
        return ""
    first, last = marks.index(False), len(marks) - marks[::-1].index(False)
    if all(kind in ("Cf", "Po", "Mn") for kind in kinds[first:last]):
        return ""
    owns = word[last : last + 1] == "'" and first == 0 and word[last - 1] == "s"
    return word[first:last] + ("'" if owns else "")

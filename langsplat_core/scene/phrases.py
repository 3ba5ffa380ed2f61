"""How phrases are written: the one place that says when two of them are the same."""


def tidy(text: str) -> str:
    """A phrase as it is shown: single spaces, none at the ends."""
    return " ".join(text.split())


def phrase_key(text: str) -> str:
    """What a phrase is looked up and encoded by: tidy, and in lower case as CLIP's tokenizers have it."""
    return tidy(text).lower()

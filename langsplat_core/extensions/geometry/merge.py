"""Two scenes in the same axes as one, with language field, cameras, tree and taught words."""

from dataclasses import fields, replace

import numpy as np

from langsplat_core.arrays import Array
from langsplat_core.errors import InputError
from langsplat_core.scene import LanguageField, Scene, Tree
from langsplat_core.scene.codec import LARGEST, CodebookCodec, Codec, principal_colours
from langsplat_core.scene.gaussians import join_gaussians
from langsplat_core.scene.language import NO_NODE


def merge(first: Scene, second: Scene) -> Scene:
    """Return the Gaussians of both, those of `first` first, and all that belongs to them.

    Gaussians of a scene without a language field get no meaning. Where both say something of the whole scene
    or of one word, `first` counts; properties that only one has are left out. Raises InputError where one
    image cannot be made of both, or one language field.
    """
    if first.antialiased != second.antialiased:
        raise InputError(
            "one scene was trained with antialiasing (Mip-Splatting) and the other without, so that no image "
            "is right for both; train one of them again"
        )
    shared = [
        name for name, values in first.extras.items()
        if name in second.extras and second.extras[name].dtype == values.dtype
    ]  # fmt: skip
    return Scene(
        join_gaussians([first.gaussians, second.gaussians]),
        _language(first, second),
        first.cameras + second.cameras,
        antialiased=first.antialiased,
        extras={name: np.concatenate([first.extras[name], second.extras[name]]) for name in shared},
        metres_per_unit=first.metres_per_unit or second.metres_per_unit,
        unread=first.unread + second.unread,
    )


def _language(first: Scene, second: Scene) -> LanguageField | None:
    known = first.language if first.language is not None else second.language
    if known is None:
        return None
    a = _meaningless(known, len(first.gaussians)) if first.language is None else first.language
    b = _meaningless(known, len(second.gaussians)) if second.language is None else second.language
    if a.encoder_id != b.encoder_id or a.codec.vector_dim != b.codec.vector_dim:
        raise InputError(
            f"their language fields are of two text encoders, {a.encoder_id} and {b.encoder_id}, and no "
            "phrase can be asked in both; train the field of one again with the other's encoder"
        )
    codec, latents = _one_codec(a, b)
    everyday = a.everyday if a.everyday is not None else b.everyday
    words = {word.key for word in a.taught}
    return replace(
        a,
        latents=latents,
        confidence=np.concatenate([a.confidence, b.confidence], axis=1),
        codec=codec,
        phrasebook={**b.phrasebook, **a.phrasebook},
        tree=None if a.tree is None or b.tree is None else _one_tree(a.tree, b.tree),
        everyday=everyday,
        taught=a.taught + tuple(word for word in b.taught if word.key not in words),
    )


def _meaningless(field: LanguageField, count: int) -> LanguageField:
    """Return a field of `count` Gaussians that mean nothing, in the way of `field`."""
    nothing = np.zeros(0, np.int32)
    empty = Tree(np.full(count, NO_NODE, np.int32), nothing, nothing.astype(np.uint8),
                 np.zeros((0, 2), np.uint16))  # fmt: skip
    return replace(
        field,
        latents=np.zeros((3, count, field.latents.shape[2]), field.latents.dtype),
        confidence=np.zeros((3, count), np.float32),
        tree=None if field.tree is None else empty,
    )


def _one_codec(a: LanguageField, b: LanguageField) -> tuple[Codec, Array]:
    """Return a codec of both fields, and the (3, N, d) latents of both in it."""
    mine, theirs = a.codec, b.codec
    both = np.concatenate
    if type(mine) is type(theirs) and _same(mine.tensors(), theirs.tensors()):
        return mine, both([a.latents, b.latents], axis=1)
    if not (isinstance(mine, CodebookCodec) and isinstance(theirs, CodebookCodec)):
        raise InputError(
            f"their language fields have two codecs, {mine.kind} and {theirs.kind}, fitted apart, and only "
            "codebooks can be joined; train both with --codec.kind codebook"
        )
    count = len(mine.vectors)
    if count + len(theirs.vectors) > LARGEST:
        raise InputError(
            f"codebooks of {count} and {len(theirs.vectors)} words are more than {LARGEST} together; train "
            "one of the scenes with a smaller --codec.size"
        )
    latents = both([a.latents, b.latents + np.uint16(count)], axis=1)
    vectors = both([mine.vectors, theirs.vectors])
    usage = np.bincount(latents[both([a.confidence, b.confidence], axis=1) > 0, 0], minlength=len(vectors))
    return CodebookCodec(vectors, principal_colours(vectors, usage)), latents


def _same(mine: dict[str, Array], theirs: dict[str, Array]) -> bool:
    return mine.keys() == theirs.keys() and all(np.array_equal(mine[name], theirs[name]) for name in mine)


def _one_tree(a: Tree, b: Tree) -> Tree:
    """Return the nodes of `a`, then those of `b`."""
    shifted = [np.where(row == NO_NODE, row, row + np.int32(a.count)) for row in (b.leaves, b.parents)]
    columns = {"leaves": shifted[0], "parents": shifted[1], "levels": b.levels, "votes": b.votes}
    names = [column.name for column in fields(Tree)]
    return Tree(**{name: np.concatenate([getattr(a, name), columns[name]]) for name in names})

"""How a PLY says that its Gaussians were trained with Mip-Splatting's compensation.

The PLY standard has no place for it, so programs write header comments. Known ones, in any case; of several
the last one counts, and a value that is none of these says no:

    SplatRenderMode: mip        Brush, PlayCanvas' splat-transform, gsplat; otherwise default or 2dgs
    antialiased 1               Postshot; otherwise 0
    train_flags antialiasing    proposed for the INRIA code
"""

COMMENT = "SplatRenderMode: mip"  # the commonest spelling, which `save_scene` writes


def antialiased_by_comments(comments: tuple[str, ...]) -> bool:
    """Whether the header's comments say so."""
    said = False
    for comment in comments:
        match comment.lower().replace(":", " ").split():
            case ["splatrendermode", mode, *_]:
                said = mode == "mip"
            case ["antialiased", value]:
                said = value == "1"
            case ["train_flags", *flags]:
                said = "antialiasing" in flags
    return said

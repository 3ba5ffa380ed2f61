"""A vocabulary of random phrases, for tests of what codecs lose."""

import numpy as np

from langsplat_core.arrays import unit
from langsplat_core.semantics.relevancy import Scale
from langsplat_core.training.language.codec_fit import Vocabulary


def random_vocabulary(dim: int, phrases: int = 20, seed: int = 9) -> Vocabulary:
    rng = np.random.default_rng(seed)
    made = unit(rng.normal(size=(phrases + 4, dim))).astype(np.float32)
    return Vocabulary(made[4:], Scale(made[:4], made[4:], 10.0))

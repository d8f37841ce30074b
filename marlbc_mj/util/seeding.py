"""One random stream per world, so that results depend on neither the number of worlds nor that of threads."""

import numpy as np


def stream(seed: int, world: int = 0) -> np.random.Generator:
    """The random stream of one world for a given seed.

    Args:
        seed: seed shared by all worlds.
        world: index of the world, from 0.
    """
    return np.random.default_rng(np.random.SeedSequence([seed, world]))

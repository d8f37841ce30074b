"""Random streams: one per world, so that results depend neither on the number of worlds nor on threads."""

import numpy as np


def stream(seed: int, world: int = 0) -> np.random.Generator:
    """The random stream of one world under a seed.

    Args:
        seed: seed of all worlds together.
        world: number of the world, from 0.
    """
    return np.random.default_rng(np.random.SeedSequence([seed, world]))

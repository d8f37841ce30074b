"""Random streams: one per seed and world, the same wherever an episode is drawn."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import Perturbation, paper
from marlbc_mj.util.seeding import stream

numbers = st.integers(0, 2**31 - 1)


@given(numbers, numbers, numbers)
def test_a_stream_is_its_seeds_and_its_worlds_own(seed, world, other):
    """Equal pairs of seed and world give equal numbers, other pairs different ones."""
    first = stream(seed, world).random(4)
    assert (first == stream(seed, world).random(4)).all()
    assert (seed, world) == (other, world) or (first != stream(other, world).random(4)).all()
    assert world == other or (first != stream(seed, other).random(4)).all()


def test_worlds_draw_their_episodes_from_it():
    """World b of a simulation draws from the stream of its seed and b."""
    scenario = paper(perturbation=Perturbation(start_spread=1.0, drag_scale=(0.5, 2.0)))
    expected = np.stack([scenario.draw(stream(7, b)).starts for b in range(3)])
    world = World(scenario, worlds=3)
    world.reset(7)
    np.testing.assert_array_equal(world.state.reference, expected)
    assert stream(7).random() == stream(7, 0).random()

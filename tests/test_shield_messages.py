"""Shields with late or lost messages: two agents share a live stamp at every moment, so they never touch."""

from itertools import product

import numpy as np
import pytest
from test_shield import Hostile, corridor, harass

from marlbc_mj.controllers import PD
from marlbc_mj.core.laws import plain
from marlbc_mj.core.shield import FORCE_BROKEN, STATE_BROKEN, Shield
from marlbc_mj.core.stamps import NEVER_STAMPED, NEWEST, OLDER, receive
from marlbc_mj.engine.world import World
from marlbc_mj.util.errors import ConfigurationError

START = (0.0, NEVER_STAMPED)
"""Initial live stamps, which both agents share: the newest and the older one."""
PLANE = np.zeros(3)


def received(live, message, fits):
    """Live stamps after a message (sent, newest), by the law that worlds run."""
    stamps = np.array(live)
    plain(receive)(stamps, np.zeros((2, 3)), *message, PLANE, PLANE, *fits)
    return tuple(stamps.tolist())


def hasty(live, message, fits):
    """A deliberately wrong law: as it proposes a stamp, it drops the shared one, one message too early."""
    return received(live, message, fits)[NEWEST], NEVER_STAMPED


def forgetful(live, message, fits):
    """Another wrong law: it takes any message from the other agent as a confirmation of its own newest stamp."""
    return received((live[NEWEST], NEVER_STAMPED), message, fits)


def on_the_way(messages, more):
    """Messages that may still arrive: the newest three under way, each of which may be lost, late or overtaken."""
    return frozenset(sorted({*messages, *more})[-3:])


def moves_of(state, law):
    """Yield all states that one event leads to: both send, or one receives a message, inside its planes or not.

    A state is (time, live stamps of both, messages on the way to each). A message that is never received is lost.
    """
    time, live, boxes = state
    sent = [(time, live[1 - who][NEWEST]) for who in range(2)]
    yield time + 1.0, live, tuple(on_the_way(box, [one]) for box, one in zip(boxes, sent, strict=True))
    for who in range(2):
        for message in boxes[who]:
            rest = tuple(box - {message} if k == who else box for k, box in enumerate(boxes))
            for fits in product((True, False), repeat=2):
                after = law(live[who], message, fits)
                yield time, tuple(after if k == who else stamps for k, stamps in enumerate(live)), rest


def explore(law, last):
    """Try every order of events up to the time ``last``; return the number of states and the first without a shared stamp."""
    start = (0.0, (START, START), (frozenset(), frozenset()))
    seen, open_states = {start}, [start]
    while open_states:
        state = open_states.pop()
        live = [{stamp for stamp in stamps if stamp != NEVER_STAMPED} for stamps in state[1]]
        if not live[0] & live[1]:
            return len(seen), state
        for after in moves_of(state, law):
            if after not in seen and after[0] <= last:
                seen.add(after)
                open_states.append(after)
    return len(seen), None


def test_whatever_is_late_lost_or_overtaken_both_share_a_live_stamp():
    """It holds for every order of send, lose, deliver, adopt, confirm and propose up to a depth, with at most two live stamps."""
    states, broken = explore(received, last=4.0)
    assert broken is None
    assert states > 4_000


@pytest.mark.parametrize("wrong", [hasty, forgetful])
def test_a_stamp_that_is_dropped_too_early_is_found(wrong):
    """The same search finds a state without a shared stamp."""
    assert explore(wrong, last=4.0)[1] is not None


def test_stamps_move_on_where_messages_arrive():
    """Safety alone would not require it: keeping the first stamp forever is safe too."""
    one, other = START, START
    for time in range(1, 50):
        one, other = (
            received(one, (time - 1.0, other[NEWEST]), (True, True)),
            received(other, (time - 1.0, one[NEWEST]), (True, True)),
        )
    assert min(*one, *other) > 40.0 or (one[OLDER] == NEVER_STAMPED and min(one[NEWEST], other[NEWEST]) > 40.0)


MAILS = {
    "late": Shield(latency=0.05),
    "lost": Shield(message_loss=0.6),
    "late and lost": Shield(latency=0.1, message_loss=0.3),
    "one silent": Shield(latency=0.01, silent=2),
    "all lost": Shield(message_loss=1.0),
}


@pytest.mark.parametrize("mail", MAILS.values(), ids=MAILS)
def test_nothing_is_hit_whatever_messages_do(mail):
    """It holds in MuJoCo at every substep, under a hostile supervisor and a hostile disturbance."""
    scenario = corridor(disturbance=Hostile())
    world = World(scenario, PD(), record=True, shield=mail)
    clearance, distance = harass(world, steps=120, seed=1)
    assert clearance > scenario.safe_distance
    assert distance > 2.0 * world.plan.robot.radius
    assert world.state.breaches.sum() == 0
    assert (world.state.interventions > 0).any()


def test_compiled_and_python_worlds_exchange_the_same_messages():
    """Both run the same source; lost messages are drawn from the world's seed."""
    shield = Shield(latency=0.01, message_loss=0.4)
    worlds = [World(corridor(), PD(), record=True, shield=shield, native=native) for native in (True, False)]
    for world in worlds:
        harass(world, steps=6)
    for name in ("position", "stamps", "planes", "breaches"):
        np.testing.assert_array_equal(getattr(worlds[0].state, name), getattr(worlds[1].state, name))
    assert worlds[0].state.stamps[0, 0, 1, NEWEST] > 0.0
    assert worlds[0].state.breaches[..., (FORCE_BROKEN, STATE_BROKEN)].sum() == 0


def test_messages_that_cannot_be_are_refused():
    """The error names the wrong number."""
    for wrong, said in (
        ({"latency": 0.003}, "latency of 0.003 s must be a whole multiple"),
        ({"silent": 7}, r"silent must be -1 \(none\) or 0 to 3, got 7"),
    ):
        with pytest.raises(ConfigurationError, match=said):
            World(corridor(), PD(), shield=Shield(**wrong))
    with pytest.raises(ConfigurationError, match=r"message_loss must be from 0 to 1, got 1.5"):
        Shield(message_loss=1.5)

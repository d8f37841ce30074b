"""Small runs of the commands that test a shield."""

import numpy as np
import pytest

from marlbc_mj.controllers import PD
from marlbc_mj.core.lookout import LISTED
from marlbc_mj.core.stopping import ForceBound
from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import make_scenario
from marlbc_mj.studies.shield_kernel import exact_share, kernel_shares
from marlbc_mj.studies.shield_missions import mission_of, report_missions, run_missions

DRAG = float(np.sqrt(2.0))


@pytest.mark.parametrize("bound", [ForceBound(), ForceBound(linear=5.0 * DRAG), ForceBound(20.0, 1.0)], ids=str)
def test_the_safe_set_is_in_the_viability_kernel_and_nearly_all_of_it(bound):
    """It holds on a coarse grid and in closed form; without a disturbance both sets are the same."""
    found = kernel_shares(bound, nodes=61)
    assert found.outside == 0
    assert found.worst > -0.025
    assert 0.95 < exact_share(bound) <= 1.0 + 1e-6
    assert found.share == pytest.approx(exact_share(bound), abs=0.05)
    if bound == ForceBound():
        assert exact_share(bound) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("family", ["field", "exchange"])
def test_no_mission_fails_with_a_shield_and_some_do_without(family):
    """This runs a few seconds of a few missions, half of them attacked."""
    scenario = mission_of(family, 4, seconds=4.0)
    shielded, free = (run_missions(scenario, 4, seed=11, shield=shield) for shield in (True, None))
    assert (shielded.missions, shielded.failed, shielded.breaches.sum()) == (4, 0, 0.0)
    assert shielded.interventions > 0
    assert free.failed > 0


SCRATCH_OF_A_SHIELD = {"grid": (1, 0), "looked": (1, 0, 3), "around": (1, 0, 1 + LISTED)}
"""Parts of a team's state that only save time, and their shapes when empty."""


LOOK_OUT = ("looked", "around")


@pytest.mark.parametrize(("agents", "missing"), [(48, ("grid",)), (48, ("grid", *LOOK_OUT)), (48, LOOK_OUT), (5, LOOK_OUT)])
def test_a_team_is_shielded_by_grids_and_a_look_out_as_by_trying_all_pairs(agents, missing):
    """Results are identical to the last bit: both only find out early that nothing is near."""
    large = {"radius": (0.3, 0.6), "gap": 2.5, "length": 140.0} if agents == 48 else {}
    scenario = make_scenario("field", agents=agents, formation="grid", obstacles=agents, **large)
    worlds = [World(scenario, PD(), record=True, shield=True) for _ in range(2)]
    for name in missing:
        assert getattr(worlds[0].state, name).size > 0
    worlds[1].state = worlds[1].state._replace(
        **{name: np.zeros(SCRATCH_OF_A_SHIELD[name], getattr(worlds[1].state, name).dtype) for name in missing}
    )
    worlds[1]._hand_over()
    for name in missing:
        assert getattr(worlds[1]._loop.arguments.team, name).size == 0  # in the loop's own arguments
    rng = np.random.default_rng(0)
    for step in range(30):
        together = worlds[0].state.position.mean(axis=1, keepdims=True) - worlds[0].state.position
        velocity = 2.0 * together + 15.0 * rng.normal(size=(1, agents, 2)) / (1 + step % 3)
        for world in worlds:
            world.step(np.zeros((1, agents), dtype=np.int64), velocity)
    for name in ("position", "velocity", "interventions", "force_change", "breaches"):
        np.testing.assert_array_equal(getattr(worlds[0].state, name), getattr(worlds[1].state, name))
    assert worlds[0].state.interventions.sum() > 0


def test_the_report_bounds_the_rate_of_failures(capsys):
    """It has a row per family and size, then the bound 3 / n."""
    report_missions(["--missions", "2", "--seconds", "1", "--agents", "2", "--families", "field,open"])
    said = capsys.readouterr().out
    assert "| field | 2 | 2 | 0 | 0 |" in said
    assert "4 missions among obstacles at rest, none failed: rate at most 0.75 at 95 %" in said


def test_a_team_without_room_is_passed_over(capsys):
    """The report gives the reason; other teams are flown."""
    report_missions(["--missions", "1", "--seconds", "0.5", "--agents", "64,2", "--families", "corridor"])
    said = capsys.readouterr().out
    assert "corridor, 64 agents, not run: scenario 'corridor' is infeasible" in said
    assert "| corridor | 2 | 1 | 0 | 0 |" in said

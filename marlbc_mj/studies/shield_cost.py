"""Time cost of shield and set-based composition: ratios of a mission step at 4, 16 and 64 agents, in turns in one process.

``python -m marlbc_mj.studies.shield_cost [ROUNDS]``. Every agent flies OA>AA>FM in a grid formation among as many discs. *Far*
has no obstacle and a formation so wide that nothing is ever within reach: what the shield's early exit costs. A team with a
shield flies elsewhere than one without, where a mission step may cost another time: so the last ratios are those of mission steps
that begin in the same states, from all over a mission with a shield. Times are those of the processor, on one thread, so that
other programs change them little.
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from statistics import median
from time import process_time
from typing import Any

import numpy as np

from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import Scenario, make_scenario
from marlbc_mj.studies.scale import mission
from marlbc_mj.studies.timing import check_rounds, interleaved, ratio

COST_SIZES = (4, 16, 64)
BURST_AGENT_STEPS = 4096  # agents x mission steps in one burst
STATES_APART = 20  # mission steps between two states that both begin in
STEPS_EACH = 4  # mission steps from each state
REPEATS = 5  # of which the fastest counts
COST_VARIANTS = {
    "plain": ("null-space", False),
    "shield": ("null-space", True),
    "set-based": ("set-based", False),
    "set-based, shield": ("set-based", True),
}
"""Composition, and whether there is a shield."""


class CostTeam:
    """Worlds of one size and variant; a finished mission starts again."""

    def __init__(self, scenario: Scenario, shield: bool) -> None:
        agents = scenario.agents
        self.world = World(scenario, worlds=max(1, COST_SIZES[-1] // agents), shield=shield)
        self.orders = np.full((self.world.worlds, agents), scenario.orders.index("OA>AA>FM"))
        self.steps = max(1, BURST_AGENT_STEPS // (self.world.worlds * agents))

    def advance(self, steps: int | None = None) -> None:
        """Mission steps, or one burst."""
        for _ in range(self.steps if steps is None else steps):
            if self.world.state.steps[0] >= self.world.scenario.mission_steps:
                self.world.reset()
            self.world.advance(self.orders)

    def changed(self) -> float:
        """Share of agent substeps that the shield has changed since the mission began."""
        state, substeps = self.world.state, self.world.scenario.substeps
        total = state.interventions.size * max(1, int(state.steps[0])) * substeps
        return float(state.interventions.sum() / total) if total else 0.0


def far_mission(agents: int) -> Scenario:
    """Nothing is ever near: no obstacle, and slots 60 m apart."""
    return make_scenario("open", agents=agents, formation="grid", spacing=60.0, column_spacing=60.0, agent_distance=2.5)


def ratio_on_same_states(scenario: Scenario) -> float:
    """Time of a mission step with a shield, divided by that without one, over states along a mission with a shield."""
    shielded, free = CostTeam(scenario, True), CostTeam(scenario, False)
    least: dict[CostTeam, float] = {shielded: 0.0, free: 0.0}
    for _ in range(0, scenario.mission_steps - max(STATES_APART, STEPS_EACH), STATES_APART):
        state = shielded.world.snapshot()
        taken: dict[CostTeam, list[float]] = {shielded: [], free: []}
        for _ in range(REPEATS):
            for team in (shielded, free):
                put_in_state(team.world, state)
                began = process_time()
                team.advance(STEPS_EACH)
                taken[team].append(process_time() - began)
        for team, times in taken.items():
            least[team] += min(times)
        put_in_state(shielded.world, state)
        shielded.advance(STATES_APART)
    return least[shielded] / least[free]


def put_in_state(world: World, state: Mapping[str, np.ndarray]) -> None:
    """Restore a snapshot, but for what the world has no room for: the counts of a shield that it lacks."""
    own = world.snapshot()
    world.restore({name: state[name] if state[name].shape == own[name].shape else own[name] for name in own})


def measure_costs(rounds: int, sizes: tuple[int, ...] = COST_SIZES) -> dict[int, dict[str, Any]]:
    """By size: ratios to the plain mission step, its time [us] per agent, and the share of substeps that shields changed.

    Raises:
        ConfigurationError: fewer than 5 rounds.
    """
    check_rounds(rounds)
    found: dict[int, dict[str, Any]] = {}
    for agents in sizes:
        scenario = mission(agents)
        set_based = replace(scenario, composition="set-based")
        near = {
            name: CostTeam(set_based if composition == "set-based" else scenario, shield)
            for name, (composition, shield) in COST_VARIANTS.items()
        }
        far = {name: CostTeam(far_mission(agents), COST_VARIANTS[name][1]) for name in ("plain", "shield")}
        teams = {**near, **{f"far, {name}": team for name, team in far.items()}}
        actions: dict[Any, Callable[[], None]] = {name: partial(team.advance) for name, team in teams.items()}
        taken = interleaved(actions, rounds, process_time)
        ratios = {name: ratio(taken[name], taken["plain"]) for name in COST_VARIANTS}
        ratios["far, shield"] = ratio(taken["far, shield"], taken["far, plain"])
        ratios["shield, same states"] = ratio_on_same_states(scenario)
        ratios["set-based, shield, same states"] = ratio_on_same_states(set_based)
        team = near["plain"]
        per_step = 1e6 * median(taken["plain"]) / (team.steps * team.world.worlds * agents)
        found[agents] = {"ratios": ratios, "us": per_step, "changed": near["shield"].changed()}
    return found


def report_costs() -> None:
    """Print the ratios."""
    costs = measure_costs(int(sys.argv[1]) if len(sys.argv) > 1 else 15)
    for agents, cost in costs.items():
        ratios = ", ".join(f"{name} {value:.3f}" for name, value in cost["ratios"].items())
        print(f"{agents} agents: plain {cost['us']:.1f} us per agent and mission step; {ratios}; ", end="")
        print(f"shield changed {100 * cost['changed']:.2f} % of the substeps")
    for name in COST_VARIANTS:
        first, last = (costs[n]["us"] * costs[n]["ratios"][name] for n in (COST_SIZES[0], COST_SIZES[-1]))
        print(f"{name}: per agent {last / first:.3f} times from {COST_SIZES[0]} to {COST_SIZES[-1]} agents")


if __name__ == "__main__":
    report_costs()

"""Time cost of the shield and of the set-based composition: ratios of a mission step's time at 4, 16 and 64 agents.

Run ``python -m marlbc_mj.studies.shield_cost [ROUNDS]``. All agents are under OA>AA>FM in a grid formation among one disc per
agent, and variants take turns in one process. *Far* has no obstacles and a formation so wide that nothing is ever within reach,
which isolates the cost of the shield's early exit. A team with a shield takes another path than one without, on which a mission
step may take a different time. So the last ratios compare mission steps from the same states, sampled over a mission with a
shield. Times are processor times on one thread, so that other programs affect them little.
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
STATES_APART = 20  # mission steps between two states that both teams start from
STEPS_EACH = 4  # mission steps timed from each state
REPEATS = 5  # runs from each state; the fastest counts
COST_VARIANTS = {
    "plain": ("null-space", False),
    "shield": ("null-space", True),
    "set-based": ("set-based", False),
    "set-based, shield": ("set-based", True),
}
"""The composition, and whether there is a shield, of each variant."""


class CostTeam:
    """Worlds of one size and variant; a finished mission starts again."""

    def __init__(self, scenario: Scenario, shield: bool) -> None:
        agents = scenario.agents
        self.world = World(scenario, worlds=max(1, COST_SIZES[-1] // agents), shield=shield)
        self.orders = np.full((self.world.worlds, agents), scenario.orders.index("OA>AA>FM"))
        self.steps = max(1, BURST_AGENT_STEPS // (self.world.worlds * agents))

    def advance(self, steps: int | None = None) -> None:
        """Run ``steps`` mission steps; one burst by default."""
        for _ in range(self.steps if steps is None else steps):
            if self.world.state.steps[0] >= self.world.scenario.mission_steps:
                self.world.reset()
            self.world.advance(self.orders)

    def changed(self) -> float:
        """Share of agent substeps in which the shield has changed a force since the mission began."""
        state, substeps = self.world.state, self.world.scenario.substeps
        total = state.interventions.size * max(1, int(state.steps[0])) * substeps
        return float(state.interventions.sum() / total) if total else 0.0


def far_mission(agents: int) -> Scenario:
    """A mission in which nothing is ever near: no obstacles, and slots 60 m apart."""
    return make_scenario("open", agents=agents, formation="grid", spacing=60.0, column_spacing=60.0, agent_distance=2.5)


def ratio_on_same_states(scenario: Scenario) -> float:
    """Ratio of a mission step's time with a shield to that without, from the same states along a mission with a shield."""
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
    """Restore a snapshot, except entries of another shape: the shield counts of a world without a shield."""
    own = world.snapshot()
    world.restore({name: state[name] if state[name].shape == own[name].shape else own[name] for name in own})


def measure_costs(rounds: int, sizes: tuple[int, ...] = COST_SIZES) -> dict[int, dict[str, Any]]:
    """By team size: ratios to the plain mission step, its time per agent [us], and the share of substeps that the shield changed.

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
    """Print the ratios for every team size."""
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

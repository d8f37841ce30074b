"""A supervisor of your own: the column while an obstacle is near some agent, else the wide formation.

It also runs from the command line: marlbc run paper --composition set-based --supervisor own_supervisor.py:Careful
"""

from dataclasses import dataclass

import numpy as np

from marlbc_mj import World, measure, paper, run_episode


@dataclass(frozen=True)
class Careful:
    """FR while the least clearance of the team is below ``near``, else FM."""

    near: float = 6.0  # [m]

    def start(self, scenario):
        """Memory of one episode: the indices of the two orders."""
        return scenario.orders.index("FM"), scenario.orders.index("FR")

    def decide(self, observation, memory):
        """One order for every agent, and the memory for the next decision."""
        wide, column = memory
        order = column if observation.clearance.min() < self.near else wide
        return np.full(len(observation.clearance), order), memory


if __name__ == "__main__":
    scenario = paper(duration=30.0, composition="set-based")
    metrics = measure(run_episode(World(scenario, record=True), Careful()))
    print("return", metrics["team"]["return"], "switches", [agent["switches"] for agent in metrics["agents"]])

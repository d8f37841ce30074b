"""Write your own supervisor: form the column while any agent is near an obstacle, and the wide formation otherwise.

It also runs from the command line: marlbc run paper --composition set-based --supervisor own_supervisor.py:Careful
"""

from dataclasses import dataclass

import numpy as np

from marlbc_mj import World, measure, paper, run_episode


@dataclass(frozen=True)
class Careful:
    """Choose FR (column) while the team's least clearance is below ``near``, and FM (formation) otherwise."""

    near: float = 6.0  # [m]

    def start(self, scenario):
        """Called at the start of an episode; returns its memory, here the indices of the two orders."""
        return scenario.orders.index("FM"), scenario.orders.index("FR")

    def decide(self, observation, memory):
        """Return one order per agent, and the memory for the next decision."""
        wide, column = memory
        order = column if observation.clearance.min() < self.near else wide
        return np.full(len(observation.clearance), order), memory


if __name__ == "__main__":
    scenario = paper(duration=30.0, composition="set-based")
    metrics = measure(run_episode(World(scenario, record=True), Careful()))
    print("return", metrics["team"]["return"], "switches", [agent["switches"] for agent in metrics["agents"]])

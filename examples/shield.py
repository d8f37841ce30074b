"""Run the same supervisor with and without a shield, a filter that keeps every agent able to stop in time."""

from marlbc_mj import World, make_supervisor, measure, paper, run_episode

for shield in (False, True):
    world = World(paper(duration=75.0), record=True, shield=shield)
    agents = measure(run_episode(world, make_supervisor("fsams")))["agents"]
    name = "with" if shield else "without"
    print(f"{name} a shield: {sum(agent['violation_time'] for agent in agents):.2f} s of violation")

"""Compare two supervisors on held-out obstacle layouts of the family "field": how often does each succeed?

The same comparison from the command line, with tables and confidence intervals:
marlbc evaluate field --composition set-based --supervisors fixed lookahead --seeds 200 --out DIR
"""

from marlbc_mj import World, make_scenario, make_supervisor, measure, run_episode
from marlbc_mj.results.outcomes import outcome
from marlbc_mj.scenarios import held_out

LAYOUTS = 2
scenario = held_out(make_scenario("field", composition="set-based"))
for name in ("fixed", "lookahead"):
    flights = [run_episode(World(scenario, record=True), make_supervisor(name), seed=seed) for seed in range(LAYOUTS)]
    won = [outcome(measure(flight), scenario).success for flight in flights]
    print(f"{name}: {sum(won)} of {LAYOUTS} layouts")

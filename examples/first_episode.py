"""Run one episode: the first 20 s of the paper's case study, with its scripted supervisor and its controller."""

from marlbc_mj import Scripted, World, measure, paper, run_episode

trajectory = run_episode(World(paper(duration=20.0), record=True), Scripted())
metrics = measure(trajectory)
print("return", metrics["team"]["return"])
print("least clearance of each agent [m]", [round(agent["clearance_min"], 2) for agent in metrics["agents"]])

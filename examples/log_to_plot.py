"""Write an episode to an MCAP log, read it back, and plot each agent's clearance from the nearest obstacle."""

import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from marlbc_mj import paper, read_log
from marlbc_mj.studies.episodes import EpisodeJob, fly_or_fail

with tempfile.TemporaryDirectory() as folder:
    fly_or_fail(EpisodeJob(paper(duration=20.0), "scripted", "sorlc", seed=0), Path(folder))
    (log,) = Path(folder).rglob("*.mcap")
    episode = read_log(log)
    figure, axes = plt.subplots(figsize=(6.0, 2.5), layout="constrained")
    axes.plot(episode.time, episode.clearance, label=[f"agent {i + 1}" for i in range(episode.clearance.shape[1])])
    axes.axhline(episode.safe_distance, linestyle="--", color="black", label="safe distance")
    axes.set(xlabel="time [s]", ylabel="clearance [m]", ylim=(0.0, 12.0))
    axes.legend(ncols=5, fontsize="small")
    figure.savefig(Path(folder) / "clearance.png")
    print("least clearance [m]", round(float(episode.clearance.min()), 2))

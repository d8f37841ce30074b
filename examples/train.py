"""Train MARLMS briefly and fly the learned policy. For a full training run: marlbc train marlms --out runs/mine"""

import tempfile
from pathlib import Path

from marlbc_mj import World, paper, run_episode
from marlbc_mj.supervisors.learned import Learned
from marlbc_mj.training.config import make_config
from marlbc_mj.training.run import train

with tempfile.TemporaryDirectory() as folder:
    run = Path(folder) / "run"
    train(make_config("fast", budget=4_000, evaluate_every=4_000, worlds=64, capacity=7_000, hidden=(16,), threads=1), run)
    supervisor = Learned.load(run / "checkpoint" / "best.safetensors")
    trajectory = run_episode(World(paper(duration=10.0), record=True), supervisor)
    print("return of the first 10 s", trajectory.reward.sum())

"""The measuring command measures: a smoke run with small bursts. The figures themselves are the machine's."""

import numpy as np
import pytest

from marlbc_mj import perf
from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import paper


def test_a_small_run_has_every_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    """All keys of the file's schema, positive and finite, and lines that show them."""
    for name, value in {"BATCH": 2, "BATCHES": (1, 2), "BURST": 40, "PYTHON_STEPS": 1}.items():
        monkeypatch.setattr(perf, name, value)
    monkeypatch.setattr(perf, "paper", lambda: paper(duration=2.0))
    figures = perf.measure_perf(rounds=5)
    physics = figures["physics_steps_per_s"]
    assert set(physics) == {"bare_mj_step", "closed_loop", "python_loop", "python_loop_compiled_laws"}
    rates = [*physics["bare_mj_step"].values(), *physics["closed_loop"].values(), physics["python_loop"]]
    rates += [rate for batch in figures["mission_steps_per_s"].values() for rate in batch.values()]
    assert np.isfinite(rates).all()
    assert min(rates) > 0
    assert figures["episode_s"] > 0
    assert figures["record_s"] > 0
    assert len(perf.perf_lines(figures)) >= 12


def test_a_fleet_is_spread_over_the_mission() -> None:
    """Its worlds stand at different times of the same episode: each equals a single world run that far."""
    scenario = paper(duration=5.0)
    orders = perf.scripted_orders(scenario)
    fleet = perf.Fleet(scenario, 4, 1, orders)
    steps = fleet.world.state.steps
    assert len(set(steps.tolist())) == 4
    single = World(scenario)
    for k in range(int(steps.max())):
        for b in np.flatnonzero(steps == k):
            np.testing.assert_array_equal(fleet.world.state.position[b], single.state.position[0])
        single.step(orders[k][None])

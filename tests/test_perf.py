"""Smoke tests of the performance measurements with short bursts. The measured values depend on the machine."""

from threading import Thread

import numpy as np
import pytest

from marlbc_mj.engine.world import World
from marlbc_mj.policies.general import decision_steps
from marlbc_mj.policies.general_inputs import make_sight
from marlbc_mj.scenarios import paper
from marlbc_mj.studies import decision_times, perf, perf_episode, perf_training
from marlbc_mj.training import trainer
from marlbc_mj.training.config import TrainConfig, make_config

PARTS = {"simulation", "state", "action_values", "exploration", "replay", "rest"}


def small(threads: int) -> TrainConfig:
    """The configuration of a training run with few worlds."""
    return make_config(
        "fast",
        threads=threads,
        interval=10,
        worlds=8,
        hidden=(8,),
        batch=16,
        updates=1,
        capacity=1_000,
        start_length=2.0,
        hash="plain",
    )


@pytest.mark.slow
def test_a_small_run_has_every_figure(monkeypatch: pytest.MonkeyPatch) -> None:
    """All figures of the file's schema exist, are positive and finite, and are printed."""
    small_numbers = {"BATCH": 2, "BATCHES": (1, 2), "BURST": 40, "PYTHON_STEPS": 1, "SUPERVISED_WORLDS": 2, "SUPERVISED_STEPS": 3}
    for name, value in small_numbers.items():
        monkeypatch.setattr(perf, name, value)
    for module in (perf, perf_episode):
        monkeypatch.setattr(module, "paper", lambda: paper(duration=2.0))
    monkeypatch.setattr(perf_training, "make_scenario", lambda name: paper(duration=10.0))
    monkeypatch.setattr("marlbc_mj.training.base.make_scenario", lambda name: paper(duration=10.0))
    monkeypatch.setattr(perf_training, "training_config", small)
    monkeypatch.setattr(trainer, "WARM_UP", 64)
    for name, value in {"WORLDS": 4, "DECISIONS": 2, "PROFILED": 10}.items():
        monkeypatch.setattr(perf_training, name, value)
    figures = perf.measure_perf(rounds=5)
    physics = figures["physics_steps_per_s"]
    assert set(physics) == {"bare_mj_step", "closed_loop", "python_loop", "python_loop_compiled_laws"}
    rates = [*physics["bare_mj_step"].values(), *physics["closed_loop"].values(), physics["python_loop"]]
    rates += [rate for batch in figures["mission_steps_per_s"].values() for rate in batch.values()]
    assert set(figures["supervised_steps_per_s"]) == {"alone", *perf.SUPERVISED}
    rates += figures["supervised_steps_per_s"].values()
    for key in ("environment_mission_steps_per_s", "training_mission_steps_per_s"):
        assert set(figures[key]) == set(physics["bare_mj_step"])
        rates += figures[key].values()
    assert np.isfinite(rates).all()
    assert min(rates) > 0
    assert set(figures["loop_parts_us"]) == {perf.BARE, *perf.LOOP_PARTS}
    assert np.isfinite(list(figures["loop_parts_us"].values())).all() and figures["loop_parts_us"][perf.BARE] > 0
    assert figures["episode_s"] > 0
    assert figures["record_s"] > 0
    for threads, shares in figures["training_profile"].items():
        assert set(shares) == PARTS | ({"updates"} if threads == "1" else {"waiting"})
        assert min(shares.values()) > 0
        assert sum(shares.values()) == pytest.approx(1.0)
        aside = figures["training_profile_aside"][threads]
        assert set(aside) == (set() if threads == "1" else {"updates", "replay"})
        assert sum(aside.values()) <= 1.0
    for taken in figures["decision_us"].values():
        assert 0 < taken["median"] <= taken["p99"]
    assert figures["decision_us"]["decision_step"]["median"] > figures["decision_us"]["all_mission_steps"]["median"]
    assert figures["ratios"]["training_over_environment_1"] > 0
    assert len(perf.perf_lines(figures)) >= 26


def test_only_the_innermost_part_is_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Time in parts that call each other is counted once, and the object gets its own class back."""

    class Work:
        def outer(self) -> None:
            self()

        def __call__(self) -> None:
            pass

    now = iter(range(100))
    monkeypatch.setattr(perf_training, "perf_counter", lambda: float(next(now)))  # one second between any two calls
    clock, work = perf_training.PartClock(), Work()
    with clock.timing(work, ("outer",), "a"), clock.timing(work, ("__call__",), "b"):
        work.outer()
        other = Thread(target=work)
        other.start()
        other.join()
    assert clock.seconds == {"rest": 1.0, "a": 2.0, "b": 1.0}
    assert clock.aside == {"b": 1.0}
    assert type(work) is Work


def test_a_profile_leaves_training_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """Training gives the same numbers with and without the profile's clock."""
    monkeypatch.setattr(trainer, "WARM_UP", 64)
    one, other = trainer.Trainer(small(1)), trainer.Trainer(small(1))
    for run in (one, other):
        perf_training.warm_up(run)
    perf_training.profile(one, 3)
    for _ in range(3):
        other.advance()
    np.testing.assert_array_equal(one.state, other.state)
    assert one.error == other.error != 0.0
    assert type(one.batch.world) is World


def test_exploring_starts_end_at_different_times() -> None:
    """All ends are in the future and none is later than before; whole missions are unchanged."""
    batch = trainer.Trainer(make_config("fast", threads=1, worlds=32, capacity=1_000)).batch
    before = batch.cut
    perf_training.spread(batch, np.random.default_rng(0))
    whole = before == batch.scenario.mission_steps
    assert (batch.cut[whole] == before[whole]).all()
    assert (batch.cut <= before).all()
    assert (batch.cut > batch.world.state.steps).all()
    assert len(set((before - batch.cut)[~whole].tolist())) > 5


def test_a_fleet_is_spread_over_the_mission() -> None:
    """Its worlds are at different times of the same episode; each equals a single world run to that time."""
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


def test_decision_times_are_of_every_step_and_of_decisions(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Mean, median and time per decision of a supervisor that takes 1 ms per decision and nothing in between."""
    scenario, clock = paper(duration=10.0), [0.0]
    every = decision_steps(scenario, make_sight(scenario))

    class Slow:
        def start(self, scenario, teams):
            return 0

        def decide(self, observation, step):
            clock[0] += 1e-3 * (step % every == 0)
            return np.zeros(observation.command.shape, dtype=np.int64), step + 1

    monkeypatch.setattr(decision_times, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(decision_times, "make_supervisor", lambda name: Slow())
    monkeypatch.setattr(decision_times, "TIMED_DECISIONS", 3)
    for name in ("MISSION_FAMILIES", "TEAM_SIZES"):
        monkeypatch.setattr(decision_times, name, getattr(decision_times, name)[:1])
    monkeypatch.setattr(decision_times, "timed_mission", lambda family, agents: scenario)
    times = decision_times.per_mission_step("field", 1)["lookahead"]
    assert (
        times.mean == pytest.approx(((scenario.mission_steps - 1) // every) / (scenario.mission_steps - 1))
        and times.median == 0.0
        and times.longest_hundredth == pytest.approx(1.0)
    )
    assert decision_times.per_decision(4, 1) == pytest.approx(1.0)
    monkeypatch.setattr("sys.argv", ["decision_times", "1"])
    decision_times.report_times()
    said = capsys.readouterr().out
    assert "field, Look-ahead: mean 0.0" in said and "4 agents in a field: a decision takes 1.000 ms" in said

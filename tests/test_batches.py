"""Draws flown together: each gives the same as alone, to the last bit, and a draw that fails does not affect the others."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from marlbc_mj.controllers import make_controller
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.results.metrics import measure
from marlbc_mj.results.seeds import SeedRun
from marlbc_mj.scenarios import Scenario, held_out, make_scenario, paper
from marlbc_mj.scenarios.layout import Sample
from marlbc_mj.studies.batches import MOST_TOGETHER, RECORD_BYTES, Flown, draws_together, evaluate_batch, fly_side_by_side
from marlbc_mj.studies.draws import perturbed
from marlbc_mj.supervisors import Blend, FixedPriority, make_supervisor
from marlbc_mj.util.errors import ConfigurationError, SimulationError
from marlbc_mj.util.seeding import stream

CLOCK = ("decision_ms_median", "decision_ms_p99")
SEEDS = (70_000, 70_001, 3)


def without_clock(metrics: Any) -> Any:
    """All metrics except decision times."""
    return metrics["agents"], {key: value for key, value in metrics["team"].items() if key not in CLOCK}


def alone(scenario: Scenario, supervisor: Any, seed: int, *, controller: str = "sorlc", shield: bool = False) -> Any:
    """Metrics of one draw flown alone, without decision times."""
    world = World(scenario, make_controller(controller), record=True, shield=shield)
    return without_clock(measure(run_episode(world, supervisor, seed=seed)))


@pytest.mark.parametrize(
    ("mission", "supervisor", "composition", "shield"),
    [
        ("field", "set-based-rule", "null-space", False),
        ("gates", "lookahead", "set-based", True),
        ("traffic", "rollout", "set-based", False),
        ("traffic", "orca", "null-space", False),
        ("corridor", "mpcms", "null-space", False),
        ("paper", "fsams", "null-space", True),
        ("paper", "marlms", "null-space", False),
    ],
)
def test_a_draw_gives_the_same_with_others_and_alone(mission: str, supervisor: str, composition: str, shield: bool) -> None:
    """Together and alone, a draw has the same layout and the same metrics of agents and team, except decision times."""
    scenario = make_scenario(mission, duration=2.0)
    scenario = perturbed(scenario) if mission == "paper" else held_out(scenario)
    runs = evaluate_batch(scenario, SEEDS, supervisor, composition=composition, shield=shield)
    scenario = replace(scenario, composition=composition)
    for run, seed in zip(runs, SEEDS, strict=True):
        assert run.seed == seed and run.failure is None
        assert without_clock(run.metrics) == alone(scenario, make_supervisor(supervisor), seed, shield=shield)
        world = World(scenario)
        world.reset(seed)
        assert run.instance is not None
        np.testing.assert_array_equal(run.instance.starts, world.state.position[0])
        np.testing.assert_array_equal(run.instance.obstacles, world.state.obstacles[0, :, :3])


def test_groups_of_any_size_give_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seven draws give the same all together and two at a time; progress is reported after each draw."""
    scenario = held_out(make_scenario("field", duration=1.0))
    told: list[tuple[str, float, float]] = []
    whole = evaluate_batch(scenario, range(7), "fsams", progress=lambda *step: told.append(step))
    monkeypatch.setattr("marlbc_mj.studies.batches.MOST_TOGETHER", 2)
    pairs = evaluate_batch(scenario, range(7), "fsams")
    assert [without_clock(run.metrics) for run in whole] == [without_clock(run.metrics) for run in pairs]
    assert told == [("fsams+sorlc", k, 7) for k in range(1, 8)]


def test_the_number_of_draws_together_is_bounded_by_memory() -> None:
    assert draws_together(make_scenario("field", duration=1.0)) == MOST_TOGETHER
    assert draws_together(make_scenario("field", agents=256, length=2000.0, formation="grid")) == 1
    each = 80 * 4 * 10 * 1200
    assert draws_together(make_scenario("field")) == min(MOST_TOGETHER, int(RECORD_BYTES // each))


# Failures -----------------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Troubled:
    """Constant FM; on the one draw with its first obstacle at x = ``place`` [m], ``trouble`` begins after 1 s."""

    place: float
    trouble: str

    def start(self, scenario: Scenario, teams: int) -> Any:
        return FixedPriority().start(scenario, teams)

    def decide(self, observation: Any, memory: Any) -> tuple[Any, Any]:
        velocity = np.zeros((*memory.shape, 2))
        troubled = (observation.obstacles[:, 0, 0] == self.place) & (observation.time >= 1.0)
        if self.trouble == "raises" and troubled.any():
            raise SimulationError("no plan for this draw")
        if self.trouble == "slips" and troubled.any():
            raise KeyError("nothing")
        if self.trouble == "NaN":
            velocity[troubled] = np.nan
        if self.trouble == "diverges":
            velocity[troubled] = 9e8  # allowed, but even a controller without a force limit cannot follow it
        return Blend(memory, velocity), memory


@pytest.mark.parametrize(
    ("trouble", "reason"),
    [("diverges", "t = 1.0"), ("raises", "no plan for"), ("slips", "KeyError: 'nothing'"), ("NaN", "must be finite")],
)
def test_a_draw_that_fails_leaves_the_others_as_they_are(trouble: str, reason: str) -> None:
    """A world diverges, or a supervisor raises an error without naming a team; the reason is the same as for the draw alone."""
    scenario, controller = held_out(make_scenario("field", duration=2.0)), "finite-time"
    world = World(scenario)
    world.reset(SEEDS[1])
    supervisor = Troubled(float(world.state.obstacles[0, 0, 0]), trouble)
    entry = Flown(scenario, supervisor, make_controller(controller), ("troubled", controller), False)
    first, failed, last = fly_side_by_side(entry, SEEDS)
    with pytest.raises((ConfigurationError, SimulationError), match=reason) as raised:
        alone(scenario, supervisor, SEEDS[1], controller=controller)
    assert failed.metrics is None and failed.failure == str(raised.value) and failed.instance is not None
    for run in (first, last):
        assert without_clock(run.metrics) == alone(scenario, supervisor, run.seed, controller=controller)


@dataclass(frozen=True)
class Fickle:
    """One disc far away, for half of all draws; the other half have no valid layout."""

    def sample(self, rng: np.random.Generator) -> Sample:
        x = rng.uniform(-1.0, 1.0)
        if x > 0.0:
            raise ConfigurationError(f"no layout for {x:.3f}")
        return Sample(np.array([[100.0, 100.0 + x, 1.0]]), np.zeros((0, 6)))


def test_draws_without_a_layout_are_named_and_the_others_flown() -> None:
    """Some of the draws that the worlds are constructed with have no layout either."""
    scenario = replace(make_scenario("open", duration=0.5), obstacles=((100.0, 100.0, 1.0),), layout=Fickle())
    assert _has_layout(scenario, 0) and not all(_has_layout(scenario, 0, world) for world in range(10))
    runs = evaluate_batch(scenario, range(10), "fixed")
    flown = [run.seed for run in runs if run.metrics is not None]
    assert flown == [seed for seed in range(10) if _has_layout(scenario, seed)] and 0 < len(flown) < 10
    assert all("no layout for 0" in str(run.failure) and run.instance is None for run in runs if run.metrics is None)


def _has_layout(scenario: Scenario, seed: int, world: int = 0) -> bool:
    try:
        scenario.draw(stream(seed, world))
    except ConfigurationError:
        return False
    return True


def test_an_invalid_setting_fails_every_draw() -> None:
    """Two causes: a substep that is too long for the controller, and a supervisor without a schedule."""
    coarse = evaluate_batch(paper(duration=0.5, substep=0.025), (0, 1), "scripted", "pd")
    assert all("25 ms" in str(run.failure) and run.instance is None for run in coarse)
    field = evaluate_batch(held_out(make_scenario("field", duration=0.5)), (0, 1), "scripted")
    assert all("no schedule" in str(run.failure) and run.instance is not None for run in field)


def test_a_users_supervisor_decides_for_one_team_at_a_time(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "import numpy as np\n"
        "class Mine:\n"
        "    def start(self, scenario):\n"
        "        return scenario.orders.index('FM')\n"
        "    def decide(self, observation, memory):\n"
        "        return np.full(len(observation.position), memory), memory\n"
    )
    scenario = held_out(make_scenario("field", duration=1.0))
    mine, fixed = (evaluate_batch(scenario, (0, 1), name) for name in (f"{file}:Mine", "fixed"))
    assert [_scalars(run) for run in mine] == [_scalars(run) for run in fixed]


def _scalars(run: SeedRun) -> Any:
    return without_clock(run.metrics)

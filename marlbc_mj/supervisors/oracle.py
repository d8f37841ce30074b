"""The oracle: switch times found by search on the simulator itself, for one scenario under one controller.

Every supervisor's regret is measured against it. It knows the future, violates the safe distance at no substep, and has the
highest return (13) that the search found under this condition. Schedules are cached with seed and budget.

The search is an evolution strategy on the table of commands (mission steps, agents). Changes of command come in clusters, and the
rewards between two clusters depend almost only on the earlier one. So every candidate mutates all segments at once, and one
candidate of the next population combines the best version of each segment. It is scored by its own simulation, never by the sum
of its segments' scores.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from marlbc_mj.controllers import Controller, make_controller
from marlbc_mj.core.behaviors import clearances
from marlbc_mj.core.safety import violates
from marlbc_mj.engine.observation import Observation
from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import Perturbation, Scenario, Window
from marlbc_mj.supervisors.scripted import Schedule, Scripted, orders_at
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import write_json
from marlbc_mj.util.provenance import config_hash, plain_data, versions
from marlbc_mj.util.stretches import stretches

POPULATION = 64  # candidates per generation, simulated together
APART = 4.0  # [s] changes of command farther apart than this belong to different segments
LEAD = 1.0  # [s] a segment begins this long before its first change
MEAN_SHIFT = 4.0  # [mission steps] mean distance by which a mutation moves a change of command
MEAN_RUN = 5.0  # [mission steps] mean duration of a command that a mutation inserts
SPREAD = 1.5  # [s] standard deviation of an inserted command's start around a change


class Found(NamedTuple):
    """A schedule and how it was found: one entry of the cache."""

    windows: tuple[Window, ...]
    total: float  # the return
    scripted: float | None  # return of the scenario's own schedule (of ``start`` if it has none); None if it violates
    seed: int
    budget: int  # episodes allowed
    episodes: int  # episodes simulated
    start: tuple[Window, ...] | None = None  # schedule from which the search started; None: the scenario's own


class Evaluation(NamedTuple):
    """Results of one episode per candidate."""

    reward: np.ndarray  # (B, M)
    violated: np.ndarray  # (B, M) bool: d <= d_OA for any agent after any substep of the mission step


def shipped_schedules() -> Path:
    """The cache that comes with the package."""
    return Path(str(files("marlbc_mj") / "supervisors" / "oracle_schedules.json"))


def cache_key(scenario: Scenario, controller: Controller) -> str:
    """Hash of everything that affects a schedule's return, without names, descriptions and the scripted schedule."""
    bare = plain_data(replace(scenario, name="", description="", schedule=()))
    hashed = {name: value for name, value in bare.items() if name not in scenario.unhashed}
    return config_hash({"scenario": hashed, "controller": controller})


def read_cache(path: Path) -> dict[str, Any]:
    """Entries of the cache by key; empty if the file does not exist.

    Raises:
        ConfigurationError: the file cannot be read or is not a cache.
    """
    try:
        entries = json.loads(path.read_text()) if path.exists() else {}
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"cannot read the oracle's schedules {path}: {error}") from error
    if not isinstance(entries, dict):
        raise ConfigurationError(f"{path} does not hold the oracle's schedules")
    return entries


def save_schedule(found: Found, scenario: Scenario, controller: str, path: Path | None = None) -> None:
    """Add a schedule to the cache (the shipped one by default); it replaces an entry with the same key."""
    path = path or shipped_schedules()
    entry = {"scenario": scenario.name, "controller": controller, **found._asdict(), "versions": versions()}
    write_json(path, read_cache(path) | {cache_key(scenario, make_controller(controller)): entry})


@dataclass(frozen=True)
class Oracle:
    """Plays the cached schedule of this scenario under this controller."""

    controller: str = "sorlc"  # name of the controller that the schedule was found with
    cache: Path | None = None  # None: the shipped one
    unperturbed: bool = False  # play the schedule of the unperturbed scenario on perturbed draws, for which it is not an oracle

    def start(self, scenario: Scenario, teams: int) -> Schedule:
        """Memory: the cached schedule, which all teams share.

        Raises:
            ConfigurationError: the cache has no schedule for this scenario and controller.
        """
        return self.schedule(scenario).start(scenario, teams)

    def decide(self, observation: Observation, memory: Schedule) -> tuple[np.ndarray, Schedule]:
        """The orders of the schedule at each team's time."""
        return Scripted().decide(observation, memory)

    def schedule(self, scenario: Scenario) -> Scripted:
        """The cached schedule as a scripted supervisor."""
        entry = self.entry(scenario)
        return Scripted(tuple(Window(*w) for w in entry["windows"]), scenario.formation_names[0])

    def entry(self, scenario: Scenario) -> dict[str, Any]:
        """The cache entry: a dict with the fields of :class:`Found`, scenario, controller and versions.

        Raises:
            ConfigurationError: there is none for this scenario and controller.
        """
        entries = read_cache(self.cache or shipped_schedules())
        known = replace(scenario, perturbation=Perturbation()) if self.unperturbed else scenario
        key = cache_key(known, make_controller(self.controller))
        if key not in entries:
            command = f"marlbc oracle --scenario {scenario.name} --controller {self.controller}"
            raise ConfigurationError(
                f"the oracle has no schedule for scenario {scenario.name!r} under {self.controller!r} with these settings; "
                f"for the scenario as it is named, find one with: {command}; for others: marlbc_mj.supervisors.oracle.search"
            )
        entry: dict[str, Any] = entries[key]
        return entry


def search(
    scenario: Scenario,
    controller: str = "sorlc",
    *,
    seed: int = 0,
    budget: int = 4096,
    population: int = POPULATION,
    threads: int = 1,
    start: tuple[Window, ...] | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Found:
    """Find a safe schedule of high return. The same seed and budget give the same schedule, on any number of threads.

    Args:
        controller: name of the controller.
        budget: greatest number of episodes, rounded down to whole populations; at least one population.
        population: candidates simulated at a time.
        start: initial schedule; the scenario's own by default.
        progress: called with the number of episodes so far and the best safe return (-inf before there is one).

    Raises:
        ConfigurationError: a perturbed scenario, drawn or moving obstacles, no schedule to start from, a negative seed, too small
            a budget or population, or no safe schedule found.
    """
    if scenario.layout is not None or scenario.moving:
        raise ConfigurationError(
            f"the oracle plans only around known obstacles at rest; scenario {scenario.name!r} has moving or random ones"
        )
    if scenario.perturbation != Perturbation():
        raise ConfigurationError("the oracle's schedule is for a single draw; search on a scenario without perturbation")
    if seed < 0:
        raise ConfigurationError(f"seed must not be negative, got {seed}")
    if population < 2 or budget < population:
        raise ConfigurationError(f"population must be at least 2 and budget at least population, got {population} and {budget}")
    world = World(scenario, make_controller(controller), worlds=population, threads=threads, record=True)
    best = command_table(scenario, scenario.schedule if start is None else start)
    rng = np.random.default_rng(seed)
    hope = command_table(scenario, scenario.schedule or start or ())
    best_score, scripted, episodes = (-np.inf, -np.inf), None, 0
    while episodes + population <= budget:
        tables = np.stack([hope, best, *(_mutate(best, scenario, rng) for _ in range(population - 2))])
        result = evaluate(world, tables)
        scores = [_score(result, b) for b in range(population)]
        if episodes == 0 and not result.violated[0].any():
            scripted = float(result.reward[0].sum())
        winner = max(range(population), key=lambda b: scores[b])
        hope = _assemble(tables, result, segments(best, scenario), 1)
        if scores[winner] > best_score:
            best, best_score = tables[winner], scores[winner]
        episodes += population
        if progress is not None:
            progress(episodes, best_score[1] if best_score[0] == 0 else -np.inf)
    if best_score[0] < 0:
        raise ConfigurationError(f"no safe schedule found in {episodes} episodes; raise the budget")
    return Found(windows_of(best, scenario), best_score[1], scripted, seed, budget, episodes, start)


def evaluate(world: World, tables: np.ndarray) -> Evaluation:
    """Simulate one episode per table of commands; ``tables`` (B, M, N), ``world`` with B worlds and ``record=True``."""
    scenario, obstacles = world.scenario, world.state.obstacles[0]
    orders = scenario.orders.representative[tables]
    reward, violated = np.zeros(tables.shape[:2]), np.zeros(tables.shape[:2], dtype=bool)
    world.reset(0)
    for k in range(tables.shape[1]):
        step = world.step(orders[:, k])
        assert step.record is not None, "evaluate needs World(record=True)"
        after = np.concatenate([step.record.position[:, 1:], world.state.position[:, None]], axis=1)  # (B, substeps, N, 2)
        reward[:, k] = step.reward
        violated[:, k] = violates(clearances(after, obstacles), scenario.safe_distance).any(axis=(1, 2))
    return Evaluation(reward, violated)


def command_table(scenario: Scenario, windows: tuple[Window, ...]) -> np.ndarray:
    """(M, N) index into ``scenario.orders.commands`` at every mission step when the scripted supervisor plays ``windows``."""
    schedule = Scripted(windows, scenario.formation_names[0]).start(scenario, 1)
    times = np.arange(scenario.mission_steps) * scenario.mission_step
    return np.asarray(scenario.orders.command_of[orders_at(times, schedule)])


def windows_of(table: np.ndarray, scenario: Scenario) -> tuple[Window, ...]:
    """The schedule that plays ``table``: no windows for the default, bounds halfway between mission steps, agent -1 for all."""
    default = scenario.orders.commands.index(scenario.formation_names[0])
    runs: dict[tuple[int, int, int], list[int]] = {}
    for i in range(scenario.agents):
        for first, last, command in stretches(table[:, i]):
            if command != default:
                runs.setdefault((first, last, command), []).append(i)
    windows = []
    for (first, last, command), agents in sorted(runs.items()):
        bounds = (round((k - 0.5) * scenario.mission_step, 9) for k in (first, last))
        start, end = bounds
        for agent in [-1] if len(agents) == scenario.agents else agents:
            windows.append(Window(start, end, agent, scenario.orders.commands[command]))
    return tuple(windows) or (Window(0.0, 0.0, -1, scenario.formation_names[0]),)


def segments(table: np.ndarray, scenario: Scenario) -> list[slice]:
    """Split mission steps shortly before every cluster of changes, so that a segment contains the effects of its cluster."""
    changes = np.flatnonzero((np.diff(table, axis=0) != 0).any(axis=1)) + 1
    apart, lead = (round(t / scenario.mission_step) for t in (APART, LEAD))
    firsts = [c for k, c in enumerate(changes) if k == 0 or c - changes[k - 1] > apart]
    cuts = [0, *(int(c) - lead for c in firsts if c > lead), len(table)]
    return [slice(a, b) for a, b in pairwise(cuts)]


def _score(result: Evaluation, b: int) -> tuple[float, float]:
    """Score of a candidate, compared in order: minus the number of mission steps in violation, then the return."""
    return -float(result.violated[b].sum()), float(result.reward[b].sum())


def _assemble(tables: np.ndarray, result: Evaluation, cuts: list[slice], incumbent: int) -> np.ndarray:
    """Combine the best candidate's version of each segment; the incumbent's where none is better."""
    table: np.ndarray = tables[incumbent].copy()
    for cut in cuts:
        score = result.reward[:, cut].sum(axis=1) - 1e6 * result.violated[:, cut].sum(axis=1)
        if score.max() > score[incumbent]:
            table[cut] = tables[int(score.argmax()), cut]
    return table


def _mutate(table: np.ndarray, scenario: Scenario, rng: np.random.Generator) -> np.ndarray:
    """A copy with one or two mutations in most segments."""
    table = table.copy()
    for cut in segments(table, scenario):
        for _ in range(rng.choice(3, p=(0.2, 0.5, 0.3))):
            if rng.random() < 0.6:
                _shift(table, cut, rng)
            else:
                _overwrite(table, cut, scenario, rng)
    return table


def _shift(table: np.ndarray, cut: slice, rng: np.random.Generator) -> None:
    """Move one change of command within ``cut`` to another time, for all agents that change then or for one of them."""
    changed = np.diff(table[cut], axis=0) != 0
    if not changed.any():
        return
    at = int(rng.choice(np.flatnonzero(changed.any(axis=1)))) + 1 + cut.start
    movers = np.flatnonzero(changed[at - 1 - cut.start])
    if rng.random() < 0.3:
        movers = rng.choice(movers, 1)
    to = int(np.clip(at + rng.choice((-1, 1)) * rng.geometric(1.0 / MEAN_SHIFT), cut.start + 1, cut.stop - 1))
    for i in movers:
        if to > at:
            table[at:to, i] = table[at - 1, i]
        else:
            table[to:at, i] = table[at, i]


def _overwrite(table: np.ndarray, cut: slice, scenario: Scenario, rng: np.random.Generator) -> None:
    """Insert a command for a few steps, near a change or anywhere in ``cut``, for some or all agents."""
    changes = np.flatnonzero((np.diff(table[cut], axis=0) != 0).any(axis=1)) + 1 + cut.start
    if len(changes) and rng.random() < 0.9:
        first = int(rng.normal(rng.choice(changes), SPREAD / scenario.mission_step))
    else:
        first = int(rng.integers(cut.start, cut.stop))
    first = int(np.clip(first, cut.start, cut.stop - 1))
    last = min(cut.stop, first + int(rng.geometric(1.0 / MEAN_RUN)))
    who = rng.random(scenario.agents) < rng.choice((0.3, 1.0))
    command = rng.integers(len(scenario.orders.commands)) if rng.random() < 0.5 else table[max(first - 1, 0)]
    table[first:last, who] = np.broadcast_to(command, (scenario.agents,))[who]

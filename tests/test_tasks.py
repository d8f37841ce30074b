"""The dm_control view equals the engine: one model, one mission step, over a whole episode."""

from collections import deque

import dm_env
import mujoco
import numpy as np
import pytest
from dm_env import specs

from marlbc_mj import tasks
from marlbc_mj.controllers import SORLC
from marlbc_mj.core.laws import plain
from marlbc_mj.engine.assembly import assemble
from marlbc_mj.engine.world import World
from marlbc_mj.scenarios import Perturbation, paper
from marlbc_mj.supervisors import make_supervisor
from marlbc_mj.util.errors import ConfigurationError, SimulationError


def test_whole_episode_equals_the_compiled_loop() -> None:
    """Over all 2000 mission steps positions, observations and rewards of both paths agree to 1e-9 (in fact to the last bit)."""
    environment = tasks.load("formation", "paper", random_state=0)
    scenario = environment.task.scenario
    world, supervisor = World(scenario), make_supervisor("scripted")
    memory, observation, timestep = supervisor.start(scenario, 1), world.reset(), environment.reset()
    worst, total, steps = 0.0, 0.0, 0
    while not timestep.last():
        orders, memory = supervisor.decide(observation, memory)
        step = world.step(orders)
        observation, timestep = step.observation, environment.step(orders[0])
        qpos = environment.physics.data.qpos[world.plan.plant.qpos_index]
        worst = max(worst, np.abs(qpos - observation.position[0]).max(), abs(timestep.reward - step.reward[0]))
        worst = max(worst, np.abs(timestep.observation["state"] - observation.state()[0]).max())
        total += timestep.reward
        steps += 1
        assert timestep.discount == float(steps < 2000)  # the end of a mission is a termination, as in the other views
    assert (steps, total) == (2000, 15017.0)
    assert worst <= 1e-9


def test_one_assembly() -> None:
    """The model that dm_control compiles equals the engine's in every numeric field."""
    environment = tasks.load("formation", "paper")
    environment.reset()
    theirs, ours = environment.physics.model.ptr, World(paper()).plan.model
    public = [name for name in dir(ours) if not name.startswith("_")]
    fields = [name for name in public if isinstance(getattr(ours, name), np.ndarray | int | float)]
    assert len(fields) > 300
    different = [name for name in fields if not np.array_equal(getattr(ours, name), getattr(theirs, name))]
    assert different == []


def test_specs_and_seeds() -> None:
    """Actions and observations keep their specs; equal seeds make equal perturbed episodes and other seeds other ones."""
    changes = {"duration": 1.0, "perturbation": Perturbation(start_spread=1.0, obstacle_spread=0.5, drag_scale=(0.0, 2.0))}

    def play(seed: int) -> list[dm_env.TimeStep]:
        environment = tasks.load("formation", "paper", random_state=seed, **changes)
        spec, timestep = environment.action_spec(), environment.reset()
        assert isinstance(spec, specs.BoundedArray) and spec.maximum == 5
        path = [timestep]
        while not timestep.last():
            timestep = environment.step(np.full(4, 2))
            for name, value in environment.observation_spec().items():
                value.validate(timestep.observation[name])
            path.append(timestep)
        return path

    first, again, other = play(3), play(3), play(4)
    assert len(first) == 21
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.observation["state"], b.observation["state"])
    assert np.abs(first[0].observation["position"] - other[0].observation["position"]).max() > 0


def test_plain_python_controller_runs() -> None:
    """A controller that is not compiled gives the same episode as the compiled one."""

    class Plain(SORLC):
        law = staticmethod(plain(SORLC.law))

    finals = []
    for controller in (SORLC(), Plain()):
        environment = tasks.load("formation", "paper", controller=controller, duration=0.5)
        environment.reset()
        for _ in range(10):
            timestep = environment.step(np.full(4, 2))
        finals.append(timestep.observation["position"])
    np.testing.assert_allclose(finals[0], finals[1], atol=1e-12)


def test_divergence_stops_the_environment() -> None:
    """A drag that makes the simulation diverge raises an error that names agent and time."""
    from marlbc_mj.core.disturbances import PaperDrag

    environment = tasks.load("formation", "paper", disturbance=PaperDrag(20.0))
    environment.reset()
    for _ in range(20):
        environment.step(np.full(4, 2))
    with pytest.raises(SimulationError, match=r"agent \d, t = 1\.\d+ s"):
        deque((environment.step(np.full(4, 2)) for _ in range(20)), maxlen=0)


def test_unknown_names() -> None:
    """Unknown domains and scenarios are named together with the valid ones."""
    with pytest.raises(ConfigurationError, match=r"'flock'.*formation"):
        tasks.load("flock", "paper")
    with pytest.raises(ConfigurationError, match=r"'papers'.*paper"):
        tasks.load("formation", "papers")


def test_assembly_names_are_prefixed_and_unique() -> None:
    """Every agent's names carry its prefix, for any number of agents."""
    from marlbc_mj.scenarios import standard_behaviors

    slots = tuple((0.0, 3.0 * i) for i in range(7))
    scenario = paper(starts=slots, behaviors=standard_behaviors(slots, tuple((x + 50.0, y) for x, y in slots)), obstacles=())
    model = mujoco.MjModel.from_xml_string(assemble(scenario, 200.0))
    names = [model.joint(j).name for j in range(model.njnt)]
    assert names == [f"agent{i + 1}_{axis}" for i in range(7) for axis in "xy"]
    np.testing.assert_allclose(model.body_mass[1:], 1.0)

"""B teams between mission steps, without the physics: making, resetting, placing and observing their rows.

World and the dm_control task both hold a :class:`~marlbc_mj.engine.records.Team` and share these functions.
"""

from typing import Any

import numpy as np

from marlbc_mj.core import laws
from marlbc_mj.core.imperfections import sense
from marlbc_mj.core.lookout import LISTED
from marlbc_mj.core.motion import MOVING, NUMBERS
from marlbc_mj.core.shield import ASSUMPTIONS, ShieldCounts
from marlbc_mj.core.stamps import NEVER_STAMPED, REMEMBERED
from marlbc_mj.engine.body import DIVERGED, read_robots
from marlbc_mj.engine.loop import judge, valid_orders
from marlbc_mj.engine.observation import NEVER, Observation
from marlbc_mj.engine.plan import Plan
from marlbc_mj.engine.records import Record, Team
from marlbc_mj.engine.shielding import check_draw
from marlbc_mj.util.errors import ConfigurationError, SimulationError

SCRATCH = ("status", "drag", "force", "workspace", "grid", "stopping", "looked", "seen", "around", "near", "tracks")
"""Fields of a team that carry nothing from one mission step to the next."""


def make_team(plan: Plan, worlds: int) -> Team:
    """Allocate the rows of ``worlds`` teams; :func:`reset` starts an episode in one of them."""
    scenario, imperfections = plan.scenario, plan.scenario.imperfections
    agents, count, moving = scenario.agents, len(scenario.obstacles), scenario.moving
    each, pairs, tracks = (worlds, agents), (worlds, agents, 2), (worlds, count if moving else 0)
    shielded = (worlds, agents if plan.shielded else 0)
    forces = (worlds, agents if plan.shielded and plan.plant.shield[0].tube == 0.0 else 0)
    numbers = plan.plant.shield[0]
    each_other = agents if forces[1] and plan.mailed else 0
    mailed, ring = (worlds, each_other, each_other), int(numbers.latency) + REMEMBERED if each_other else 0
    outlooks = (worlds, 0 if moving or each_other else forces[1])
    return Team(
        steps=np.zeros(worlds, dtype=np.int64),
        position=np.zeros(pairs),
        velocity=np.zeros(pairs),
        reference=np.zeros(pairs),
        reference_velocity=np.zeros(pairs),
        controller=np.zeros((worlds, *plan.initial_state.shape)),
        command=np.zeros(each, dtype=np.int64),
        since=np.full(each, NEVER),
        clearance=np.zeros(each),
        formation=np.zeros(worlds, dtype=np.int64),
        reward=np.zeros(worlds),
        obstacles=np.zeros((worlds, count, MOVING if moving else 3)),
        anchors=np.zeros((*tracks, 3)),
        motions=np.zeros((*tracks, NUMBERS)),
        disturbance_params=np.zeros((worlds, len(plan.disturbance_params))),
        robot=np.zeros((*each, plan.robot_state.shape[1])),
        history=np.zeros((worlds, imperfections.depth(scenario.substep), 2, agents, 2)),
        sensed=np.zeros((worlds, 2 if imperfections.sensing else 0, agents, 2)),
        noise_seed=np.zeros(worlds, dtype=np.int64),
        status=np.zeros(worlds, dtype=np.int64),
        drag=np.zeros(pairs),
        force=np.zeros(pairs),
        workspace=np.zeros((worlds, plan.workspace_rows, 2)),
        grid=np.zeros((worlds, plan.grid_room)),
        interventions=np.zeros(shielded),
        force_change=np.zeros(shielded),
        breaches=np.zeros((*shielded, len(ASSUMPTIONS))),
        last_substep=np.full((*forces, 2, 2), np.nan),
        stopping=np.zeros(forces),
        looked=np.full((*outlooks, 3), np.inf),
        seen=np.zeros((worlds, count if outlooks[1] else 0, 3)),
        around=np.zeros((*outlooks, 1 + LISTED), dtype=np.int64),
        near=np.zeros((worlds, 1 + count + agents + 2 * mailed[1] if forces[1] else 0), dtype=np.int64),
        stamps=np.full((*mailed, 2), NEVER_STAMPED),
        planes=np.zeros((*mailed, 2, 3)),
        memory=np.zeros((worlds, ring, mailed[1], 3)),
        sent_stamps=np.full((worlds, ring, *mailed[1:]), NEVER_STAMPED),
        tracks=np.zeros((worlds, count if moving and forces[1] else 0, MOVING)),
    )


def make_record(plan: Plan, worlds: int, recording: bool) -> Record:
    """Allocate the record of every substep of one mission step; it is empty unless ``recording``."""
    shape = (worlds, plan.scenario.substeps if recording else 0, plan.scenario.agents, 2)
    return Record(*(np.zeros(shape) for _ in Record._fields))


def reset(plan: Plan, team: Team, b: int, rng: np.random.Generator) -> np.ndarray:
    """Set row ``b`` to the start of an episode drawn with ``rng``; returns the starts (N, 2) [m], for :func:`put`.

    Raises:
        ConfigurationError: no layout for this draw, solid obstacles of another size than in the model, or a start that the
            shield does not allow.
    """
    draw = plan.scenario.draw(rng)
    _check_solid(plan, draw.obstacles)
    if plan.shielded:
        check_draw(plan.plant.shield[0], draw)
    team.obstacles[b, :, :3] = draw.obstacles
    if team.motions.shape[1]:
        team.anchors[b], team.motions[b] = draw.obstacles, draw.motions
    team.disturbance_params[b] = plan.disturbance_params
    team.disturbance_params[b, 0] *= draw.drag_scale
    team.noise_seed[b] = rng.integers(2**32)
    place(plan, team, b, 0, draw.starts, np.zeros_like(draw.starts), 0)
    return draw.starts


def _check_solid(plan: Plan, obstacles: np.ndarray) -> None:
    """Raise ConfigurationError if solid obstacles (K, 3) have other radii than in the model."""
    scenario = plan.scenario
    if len(plan.solid) and (obstacles[:, 2] != scenario.obstacle_array()[:, 2]).any():
        raise ConfigurationError(
            f"robot {plan.fleet.solid!r} collides with obstacles, so their radii cannot depend on the seed; "
            "give the family a single radius in a TOML file, for example radius = [0.5, 0.5], or fly gates or robot_gate"
        )


def place(
    plan: Plan, team: Team, b: int, step: int, position: np.ndarray, velocity: np.ndarray, command: np.ndarray | int
) -> None:
    """Set row ``b`` to mission step ``step``, agents and references to ``position`` [m] and ``velocity`` [m/s], (N, 2) each.

    Controllers and robots get their initial states. ``command`` (N,) counts as in force from the beginning.
    """
    team.position[b] = team.reference[b] = position
    team.velocity[b] = team.reference_velocity[b] = velocity
    team.controller[b] = plan.initial_state
    team.robot[b] = plan.robot_state
    team.steps[b], team.command[b], team.since[b], team.reward[b] = step, command, NEVER, 0.0
    team.interventions[b], team.force_change[b], team.breaches[b] = 0.0, 0.0, 0.0
    team.stamps[b], team.sent_stamps[b] = NEVER_STAMPED, NEVER_STAMPED
    laws.plain(judge)(b, plan.mission, team)


def put(plan: Plan, team: Team, b: int, data: Any, position: np.ndarray, velocity: np.ndarray) -> None:
    """Set the physics ``data`` of row ``b`` to positions (N, 2) [m] and velocities (N, 2) [m/s], and measure the result.

    If a robot's reading is at another point than its base (a look-ahead point), the base is shifted so that the reading is the
    position; the velocity is then what the joints allow. Solid obstacles are set to their places in this episode.
    """
    plant = plan.plant
    team.last_substep[b] = np.nan
    team.stamps[b], team.sent_stamps[b] = NEVER_STAMPED, NEVER_STAMPED  # all agents know the new places
    base = plant.qpos_index.ravel()
    data.qpos[base] = np.ravel(position)
    data.qvel[plant.qvel_index.ravel()] = np.ravel(velocity)
    if len(plan.solid):
        data.mocap_pos[plan.solid, :2] = team.obstacles[b, :, :2]
    if len(plant.groups):
        p, v, force = np.zeros((3, *team.position[b].shape))
        read_robots(plan.readings(), plant, team.robot[b], data.qpos, data.qvel, data.actuator_force, p, v, force)
        data.qpos[base] += np.ravel(position - p)
        team.velocity[b] = v
    if team.sensed.shape[1] > 0:  # delayed sensors measure the present state
        team.history[b] = np.stack([team.position[b], team.velocity[b]])
        count = int(team.steps[b]) * plan.mission.substeps
        sense(plant, team.noise_seed[b], count, team.history[b], team.position[b], team.velocity[b], team.sensed[b])


def check_orders(plan: Plan, orders: np.ndarray, worlds: int) -> np.ndarray:
    """Check orders (B, N) int64 and return them unchanged.

    Raises:
        ConfigurationError: a wrong shape, or an index that is no order, for which the loop would read past its tables.
    """
    shape, count = (worlds, plan.scenario.agents), len(plan.scenario.orders)
    if orders.shape != shape:
        raise ConfigurationError(f"orders must have shape {shape} (worlds, agents), got {orders.shape}")
    if not valid_orders(orders, count):
        raise ConfigurationError(f"orders must be indices from 0 to {count - 1}, got {orders.tolist()}")
    return orders


def lasting(team: Team) -> dict[str, np.ndarray]:
    """The arrays on which a mission step depends, by name, without copying."""
    return {name: array for name, array in team._asdict().items() if name not in SCRATCH}


def copy_row(source: Team, source_world: int, team: Team, world: int) -> None:
    """Make row ``world`` equal to a row of another team of the same plan."""
    for name, array in lasting(team).items():
        array[world] = getattr(source, name)[source_world]


def observe(plan: Plan, team: Team) -> Observation:
    """The observation that supervisors receive, as copies."""
    measured = (team.sensed[:, 0], team.sensed[:, 1]) if team.sensed.shape[1] > 0 else (team.position, team.velocity)
    duration = plan.mission.mission_step
    return Observation(
        step=team.steps.copy(),
        time=team.steps * duration,
        position=measured[0].copy(),
        velocity=measured[1].copy(),
        clearance=team.clearance.copy(),
        formation=team.formation.copy(),
        command=team.command.copy(),
        age=(team.steps[:, None] - team.since) * duration,
        reference=team.reference.copy(),
        obstacles=team.obstacles.copy(),
        noise_seed=team.noise_seed.copy(),
    )


def shield_counts(team: Team) -> ShieldCounts | None:
    """Copies of the shield counts of every team since the episode began; None without a shield."""
    if team.interventions.shape[1] == 0:
        return None
    return ShieldCounts(team.interventions.copy(), team.force_change.copy(), team.breaches.copy())


def diverged(plan: Plan, team: Team, b: int, status: int, steps: int) -> SimulationError:
    """The error for a ``status`` of the loop in mission step ``steps``, counted from 0: names world, agent and time."""
    agent, substep = (status - 1) % plan.scenario.agents, (status - 1) // plan.scenario.agents
    time = steps * plan.mission.mission_step + substep * plan.mission.substep
    return SimulationError(
        f"world {b}, agent {agent + 1}, t = {time:.3f} s: position, velocity or "
        f"force is not finite or beyond {DIVERGED:g} "
        f"(p = {team.position[b, agent].tolist()}, v = {team.velocity[b, agent].tolist()})"
    )

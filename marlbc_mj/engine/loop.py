"""One mission step of one team, defined once in :func:`mission_step` and its parts.

The compiled loop runs it for every world. The Python path runs the same source as plain Python, with laws and ``mj_step`` as
objects. The dm_control task calls its parts from composer's hooks. The sequence is:

1. :func:`start`: the orders are read, and :func:`begin` computes v_r once from p_r (``virtual``) or the measured p (``actual``),
   limits it and holds it for the mission step; a shield of references may change it (:func:`shield_references`);
2. in every substep h: :func:`apply` computes the force from the current errors and weights, updates the weights by explicit
   Euler, and sets the drag at the current (p, v) and the robots' controls; MuJoCo steps; :func:`settle` measures the new state
   and advances p_r by h v_r;
3. :func:`finish`: moving obstacles are set to their new positions; clearances, formation identifier and reward are computed from
   the positions. So behaviors and supervisors see obstacles where they are at the start of a mission step.
"""

import numpy as np

from marlbc_mj.core.behaviors import nearest_obstacle
from marlbc_mj.core.cells import fill, nearest, room
from marlbc_mj.core.compiling import allocation_free, on_both_paths
from marlbc_mj.core.imperfections import sense, weaken
from marlbc_mj.core.lookout import forget_moved
from marlbc_mj.core.motion import move
from marlbc_mj.core.safety import violates
from marlbc_mj.core.shield import STATE_BROKEN, TUBE_BROKEN, ShieldCounts, fill_stopping, restrain_references, shield_team
from marlbc_mj.core.stamps import Mail, exchange
from marlbc_mj.core.stopping import TINY, ShieldView
from marlbc_mj.engine.body import DIVERGED, actuate, read_robots, scale_rows, shrink_rows
from marlbc_mj.engine.by_address import call
from marlbc_mj.engine.composition import compose_team, keep, limit
from marlbc_mj.engine.native import as_controller, as_disturbance, call_step, doubles

VIOLATION_REWARD = -10.0  # (14), whatever the formation
FORMATION_REWARD = 5.0  # (14), times G
SWITCH_REWARD = -3.0  # (15), once per team (erratum 11)


@allocation_free
def fill_clearance(p, obstacles, grid, clearance, normal):
    """Compute ``clearance`` (N,) [m] of agents at ``p`` (N, 2), by a grid if ``grid`` has room; ``normal`` (2,) is scratch."""
    count = obstacles.shape[0]
    near = grid.shape[0] > 0 and count > 0
    if near:
        fill(obstacles, grid[: room(count)])
    for i in range(p.shape[0]):
        k = nearest(p[i], obstacles, grid[: room(count)], -1) if near else -1
        clearance[i] = nearest_obstacle(p[i], obstacles[k : k + 1] if k >= 0 else obstacles, normal)


@allocation_free
def verdict(p, clearance, mission):
    """Formation identifier G and r1 (14) of a team at positions ``p`` (N, 2) with ``clearance`` (N,) [m]."""
    agents = p.shape[0]
    violated = False
    for i in range(agents):
        violated |= violates(clearance[i], mission.safe_distance)
    mean_x, mean_y = 0.0, 0.0
    for i in range(agents):
        mean_x += p[i, 0] / agents
        mean_y += p[i, 1] / agents
    formation = 0
    for which in range(2):
        held = True
        for i in range(agents):
            x = p[i, 0] - mean_x - mission.formations[which, i, 0]
            y = p[i, 1] - mean_y - mission.formations[which, i, 1]
            held &= x * x + y * y <= mission.tolerance * mission.tolerance
        if held:
            formation = 2 - which
            break
    return formation, VIOLATION_REWARD if violated else FORMATION_REWARD * formation


@allocation_free
def valid_orders(orders, count):
    """Whether every one of ``orders`` (B, N) is an index below ``count``."""
    valid = True
    for b in range(orders.shape[0]):
        for i in range(orders.shape[1]):
            valid &= 0 <= orders[b, i] < count
    return valid


@allocation_free
def count_switches(b, orders, behaviors, team):
    """Turn the orders (B, N) of world ``b`` into commands and return r2 (15); the first mission step has no switch."""
    switched = False
    for i in range(orders.shape[1]):
        command = behaviors.command_of[orders[b, i]]
        if team.steps[b] > 0 and command != team.command[b, i]:
            switched = True
            team.since[b, i] = team.steps[b]
        team.command[b, i] = command
    return SWITCH_REWARD if switched else 0.0


@allocation_free
def begin(b, orders, given, mission, behaviors, team):
    """Turn the orders (B, N) of world ``b`` into commands and the v_r of this mission step; set the reward to r2 (15).

    ``given`` (B, N, 2) [m/s] replaces the v_r composed from the orders; if it is (B, 0, 2), the orders are composed.
    """
    v_r, previous = team.reference_velocity[b], team.drag[b]
    keep(behaviors, v_r, previous)
    if given.shape[1] > 0:
        for i in range(v_r.shape[0]):
            for axis in range(2):
                v_r[i, axis] = given[b, i, axis]
    else:
        measured = team.sensed[b, 0] if team.sensed.shape[1] > 0 else team.position[b]
        at = team.reference[b] if behaviors.virtual else measured
        t = team.steps[b] * mission.mission_step
        compose_team(t, orders[b], behaviors, at, team.obstacles[b], team.grid[b], team.workspace[b], v_r)
    team.reward[b] = count_switches(b, orders, behaviors, team)
    forget_moved(team.obstacles[b], team.looked[b], team.seen[b])
    limit(behaviors, mission.mission_step, previous, v_r)


@on_both_paths
def set_forces(b, t, h, native, plant, team):
    """Write drag and controller force of every agent of world ``b`` at ``t`` [s] into ``team.drag`` and ``team.force``.

    The controller receives measured p and v, the disturbance true ones. Controller forces are in ``plant.unit_forces``. Returns
    0, or 1 + agent if a position, velocity, force or drag left the physical range; the world must not be stepped then.
    """
    p, v, drag, force = team.position[b], team.velocity[b], team.drag[b], team.force[b]
    seen_p, seen_v = (team.sensed[b, 0], team.sensed[b, 1]) if team.sensed.shape[1] > 0 else (p, v)
    p_r, v_r, state = team.reference[b], team.reference_velocity[b], team.controller[b]
    disturbance = as_disturbance(native.disturbance)
    controller = as_controller(native.controller)
    disturbance(team.disturbance_params[b], t, p, v, drag)
    if plant.unit_forces.shape[0] == 0:
        controller(plant.controller_params, state, seen_p, seen_v, p_r, v_r, drag, h, force)
    else:
        shrink_rows(drag, plant.unit_forces)
        controller(plant.controller_params, state, seen_p, seen_v, p_r, v_r, drag, h, force)
        scale_rows(drag, plant.unit_forces)
        scale_rows(force, plant.unit_forces)
    for i in range(p.shape[0]):
        size = 0.0
        for axis in range(2):
            size += abs(p[i, axis]) + abs(v[i, axis]) + abs(drag[i, axis]) + abs(force[i, axis])
        if not size < DIVERGED:
            return 1 + i
    return 0


@allocation_free
def shield_references(b, mission, behaviors, plant, team):
    """After :func:`begin`, change v_r of world ``b`` as little as needed for braking in time. Returns 0."""
    numbers, v_r = plant.shield[0], team.reference_velocity[b]
    wish, at, duration = team.force[b], team.reference[b], mission.mission_step
    for i in range(v_r.shape[0]):
        for axis in range(2):
            wish[i, axis] = v_r[i, axis]
    braking = behaviors.acceleration_limit
    restrain_references(numbers, braking, duration, at, team.obstacles[b], team.drag[b], v_r)
    for i in range(v_r.shape[0]):
        x, y = v_r[i, 0] - wish[i, 0], v_r[i, 1] - wish[i, 1]
        change = np.sqrt(x * x + y * y)
        if change > TINY:
            team.interventions[b, i] += mission.substeps
            team.force_change[b, i] += plant.masses[i] * change
        for k in range(team.obstacles.shape[1]):
            x, y = at[i, 0] - team.obstacles[b, k, 0], at[i, 1] - team.obstacles[b, k, 1]
            kept = team.obstacles[b, k, 2] + numbers.clearance + numbers.tube - numbers.slack
            if x * x + y * y < kept * kept:
                team.breaches[b, i, STATE_BROKEN] += mission.substeps
                break
    return 0


@allocation_free
def exchange_messages(b, count, view, numbers, team):
    """Exchange the messages between agents of world ``b``, ``count`` substeps after the mission began."""
    fill_stopping(numbers, view)
    latency, seed = int(numbers.latency), team.noise_seed[b]
    stamps, planes, memory, sent_stamps = team.stamps[b], team.planes[b], team.memory[b], team.sent_stamps[b]
    mail = Mail(
        now=count,
        seed=seed,
        latency=latency,
        quantile=numbers.quantile,
        silent=numbers.silent,
        stamps=stamps,
        planes=planes,
        memory=memory,
        sent_stamps=sent_stamps,
    )
    exchange(numbers, view, mail)


@allocation_free
def shield_forces(b, t, h, plant, team):
    """Replace the forces of world ``b`` by the nearest ones that keep the team able to stop. Returns 0."""
    known = team.sensed.shape[1] > 0
    p, v = (team.sensed[b, 0], team.sensed[b, 1]) if known else (team.position[b], team.velocity[b])
    obstacles = team.obstacles[b]
    if team.tracks.shape[1] > 0:
        obstacles = team.tracks[b]
        move(t, team.anchors[b], team.motions[b], obstacles)
    view = ShieldView(
        h=h,
        p=p,
        v=v,
        moving=team.velocity[b],
        obstacles=obstacles,
        stopping=team.stopping[b],
        grid=team.grid[b],
        planes=team.planes[b],
        looked=team.looked[b],
        around=team.around[b],
        near=team.near[b],
    )
    if team.stamps.shape[1] > 0:
        exchange_messages(b, round(t / h), view, plant.shield[0], team)
    counts = ShieldCounts(team.interventions[b], team.force_change[b], team.breaches[b])
    shield_team(plant.shield[0], view, team.last_substep[b], team.force[b], counts)
    return 0


@on_both_paths
def watch_tube(b, plant, team):
    """Count the agents of world ``b`` that are farther from their references than a shield of references assumes."""
    tube = plant.shield[0].tube
    for i in range(team.position.shape[1]):
        x, y = team.position[b, i, 0] - team.reference[b, i, 0], team.position[b, i, 1] - team.reference[b, i, 1]
        if x * x + y * y > tube * tube:
            team.breaches[b, i, TUBE_BROKEN] += 1.0


@on_both_paths
def apply(b, k, mission, native, plant, team):
    """Substep ``k`` of world ``b`` before MuJoCo's step: force law, shield, drag and drive of every agent.

    Writes ctrl and qfrc_applied. Returns 0, or 1 + agent + N k if a number left the physical range.
    """
    h = mission.substep
    t = team.steps[b] * mission.mission_step + k * h
    failed = set_forces(b, t, h, native, plant, team)
    if not failed:
        force = team.force[b]
        if team.last_substep.shape[1] > 0:
            call(native.shield_forces, b, t, h, plant, team)
        elif team.interventions.shape[1] > 0:
            watch_tube(b, plant, team)
        if plant.loss > 0.0:
            weaken(plant, t, force)
        qpos, qvel = doubles(native.qpos[b], plant.nq), doubles(native.qvel[b], plant.nv)
        failed = actuate(native.drives, plant, team.robot[b], qpos, qvel, force, h, doubles(native.ctrl[b], plant.nu))
    if failed:
        return failed + team.position.shape[1] * k
    applied = doubles(native.applied[b], plant.nv)
    for i in range(team.position.shape[1]):
        for axis in range(2):
            applied[plant.qvel_index[i, axis]] = team.drag[b, i, axis]
    return 0


@on_both_paths
def settle(b, k, mission, native, plant, team, record):
    """Substep ``k`` of world ``b`` after MuJoCo's step: record what the law saw, read the new state, p_r += h v_r."""
    p, v, p_r, v_r, force = team.position[b], team.velocity[b], team.reference[b], team.reference_velocity[b], team.force[b]
    recording = record.force.shape[1] > 0
    if recording:
        for i in range(p.shape[0]):
            for axis in range(2):
                record.position[b, k, i, axis] = p[i, axis]
                record.velocity[b, k, i, axis] = v[i, axis]
                record.reference[b, k, i, axis] = p_r[i, axis]
                record.reference_velocity[b, k, i, axis] = v_r[i, axis]
    qpos, qvel = doubles(native.qpos[b], plant.nq), doubles(native.qvel[b], plant.nv)
    actuator_force = doubles(native.actuator_force[b], plant.nu)
    read_robots(native.readings, plant, team.robot[b], qpos, qvel, actuator_force, p, v, force)
    for i in range(p.shape[0]):
        for axis in range(2):
            if recording:
                record.force[b, k, i, axis] = force[i, axis]
            p_r[i, axis] += mission.substep * v_r[i, axis]
    if team.sensed.shape[1] > 0:
        count = team.steps[b] * mission.substeps + k + 1
        sense(plant, team.noise_seed[b], count, team.history[b], p, v, team.sensed[b])


@allocation_free
def judge(b, mission, team):
    """Move the obstacles of world ``b`` to their current positions and update clearances and G. Returns r1 (14)."""
    if team.motions.shape[1] > 0:
        move(team.steps[b] * mission.mission_step, team.anchors[b], team.motions[b], team.obstacles[b])
    p, clearance = team.position[b], team.clearance[b]
    fill_clearance(p, team.obstacles[b], team.grid[b], clearance, team.workspace[b, 0])
    team.formation[b], reward = verdict(p, clearance, mission)
    return reward


@allocation_free
def finish(b, mission, team):
    """End the mission step of world ``b``: advance the clock and add r1 (14) to the reward."""
    team.steps[b] += 1
    team.reward[b] += judge(b, mission, team)


@on_both_paths
def start(b, orders, given, mission, behaviors, native, plant, team):
    """Run :func:`begin`, and then :func:`shield_references` if the team has a shield of references."""
    begin(b, orders, given, mission, behaviors, team)
    if team.interventions.shape[1] > 0 and plant.shield[0].tube > 0.0:
        call(native.shield_references, b, mission, behaviors, plant, team)


@allocation_free
def mission_step(b, orders, given, mission, behaviors, native, plant, team, record):
    """Run one mission step of world ``b``; returns 1 if a number left the physical range, see ``team.status``, else 0."""
    start(b, orders, given, mission, behaviors, native, plant, team)
    team.status[b] = 0
    for k in range(mission.substeps):
        failed = apply(b, k, mission, native, plant, team)
        if failed:
            team.status[b] = failed
            break
        call_step(native.step, native.model, native.data[b])
        settle(b, k, mission, native, plant, team, record)
    finish(b, mission, team)
    return 1 if team.status[b] else 0


start_compiled = allocation_free(start)
apply_compiled = allocation_free(apply)
settle_compiled = allocation_free(settle)
"""Parts of the mission step, compiled for callers that step MuJoCo between them."""

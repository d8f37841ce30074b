"""One mission step of one agent team: references, then substeps of force law, drag and ``mj_step``, then the verdict.

The pieces (:func:`begin_step`, :func:`team_forces`, :func:`run_substeps`, :func:`judge`) are also what the Python path and the
dm_control task call, so there is one definition of a mission step. Its order of operations:

1. at t = 0.05 k the orders are read and v_r is computed once, from p_r (``virtual``) or the measured p (``actual``), and held;
   a v_r that is given takes the place of the one that the orders make; limits of speed and acceleration bound it;
2. every substep h: force from the current errors and weights, weights by explicit Euler, drag at the current (p, v), the robot's
   controls, MuJoCo's semi-implicit Euler step, then p_r += h v_r;
3. at the end: obstacles that move are put where they are then; clearances, formation identifier and reward from the measured
   positions. So behaviors and supervisors see obstacles where they are at the start of a mission step.
"""

import numba
from numba.extending import register_jitable

from marlbc_mj.core.behaviors import NEAREST_NEIGHBOR, NEAREST_OBSTACLE, nearest_obstacle
from marlbc_mj.core.cells import fill, nearest, room
from marlbc_mj.core.imperfections import sense, senses_of, weaken
from marlbc_mj.core.laws import allocation_free, compiled, threaded
from marlbc_mj.core.motion import move
from marlbc_mj.core.nullspace import add_behavior
from marlbc_mj.engine.body import DIVERGED, actuate, measure, scale_rows
from marlbc_mj.engine.limits import keep, limit
from marlbc_mj.engine.native import as_behavior, as_controller, as_disturbance, call_step, doubles

SCRATCH = 9
"""Rows of ``scratch`` (SCRATCH + 2N, 2) that a mission step needs besides drag and force of N agents."""

VIOLATION_REWARD = -10.0  # (14), whatever the formation
FORMATION_REWARD = 5.0  # (14), times G
SWITCH_REWARD = -3.0  # (15), once per team (erratum 11)


@allocation_free
def path_at(t, path, out):  # type: ignore[no-untyped-def]
    """Desired centroid and its velocity at ``t`` [s]: ``out`` (2, 2) from ``path`` (2, 2) = origin [m], velocity [m/s]."""
    for axis in range(2):
        out[0, axis] = path[0, axis] + t * path[1, axis]
        out[1, axis] = path[1, axis]


@allocation_free
def judge(p, obstacles, formations, tolerance, safe_distance, clearance, scratch):  # type: ignore[no-untyped-def]
    """Clearances, formation identifier G and r1 (14) of a team at positions ``p`` (N, 2).

    ``formations`` (2, N, 2): slots of G = 2, then of G = 1. ``clearance`` (N,) is written in place. Returns (G, r1).
    """
    fill_clearance(p, obstacles, scratch[0, :0], clearance, scratch[0])
    return verdict(p, clearance, formations, tolerance, safe_distance)


@allocation_free
def fill_clearance(p, obstacles, grid, clearance, normal):  # type: ignore[no-untyped-def]
    """Clearance (N,) [m] of every agent at ``p`` (N, 2), by a grid if ``grid`` has room for one; ``normal`` (2,) is scratch."""
    count = obstacles.shape[0]
    near = grid.shape[0] > 0 and count > 0
    if near:
        fill(obstacles, grid[: room(count)])
    for i in range(p.shape[0]):
        k = nearest(p[i], obstacles, grid[: room(count)], -1) if near else -1
        clearance[i] = nearest_obstacle(p[i], obstacles[k : k + 1] if k >= 0 else obstacles, normal)


@allocation_free
def verdict(p, clearance, formations, tolerance, safe_distance):  # type: ignore[no-untyped-def]
    """Formation identifier G and r1 (14) of a team at positions ``p`` (N, 2) with ``clearance`` (N,) [m]."""
    agents = p.shape[0]
    violated = False
    for i in range(agents):
        violated |= clearance[i] <= safe_distance
    mean_x, mean_y = 0.0, 0.0
    for i in range(agents):
        mean_x += p[i, 0] / agents
        mean_y += p[i, 1] / agents
    formation = 0
    for which in range(2):
        held = True
        for i in range(agents):
            x = p[i, 0] - mean_x - formations[which, i, 0]
            y = p[i, 1] - mean_y - formations[which, i, 1]
            held &= x * x + y * y <= tolerance * tolerance
        if held:
            formation = 2 - which
            break
    return formation, VIOLATION_REWARD if violated else FORMATION_REWARD * formation


@allocation_free
def valid_orders(orders, count):  # type: ignore[no-untyped-def]
    """Whether every one of ``orders`` (B, N) is an index below ``count``."""
    valid = True
    for b in range(orders.shape[0]):
        for i in range(orders.shape[1]):
            valid &= 0 <= orders[b, i] < count
    return valid


@allocation_free
def count_switches(orders, command_of, commands, step):  # type: ignore[no-untyped-def]
    """Turn orders (N,) into commands, in place, and return r2 (15); the first mission step switches nothing."""
    switched = False
    for i in range(orders.shape[0]):
        command = command_of[orders[i]]
        switched |= step > 0 and command != commands[i]
        commands[i] = command
    return SWITCH_REWARD if switched else 0.0


@allocation_free
def set_references(  # type: ignore[no-untyped-def]
    behavior_laws, behavior_params, sees, table, orders, at, path, obstacles, grid, scratch, v_r
):
    """Reference velocity of every agent at positions ``at`` (N, 2): its behaviors composed in its order (12).

    A behavior is evaluated only if those above it leave a direction free. ``sees`` (M,) says what each looks at; ``grid`` has
    room for one of the obstacles and one of the team, or is empty, which hands everything to every law. ``scratch``: (3 + 2n, n).
    """
    n, count = at.shape[1], obstacles.shape[0]
    velocity, jacobian, basis, pair = scratch[0], scratch[1 : 1 + n], scratch[1 + n : 1 + 2 * n], scratch[1 + 2 * n : 3 + 2 * n]
    things, others = grid[: room(count)], grid[room(count) :]
    near = grid.shape[0] > 0
    if near:
        fill(obstacles, things)
        fill(at, others)
    for i in range(at.shape[0]):
        for axis in range(n):
            v_r[i, axis] = 0.0
        rank = 0
        for j in table[orders[i]]:
            if rank == n:
                break
            seen, team, own = obstacles, at, i
            if near and sees[j] == NEAREST_OBSTACLE:
                k = nearest(at[i], obstacles, things, -1)
                if k >= 0:
                    seen = obstacles[k : k + 1]
            elif near and sees[j] == NEAREST_NEIGHBOR:
                k = nearest(at[i], at, others, i)
                if k >= 0:
                    own = 1 if i > k else 0
                    for axis in range(n):
                        pair[own, axis], pair[1 - own, axis] = at[i, axis], at[k, axis]
                    team = pair
            law = as_behavior(behavior_laws[j])
            rows = law(behavior_params[j, i], at[i], path, seen, team, own, velocity, jacobian)
            rank = add_behavior(velocity, jacobian, rows, basis, rank, v_r[i])


@register_jitable
def team_forces(  # type: ignore[no-untyped-def]
    controller_law, controller_params, disturbance_law, disturbance_params, t, h, p, v, seen_p, seen_v, p_r, v_r, state, unit,
    drag, force,
):  # fmt: skip
    """Drag and controller force of every agent for one substep, written to ``drag`` and ``force`` (N, 2) [N].

    The law sees ``seen_p`` and ``seen_v``, which are p and v where sensors are perfect; its force counts in ``unit`` [N].
    Returns 0, or 1 + agent where a position, velocity, force or drag left the physical range; then nothing may be stepped.
    """
    disturbance = as_disturbance(disturbance_law)
    controller = as_controller(controller_law)
    disturbance(disturbance_params, t, p, v, drag)
    if unit == 1.0:
        controller(controller_params, state, seen_p, seen_v, p_r, v_r, drag, h, force)
    else:
        scale_rows(drag, 1.0 / unit)
        controller(controller_params, state, seen_p, seen_v, p_r, v_r, drag, h, force)
        scale_rows(drag, unit)
        scale_rows(force, unit)
    for i in range(p.shape[0]):
        size = 0.0
        for axis in range(2):
            size += abs(p[i, axis]) + abs(v[i, axis]) + abs(drag[i, axis]) + abs(force[i, axis])
        if not size < DIVERGED:
            return 1 + i
    return 0


@register_jitable
def run_substeps(  # type: ignore[no-untyped-def]
    step_function, model, data, qpos, qvel, ctrl, applied, actuator_force, indices, body, senses, unit, controller_law,
    controller_params, disturbance_law, disturbance_params, t, h, substeps, p, v, p_r, v_r, state, robot_state, history, sensed,
    seed, count, drag, force, record,
):  # fmt: skip
    """All substeps of one mission step of one world, with v_r held. Returns 0, or 1 + agent + N * substep that diverged.

    Args:
        data, qpos, qvel, ctrl, applied, actuator_force: MjData and its arrays; ``applied`` is qfrc_applied, which takes the drag.
        indices: (3, N, 2), where in qpos, in qvel and in ctrl an agent's two axes are.
        body: drive, reading, spans, params of the robots; senses: the numbers of :class:`Imperfections`; unit: of forces [N].
        p, v, p_r, v_r: (N, 2) [m, m/s], changed in place; state: (N, S), the controllers' own, changed in place.
        robot_state: (N, S), the robots' own; history, sensed, seed: of :func:`sense`; count: substeps made since reset.
        drag, force: (N, 2) [N], scratch.
        record: (substeps, N, 10): p, v, p_r, v_r as the law saw them and the force MuJoCo applied; (0, N, 10) records nothing.
    """
    agents = p.shape[0]
    direct = body[2].shape[1] == 0
    seen_p, seen_v = (sensed[0], sensed[1]) if sensed.shape[0] > 0 else (p, v)
    for k in range(substeps):
        failed = team_forces(
            controller_law, controller_params, disturbance_law, disturbance_params, t + k * h, h, p, v, seen_p, seen_v, p_r,
            v_r, state, unit, drag, force,
        )  # fmt: skip
        if failed:
            return failed + agents * k
        if senses[2] > 0.0:
            weaken(senses_of(senses), t + k * h, force)
        failed = actuate(body, robot_state, indices, qpos, qvel, force, h, ctrl)
        if failed:
            return failed + agents * k
        for i in range(agents):
            for axis in range(2):
                applied[indices[1, i, axis]] = drag[i, axis]
        call_step(step_function, model, data)
        if record.shape[0] > 0:
            for i in range(agents):
                for axis in range(2):
                    record[k, i, axis] = p[i, axis]
                    record[k, i, 2 + axis] = v[i, axis]
                    record[k, i, 4 + axis] = p_r[i, axis]
                    record[k, i, 6 + axis] = v_r[i, axis]
        measure(body, robot_state, indices, qpos, qvel, actuator_force, p, v, force)
        for i in range(agents):
            for axis in range(2):
                if record.shape[0] > 0:
                    record[k, i, 8 + axis] = actuator_force[indices[2, i, axis]] if direct else force[i, axis]
                p_r[i, axis] += h * v_r[i, axis]
        if sensed.shape[0] > 0:
            sense(senses_of(senses), seed, count + k + 1, history, p, v, sensed)
    return 0


team_forces_compiled = allocation_free(team_forces)
_run_substeps_compiled = allocation_free(run_substeps)


@allocation_free
def begin_step(  # type: ignore[no-untyped-def]
    t, step, virtual, behavior_laws, behavior_params, sees, table, command_of, path, orders, given, obstacles, p, p_r, v_r,
    commands, scratch, grid,
):  # fmt: skip
    """Orders (N,) become commands and reference velocities for the mission step that starts at t. Returns r2 (15).

    ``given`` (N, 2) [m/s] is taken as v_r as it is; (0, 2) has the orders composed.
    """
    if given.shape[0] > 0:
        for i in range(v_r.shape[0]):
            for axis in range(2):
                v_r[i, axis] = given[i, axis]
    else:
        now = scratch[:2]
        path_at(t, path, now)
        at = p_r if virtual else p
        set_references(behavior_laws, behavior_params, sees, table, orders, at, now, obstacles, grid, scratch[2:SCRATCH], v_r)
    return count_switches(orders, command_of, commands, step)


@allocation_free
def mission_step(  # type: ignore[no-untyped-def]
    b,
    # fixed for all worlds
    step_function, model, indices, sizes, drive, reading, spans, robot_params, senses, limits, controller_law, controller_params,
    disturbance_law, behavior_laws, behavior_params, sees, table, command_of, path, formations, settings,
    # one row a world
    data, disturbance_params, obstacles, orders, given, commands, p, v, p_r, v_r, state, clearance, formation, reward,
    steps, robot_state, history, sensed, seeds, anchors, motions, grid, status, record, scratch,
):  # fmt: skip
    """One mission step of world ``b``. ``sizes`` = nq, nv, nu; ``settings`` = mission step [s], substep [s], tolerance
    [m], safe distance [m], virtual (0/1);
    ``limits`` = speed [m/s], acceleration [m/s^2], force unit [N]; ``given`` = v_r (B, N, 2) [m/s], or (B, 0, 2) where the orders
    make it; ``motions`` (B, K, 6), or (B, 0, 6) where ``obstacles`` stay.
    """
    t = steps[b] * settings[0]
    agents = p.shape[1]
    drag, force = scratch[b, SCRATCH : SCRATCH + agents], scratch[b, SCRATCH + agents :]
    seen = sensed[b, 0] if sensed.shape[1] > 0 else p[b]
    keep(limits, v_r[b], drag)
    r2 = begin_step(
        t, steps[b], settings[4] != 0.0, behavior_laws, behavior_params, sees, table, command_of, path, orders[b], given[b],
        obstacles[b], seen, p_r[b], v_r[b], commands[b], scratch[b], grid[b],
    )  # fmt: skip
    limit(limits, settings[0], drag, v_r[b])
    substeps = round(settings[0] / settings[1])
    body = (drive, reading, spans, robot_params)  # numba shares no tuples out over threads
    status[b] = _run_substeps_compiled(
        step_function, model, data[b, 0], doubles(data[b, 1], sizes[0]), doubles(data[b, 2], sizes[1]),
        doubles(data[b, 3], sizes[2]), doubles(data[b, 4], sizes[1]), doubles(data[b, 5], sizes[2]), indices, body, senses,
        limits[2], controller_law, controller_params, disturbance_law, disturbance_params[b], t, settings[1], substeps, p[b],
        v[b], p_r[b], v_r[b], state[b], robot_state[b], history[b], sensed[b], seeds[b], steps[b] * substeps, drag, force,
        record[b],
    )  # fmt: skip
    if motions.shape[1] > 0:
        move((steps[b] + 1) * settings[0], anchors[b], motions[b], obstacles[b])
    fill_clearance(p[b], obstacles[b], grid[b], clearance[b], scratch[b, 0])
    formation[b], r1 = verdict(p[b], clearance[b], formations, settings[2], settings[3])
    reward[b] = r1 + r2
    steps[b] += 1
    return 1 if status[b] else 0


@compiled
def step_serial(worlds, *args):  # type: ignore[no-untyped-def]
    """:func:`mission_step` of every world, one after the other. Returns how many failed."""
    failed = 0
    for b in range(worlds):
        failed += mission_step(b, *args)
    return failed


@threaded
def step_parallel(worlds, *args):  # type: ignore[no-untyped-def]
    """:func:`mission_step` of every world, worlds shared out over numba's threads; the same numbers as in series."""
    failed = 0
    for b in numba.prange(worlds):
        failed += mission_step(b, *args)
    return failed


@compiled
def roll_out(b, sequence, orders, reward, *args):  # type: ignore[no-untyped-def]
    """One mission step after the other of world ``b``, with the orders ``sequence`` (M, B, N); ``orders`` and ``reward`` are
    the arrays inside ``args``. Returns the sum of rewards, up to the step that failed if one did.
    """
    total = 0.0
    for m in range(sequence.shape[0]):
        orders[b] = sequence[m, b]
        failed = mission_step(b, *args)
        if failed:
            break
        total += reward[b]
    return total


@compiled
def rollout_serial(worlds, returns, *args):  # type: ignore[no-untyped-def]
    """:func:`roll_out` of every world, one after the other."""
    for b in range(worlds):
        returns[b] = roll_out(b, *args)


@threaded
def rollout_parallel(worlds, returns, *args):  # type: ignore[no-untyped-def]
    """:func:`roll_out` of every world, worlds shared out over numba's threads; the same numbers as in series."""
    for b in numba.prange(worlds):
        returns[b] = roll_out(b, *args)

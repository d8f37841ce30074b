"""Arguments of the loop: flat records of arrays and numbers. B worlds, N agents, K obstacles."""

from typing import Any, NamedTuple

import numpy as np


class MissionRules(NamedTuple):
    """The time steps of a mission and the criteria by which it is judged."""

    mission_step: float  # time between decisions [s]
    substep: float  # h: time step of control and physics [s]
    substeps: int  # number of substeps per mission step
    formations: np.ndarray  # (2, N, 2) slots around the centroid: for G = 2, then for G = 1 [m]
    tolerance: float  # greatest distance from a slot [m]
    safe_distance: float  # d_OA [m]


class Plant(NamedTuple):
    """The numbers of robots, controllers and sensors that are the same for all worlds."""

    qpos_index: np.ndarray  # (N, 2) indices of each agent's axes in qpos
    qvel_index: np.ndarray  # (N, 2) indices of each agent's axes in qvel
    ctrl_index: np.ndarray  # (N, 2) indices of each agent's motors in ctrl; -1 for robots that are not direct
    groups: np.ndarray  # (G, 2) int64 first and last + 1 of adjacent agents with the same robot, for robots that are not direct
    nq: int
    nv: int
    nu: int
    spans: np.ndarray  # (N, 3, 2) first and last + 1 index of each robot in qpos, qvel, ctrl; zeros for a direct robot
    robot_params: np.ndarray  # (N, P) gains of drive and reading
    masses: np.ndarray  # (N,) mass that planar forces accelerate [kg]
    controller_params: np.ndarray  # (N, P) gains of the controller
    unit_forces: np.ndarray  # (N,) unit of the controllers' forces [N]; (0,) if all are 1 N
    position_noise: float  # standard deviation of sensors, see Senses [m]
    velocity_noise: float  # standard deviation of sensors [m/s]
    loss: float  # share of the force that is lost
    loss_agent: float  # index of the agent that loses force; negative: all agents
    loss_start: float  # time from which force is lost [s]
    shield: np.ndarray  # (1,) record of ShieldNumbers; NO_SHIELD if the team has no shield


class Native(NamedTuple):
    """What the loop calls or reads by address: addresses for compiled code, the objects themselves for the Python path."""

    shield_references: Any  # entry of loop.shield_references; no_entry if the team has no such shield
    shield_forces: Any  # entry of loop.shield_forces; likewise
    step: Any  # mj_step
    model: Any  # MjModel
    controller: Any  # law of the whole team
    disturbance: Any  # law of the whole team
    drives: Any  # (G,) law of each group of the plant
    readings: Any  # (G,) law of each group of the plant
    data: Any  # (B,) MjData
    qpos: Any  # (B,) qpos of each MjData; likewise for the next ones
    qvel: Any
    ctrl: Any
    applied: Any  # qfrc_applied, which takes the drag
    actuator_force: Any


class Team(NamedTuple):
    """All state that changes while B teams of N agents run: one row per world, changed in place by the loop."""

    steps: np.ndarray  # (B,) int64, number of completed mission steps
    position: np.ndarray  # (B, N, 2) [m]
    velocity: np.ndarray  # (B, N, 2) [m/s]
    reference: np.ndarray  # (B, N, 2) p_r [m]
    reference_velocity: np.ndarray  # (B, N, 2) v_r [m/s]
    controller: np.ndarray  # (B, N, S) the controllers' own state
    command: np.ndarray  # (B, N) int64, index into scenario.orders.commands
    since: np.ndarray  # (B, N) mission step at which each command came into force, or NEVER
    clearance: np.ndarray  # (B, N) [m]
    formation: np.ndarray  # (B,) int64, G
    reward: np.ndarray  # (B,) r1 + r2 of the last mission step
    obstacles: np.ndarray  # (B, K, 3) x, y, radius [m]; (B, K, 5) with their velocity [m/s] if they move
    anchors: np.ndarray  # (B, K, 3) anchors of moving obstacles, see motion.move; (B, 0, 3) if they are at rest
    motions: np.ndarray  # (B, K, 6) their motions, see motion.NUMBERS; (B, 0, 6) if they are at rest
    disturbance_params: np.ndarray  # (B, P) gains of the disturbance
    robot: np.ndarray  # (B, N, S) the robots' own state
    history: np.ndarray  # (B, D, 2, N, 2) ring buffer of p and v, for delayed sensors
    sensed: np.ndarray  # (B, 2, N, 2) measured p and v; (B, 0, N, 2) if sensors are exact
    noise_seed: np.ndarray  # (B,) int64, see Observation
    status: np.ndarray  # (B,) int64, 0, or 1 + agent + N * substep of a divergence in the last mission step
    drag: np.ndarray  # (B, N, 2) drag in the last substep [N]; before the first substep, v_r of the previous mission step
    force: np.ndarray  # (B, N, 2) force in the last substep: the controller's, then that of the actuators [N]
    workspace: np.ndarray  # (B, W, 2) scratch, see marlbc_mj.engine.inequalities.workspace_rows
    grid: np.ndarray  # (B, G) scratch: grids of obstacles and team, G = 0 if grids do not pay off
    interventions: np.ndarray  # (B, N) number of substeps in which the shield changed something; (B, 0) without a shield
    force_change: np.ndarray  # (B, N) integral of its change of the force [N s]
    breaches: np.ndarray  # (B, N, A) number of substeps in which its assumptions did not hold, see ShieldCounts
    last_substep: np.ndarray  # (B, N, 2, 2) v and u of the previous substep [m/s], [N]
    stopping: np.ndarray  # (B, N) scratch: stopping distances [m]
    looked: np.ndarray  # (B, N, 3) scratch of a shield, see marlbc_mj.core.lookout; (B, 0, 3) without a look-out
    seen: np.ndarray  # (B, K, 3) scratch of a shield, obstacles at the last look; (B, 0, 3) without a look-out
    around: np.ndarray  # (B, N, L) int64 scratch of a shield, things near each agent; (B, 0, L) without a look-out
    near: np.ndarray  # (B, M) int64 scratch of a shield, things that may matter to the current agent; (B, 0) without a shield
    stamps: np.ndarray  # (B, N, N, 2) live stamps, see marlbc_mj.core.stamps; (B, 0, 0, 2) if agents know all states
    planes: np.ndarray  # (B, N, N, 2, 3) their half-planes
    memory: np.ndarray  # (B, R, N, 3) past p and stopping distances [m], see Mail
    sent_stamps: np.ndarray  # (B, R, N, N) newest stamps in those substeps, see Mail
    tracks: np.ndarray  # (B, K, 5) scratch of a shield: moving obstacles at the current time; (B, 0, 5) if all are at rest


class Record(NamedTuple):
    """Every substep of one mission step: the motion of the team, and the planar force that its actuators applied."""

    position: np.ndarray  # (B, substeps, N, 2) [m]
    velocity: np.ndarray  # (B, substeps, N, 2) [m/s]
    reference: np.ndarray  # (B, substeps, N, 2) p_r [m]
    reference_velocity: np.ndarray  # (B, substeps, N, 2) v_r [m/s]
    force: np.ndarray  # (B, substeps, N, 2) actuator_force of a direct robot, otherwise the force of its reading [N]


class Arguments(NamedTuple):
    """What a World passes to the loop in every mission step, besides orders and velocities: the records above.

    Each is a reference if the loop is compiled; ``behaviors`` always is.
    """

    mission: Any
    behaviors: Any
    native: Any
    plant: Any
    team: Any
    record: Any

"""What the loop is handed: flat records of arrays and numbers. B worlds, N agents, K obstacles."""

from typing import Any, NamedTuple

import numpy as np


class MissionRules(NamedTuple):
    """The mission's clocks and what it is judged by."""

    mission_step: float  # between decisions [s]
    substep: float  # h, of control and physics [s]
    substeps: int  # per mission step
    formations: np.ndarray  # (2, N, 2) slots around the centroid: of G = 2, then of G = 1 [m]
    tolerance: float  # of a slot [m]
    safe_distance: float  # d_OA [m]


class Plant(NamedTuple):
    """The numbers of robots, controllers and sensors that are the same for all worlds."""

    qpos_index: np.ndarray  # (N, 2) where each agent's axes are in qpos
    qvel_index: np.ndarray  # (N, 2) in qvel
    ctrl_index: np.ndarray  # (N, 2) in ctrl; -1 for robots that are not direct
    groups: np.ndarray  # (G, 2) int64 first and last + 1 of adjacent agents with the same robot, where that is not direct
    nq: int
    nv: int
    nu: int
    spans: np.ndarray  # (N, 3, 2) first and last + 1 of each robot in qpos, qvel, ctrl; zeros for a direct robot
    robot_params: np.ndarray  # (N, P) of drive and reading
    masses: np.ndarray  # (N,) that planar forces accelerate [kg]
    controller_params: np.ndarray  # (N, P)
    unit_forces: np.ndarray  # (N,) in which controllers count [N]; (0,) where all are 1 N
    position_noise: float  # of sensors, see Senses [m]
    velocity_noise: float  # [m/s]
    loss: float  # share of the force that is lost
    loss_agent: float  # whose; negative: everybody's
    loss_start: float  # from then on [s]
    shield: np.ndarray  # (1,) records of ShieldNumbers: what a shield assumes and keeps, where the team has one


class Native(NamedTuple):
    """What is reached by address: addresses for compiled code, the objects themselves for the Python path."""

    shield_references: Any  # entry of the loop's part of this name; unset where the team has no such shield
    shield_forces: Any
    step: Any  # mj_step
    model: Any  # MjModel
    controller: Any  # law of the whole team
    disturbance: Any  # law of the whole team
    drives: Any  # (G,) a law of each group of the plant
    readings: Any  # (G,) a law of each group
    data: Any  # (B,) MjData
    qpos: Any  # (B,) its arrays
    qvel: Any
    ctrl: Any
    applied: Any  # qfrc_applied, which takes the drag
    actuator_force: Any


class Team(NamedTuple):
    """All that changes while B teams of N agents run: one row per world, changed in place by the loop."""

    steps: np.ndarray  # (B,) int64, mission steps made
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
    obstacles: np.ndarray  # (B, K, 3) x, y, radius [m]; (B, K, 5) with their velocity [m/s] where they move
    anchors: np.ndarray  # (B, K, 3) where moving obstacles come from; (B, 0, 3) where they are at rest
    motions: np.ndarray  # (B, K, 6) how they move, or (B, 0, 6)
    disturbance_params: np.ndarray  # (B, P)
    robot: np.ndarray  # (B, N, S) the robots' own state
    history: np.ndarray  # (B, D, 2, N, 2) p and v, for delayed sensors
    sensed: np.ndarray  # (B, 2, N, 2) measured p and v; (B, 0, N, 2) where they are the true ones
    noise_seed: np.ndarray  # (B,) int64
    status: np.ndarray  # (B,) int64, 0, or 1 + agent + N * substep that diverged in the last mission step
    drag: np.ndarray  # (B, N, 2) of the last substep [N]; before the first one, v_r of the last mission step
    force: np.ndarray  # (B, N, 2) of the last substep: the law's, then what the actuators gave [N]
    workspace: np.ndarray  # (B, W, 2) scratch, see marlbc_mj.engine.plan.workspace_rows
    grid: np.ndarray  # (B, G) scratch: grids of obstacles and team, G = 0 where none pays
    interventions: np.ndarray  # (B, N) substeps of the episode in which the shield changed something; (B, 0) without a shield
    force_change: np.ndarray  # (B, N) integral of what it changed [N s]
    breaches: np.ndarray  # (B, N, A) substeps in which its assumptions did not hold, see ShieldCounts
    last_substep: np.ndarray  # (B, N, 2, 2) v and u of the substep before [m/s], [N]
    stopping: np.ndarray  # (B, N) scratch: stopping distances [m]
    looked: np.ndarray  # (B, N, 3) scratch of a shield, see marlbc_mj.core.lookout; (B, 0, 3) where it is of no use
    seen: np.ndarray  # (B, K, 3) scratch of a shield, obstacles at the last look; (B, 0, 3) likewise
    around: np.ndarray  # (B, N, L) int64 scratch of a shield, what is around each agent; (B, 0, L) likewise
    near: np.ndarray  # (B, M) int64 scratch of a shield, what may be too near to the agent at hand; (B, 0) without one
    stamps: np.ndarray  # (B, N, N, 2) live stamps, see marlbc_mj.core.stamps; (B, 0, 0, 2) where all agents know all
    planes: np.ndarray  # (B, N, N, 2, 3) their half-planes
    memory: np.ndarray  # (B, R, N, 3) the past of a shield: p, stopping distance [m]
    said: np.ndarray  # (B, R, N, N) stamps that agents named then
    tracks: np.ndarray  # (B, K, 5) scratch of a shield: obstacles that move, where they are now; (B, 0, 5) where all are at rest


class Record(NamedTuple):
    """Every substep of one mission step: where the team was, and the planar force that its actuators gave."""

    position: np.ndarray  # (B, substeps, N, 2) [m]
    velocity: np.ndarray  # (B, substeps, N, 2) [m/s]
    reference: np.ndarray  # (B, substeps, N, 2) p_r [m]
    reference_velocity: np.ndarray  # (B, substeps, N, 2) v_r [m/s]
    force: np.ndarray  # (B, substeps, N, 2) actuator_force of a direct robot, or as its reading has it [N]


class Arguments(NamedTuple):
    """What a World hands to the loop at every mission step, besides orders: the records above, each by reference if the
    loop is compiled (behaviors always).
    """

    mission: Any
    behaviors: Any
    native: Any
    plant: Any
    team: Any
    record: Any

"""Write your own controller: a PID with anti-windup, compiled into the simulation loop."""

from dataclasses import dataclass

from marlbc_mj import Scripted, World, laws, measure, paper, run_episode


@laws.controller(gains=("position_gain", "velocity_gain", "integral_gain", "limit"), state={"integral": 2})
def pid(gains, state, p, v, p_r, v_r, drag, h, force_out):
    """Write the force of one agent to ``force_out``; the integral is frozen while the force is at its limit."""
    for axis in range(2):
        e_p, e_v = p[axis] - p_r[axis], v[axis] - v_r[axis]
        wanted = -gains.position_gain * e_p - gains.velocity_gain * e_v - gains.integral_gain * state.integral[axis]
        force_out[axis] = laws.clip(wanted, gains.limit)
        if force_out[axis] == wanted:
            state.integral[axis] += h * e_p


@dataclass(frozen=True)
class PID:
    """PID gains per unit mass, in 1/s^2, 1/s and 1/s^3."""

    position_gain: float = 100.0
    velocity_gain: float = 100.0
    integral_gain: float = 50.0
    limited: bool = True
    law = staticmethod(pid)

    @property
    def linear_gains(self):
        """The gains on the position and velocity errors."""
        return self.position_gain, self.velocity_gain

    def params(self, agent, limit):
        """The values of the gains for one agent, passed to ``pid`` as ``gains``."""
        return laws.gains_of(self, limit=limit)

    def initial_state(self, agent):
        """Initial values of the state, if not 0; the integral starts at 0."""
        return {}


if __name__ == "__main__":
    trajectory = run_episode(World(paper(duration=20.0), PID(), record=True), Scripted())
    print("RMS position error [m]", [round(agent["rms_position_error"], 4) for agent in measure(trajectory)["agents"]])

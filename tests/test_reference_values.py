"""Reference values from an independent NumPy prototype of the same equations: results agree in every digit given."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from marlbc_mj.controllers import SORLC
from marlbc_mj.core.behaviors import clearances
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.results.metrics import measure
from marlbc_mj.scenarios import paper
from marlbc_mj.supervisors import make_supervisor

ROOT = Path(__file__).resolve().parents[1]

TABLE = {  # scripted + SORLC with the published basis, virtual reference, 5 ms, one-sided OA, drag (43)
    "switches": (4, 2, 2, 4),
    "clearance_min": (2.098, 4.000, 3.322, 2.095),
    "force_max_inf": (200.0, 200.0, 200.0, 200.0),
    "force_max_2": (282.8, 282.8, 282.8, 282.8),
    "effort_integral": (143.18, 129.51, 179.21, 190.58),
    "cost_max": (82_560, 82_368, 89_280, 89_472),
    "cost_integral": (26_477, 24_493, 30_654, 32_322),
}


def agents(metrics, name: str) -> list[float]:
    return [agent[name] for agent in metrics["agents"]]


@pytest.mark.parametrize("controller", ["sorlc", "sorlc-off"])
@pytest.mark.parametrize("row", TABLE)
def test_scripted_sorlc_reproduces_the_reference_table(episode, controller, row):
    """Results agree with and without the networks, which make no difference with the published basis (erratum 13)."""
    measured = agents(measure(episode("scripted", controller)), row)
    assert measured == pytest.approx(TABLE[row], rel=2e-4)


@pytest.mark.parametrize("controller", ["sorlc", "sorlc-off"])
def test_scripted_sorlc_returns_15017_and_never_violates(episode, controller):
    """The return is a sum of integers, so it is exact."""
    metrics = measure(episode("scripted", controller))
    assert metrics["team"]["return"] == 15017
    assert agents(metrics, "violation_time") == [0.0] * 4


def test_efforts_as_sums_over_samples(episode):
    """Table 6's totals are sums over samples (erratum 16): SORLC 2864/2590/3584/3812."""
    assert agents(measure(episode("scripted", "sorlc")), "effort_sum") == pytest.approx([2864, 2590, 3584, 3812], abs=0.5)


def test_actual_reference_costs_twice_the_effort(episode):
    """With the ``actual`` reference: return 15 492, effort 234.8/213.4/387.3/392.7, no violation."""
    metrics = measure(episode("scripted", "sorlc", reference="actual"))
    assert metrics["team"]["return"] == 15492
    assert agents(metrics, "effort_integral") == pytest.approx([234.8, 213.4, 387.3, 392.7], abs=0.05)
    assert agents(metrics, "violation_time") == [0.0] * 4


def test_two_sided_avoidance_settles_inside_the_safe_distance(episode):
    """Erratum 6: clearances 1.995 and 1.991 for agents 1 and 4, up to 1.7 s in violation."""
    metrics = measure(episode("scripted", "sorlc", two_sided=True))
    assert [agents(metrics, "clearance_min")[i] for i in (0, 3)] == pytest.approx([1.995, 1.991], abs=5e-4)
    times = agents(metrics, "violation_time")
    assert max(times) == pytest.approx(1.7, abs=0.05) and times[1] == times[2] == 0.0


def test_the_published_automaton_chatters_into_the_discs(episode):
    """FSAMS as published: switches 162/122/70/124, agents 3 and 4 inside discs."""
    metrics = measure(episode("fsams", "sorlc"))
    assert agents(metrics, "switches") == [162, 122, 70, 124]
    assert [d < 0.0 for d in agents(metrics, "clearance_min")][2:] == [True, True]


def test_a_finer_substep_changes_little():
    """1 ms instead of 5 ms: costs change by at most 7 %, clearances by 2 cm, switches not at all (three clocks, section 1)."""
    coarse, fine = (
        measure(run_episode(World(paper(duration=25.0, substep=h), record=True), make_supervisor("scripted")))
        for h in (0.005, 0.001)
    )
    assert agents(fine, "switches") == agents(coarse, "switches")
    assert agents(fine, "clearance_min") == pytest.approx(agents(coarse, "clearance_min"), abs=0.02)
    assert agents(fine, "cost_integral") == pytest.approx(agents(coarse, "cost_integral"), rel=0.07)


def test_the_scripted_team_keeps_its_slots(episode):
    """At the end every agent is at its target, (100, +-6) or (95, +-12), up to the last 5 ms of motion."""
    trajectory = episode("scripted", "sorlc")
    np.testing.assert_allclose(trajectory.position[-1], [(100, 6), (100, -6), (95, 12), (95, -12)], atol=0.1)
    assert (clearances(trajectory.position, trajectory.obstacles) > 2.0).all()


def test_the_scaled_basis_keeps_learning_and_the_published_one_does_not(episode):
    """At 30 s, on the slots, e_p = f / 100 with PD alone and the published identifier; the scaled one leaves under a tenth."""
    drag_of_agent_1 = np.sin(6.0) ** 2  # v = (1, 0) at y = 6
    published, scaled, off = (
        float(np.abs(t.position[6000] - t.reference[6000])[0, 0])
        for t in (episode("scripted", name) for name in ("sorlc", "sorlc-scaled", "sorlc-off"))
    )
    assert published == pytest.approx(off, rel=1e-3) == pytest.approx(drag_of_agent_1 / 100.0, rel=0.1)
    assert scaled < 0.1 * off


SCRIPT = """
import sys
import numpy as np
from marlbc_mj.engine.world import World
from marlbc_mj.episode import run_episode
from marlbc_mj.scenarios import paper
from marlbc_mj.supervisors import make_supervisor

world = World(paper(duration=0.5), record=True)
assert not world.native
t = run_episode(world, make_supervisor("scripted"))
np.savez(sys.argv[1], position=t.position, velocity=t.velocity, force=t.force, reference=t.reference,
         controller_state=t.controller_state, reward=t.reward, command=t.command)
"""


def test_without_numba_the_same_source_gives_the_same_numbers(tmp_path):
    """NUMBA_DISABLE_JIT=1 runs every law as plain Python: 100 substeps equal to 1e-12."""
    out = tmp_path / "plain.npz"
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(ROOT)}
    done = subprocess.run([sys.executable, "-c", SCRIPT, str(out)], env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    compiled = run_episode(World(paper(duration=0.5), SORLC(), record=True), make_supervisor("scripted"))
    with np.load(out) as plain:
        for name in plain.files:
            expected = getattr(compiled, name)
            np.testing.assert_allclose(plain[name], expected, rtol=1e-12, atol=1e-12 * max(1.0, np.abs(expected).max()))

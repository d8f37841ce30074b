"""The search finds the velocity gains of the baselines again, which come from the maxima in Table 6."""

from dataclasses import replace

import numpy as np
import pytest

from marlbc_mj.cli import main
from marlbc_mj.controllers import make_controller
from marlbc_mj.report.paper_values import PUBLISHED_INPUT_MAX
from marlbc_mj.scenarios import Scenario, Window, paper
from marlbc_mj.scenarios.case_study import SLOTS
from marlbc_mj.studies.calibration import CALIBRATED, Calibration, calibrate, calibration_lines, maxima
from marlbc_mj.util.errors import ConfigurationError, SimulationError


@pytest.fixture(scope="module")
def switch() -> Scenario:
    """A switch to the column after 0.5 s in formation; the maxima occur there (see test_maxima_occur_at_the_switch)."""
    starts = tuple((x - 2.5, y) for x, y in SLOTS)
    return paper(starts=starts, duration=1.0, schedule=(Window(0.5, 2.0, -1, "FR"),))


@pytest.fixture(scope="module", params=list(CALIBRATED))
def result(request: pytest.FixtureRequest, switch: Scenario) -> Calibration:
    return calibrate(request.param, switch, tolerance=1e-4)


def test_search_finds_the_published_maximum(result: Calibration) -> None:
    """The largest maximum is the published one, within the tolerance; the found and the shipped gain differ by less than 1 %."""
    assert max(result.at_found) == pytest.approx(max(result.published), rel=1e-4)
    assert result.found == pytest.approx(result.shipped, rel=0.01)
    assert result.shipped == CALIBRATED[result.controller].velocity_gain
    assert result.episodes < 12


def test_one_gain_explains_all_agents_but_one(result: Calibration) -> None:
    """All maxima are within half a percent of the published ones, except that of agent 2 under fixed-time."""
    exceptions = {"finite-time": set(), "fixed-time": {1}}[result.controller]
    for errors in (result.errors, result.shipped_errors):
        assert {agent for agent, error in enumerate(errors) if abs(error) > 0.005} == exceptions


@pytest.mark.parametrize("name", list(CALIBRATED))
def test_maxima_occur_at_the_switch(name: str, switch: Scenario) -> None:
    """The whole case study and the short scenario have the same maxima, to a relative 1e-3."""
    np.testing.assert_allclose(maxima(CALIBRATED[name], paper()), maxima(CALIBRATED[name], switch), rtol=1e-3)


def test_shipped_gains_are_the_registered_ones() -> None:
    """The calibrated laws are the registered controllers, and there are published maxima for each."""
    for name, law in CALIBRATED.items():
        assert make_controller(name) == law
        assert name in PUBLISHED_INPUT_MAX.values


def test_wrong_requests_are_refused(switch: Scenario) -> None:
    with pytest.raises(ConfigurationError, match="unknown calibrated controller 'pd'; choose from: finite-time, fixed-time"):
        calibrate("pd")
    with pytest.raises(ConfigurationError, match="tolerance must be positive"):
        calibrate("finite-time", switch, tolerance=0.0)
    with pytest.raises(SimulationError, match="no gain from 2 to 32 /s gives the published maximum"):
        calibrate("finite-time", replace(switch, schedule=(Window(0.0, 0.0, -1, "FM"),)))


def test_command_prints_the_table(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, switch: Scenario) -> None:
    """The table has three rows per controller: published, found, shipped. An unknown controller gives a one-line error."""
    monkeypatch.setattr("marlbc_mj.studies.calibration.paper", lambda: switch)
    main(["calibrate", "--controllers", "fixed-time"])
    lines = capsys.readouterr().out.splitlines()
    rows = [line.split("|")[1].strip() for line in lines[2:]]
    assert rows == ["fixed-time, published", "fixed-time, found", "fixed-time, shipped"]
    with pytest.raises(SystemExit) as stopped:
        main(["calibrate", "--controllers", "pd"])
    assert stopped.value.code == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_table_has_a_row_for_each_gain() -> None:
    made = Calibration("x", (384.0, 768.0), 7.9, 8.0, (383.99999, 768.0), (385.0, 769.0), 5)
    assert calibration_lines([made])[2:] == [
        "| x, published | – | 384 / 768 | – |",
        "| x, found | 7.9000 | 384.00 / 768.00 | +0.00% / +0.00% |",
        "| x, shipped | 8.0000 | 385.00 / 769.00 | +0.26% / +0.13% |",
    ]

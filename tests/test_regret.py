"""Return relative to the best schedule that a search finds: the searched instance, the bound and the table."""

from dataclasses import replace

import numpy as np
import pytest

from marlbc_mj import World, make_scenario, make_supervisor, run_episode
from marlbc_mj.cli import main
from marlbc_mj.scenarios import held_out
from marlbc_mj.studies import regret
from marlbc_mj.studies.regret import RegretStudy, frozen, regret_table
from marlbc_mj.util.errors import ConfigurationError


def short(name: str):
    return replace(held_out(make_scenario(name, composition="set-based")), duration=3.0)


@pytest.mark.parametrize("name", ["gates", "field"])
def test_the_instance_is_what_the_seed_draws(name: str) -> None:
    """An episode in the instance equals the seed's episode to the last bit, whatever its own seed."""
    drawn = run_episode(World(short(name), record=True), make_supervisor("fixed"), seed=90_003)
    instance = run_episode(World(frozen(short(name), 90_003), record=True), make_supervisor("fixed"), seed=5)
    np.testing.assert_array_equal(instance.obstacles, drawn.obstacles)
    np.testing.assert_array_equal(instance.position, drawn.position)
    np.testing.assert_array_equal(instance.reward, drawn.reward)


def test_the_best_is_no_worse_than_what_was_flown(tmp_path, monkeypatch, capsys) -> None:
    """The command writes a line per layout; the search begins with the best schedule flown."""
    monkeypatch.setattr(regret, "_mission", short)
    out = tmp_path / "out"
    main(["regret", "field", "--supervisors", "fixed", "--layouts", "2", "--budget", "64", "--out", str(out)])
    assert "Fixed priority" in capsys.readouterr().out
    lines = [line.split(",") for line in (out / "regret.csv").read_text().splitlines()]
    assert lines[0] == ["mission", "seed", "best", "fixed"] and [line[1] for line in lines[1:]] == ["90000", "90001"]
    assert all(float(best) >= float(flown) for _, _, best, flown in lines[1:])


def test_shares_are_of_the_best_of_each_layout() -> None:
    rows = [
        {"mission": "gates", "seed": 1, "best": 100.0, "fixed": 50.0},
        {"mission": "gates", "seed": 2, "best": 200.0, "fixed": 150.0},
    ]
    assert regret_table(rows, ["fixed"]).rows == (("gates", "2", "150", "62.5 [50.0]"),)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"missions": ("traffic",)}, "has moving obstacles"),
        ({"missions": ("paper",)}, "draws no layouts"),
        ({"missions": ()}, "at least one mission"),
        ({"supervisors": ("fixes",)}, "unknown supervisor"),
        ({"budget": 63}, "at least 64, one population, got 63"),
        ({"layouts": 0}, "must be at least 1"),
    ],
)
def test_what_cannot_be_searched_is_refused(changes, said: str) -> None:
    with pytest.raises(ConfigurationError, match=said):
        RegretStudy(**{"missions": ("gates",), "supervisors": ("fixed",), **changes})

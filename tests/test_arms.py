"""Ablations of the general policy: the arms of the study, its trainings and missions, and the files that it writes."""

import csv
from pathlib import Path

import pytest

from marlbc_mj.cli import main
from marlbc_mj.studies.learners.arms import ARMS, ArmScore, ArmStudy, _standing, arms_table, success_of_seeds
from marlbc_mj.training.general.config import DRAWN, GeneralConfig
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import MANIFEST


def test_every_arm_changes_what_it_says():
    """Each arm changes one setting, but MAPPO also drops the switch cost; without a family, all other families remain."""
    for name, arm in ARMS.items():
        config = GeneralConfig(**arm.changes)
        assert (config == GeneralConfig()) == (name == "full") and len(arm.changes) <= (2 if name == "mappo" else 1)
    assert ARMS["mappo"].changes.items() > ARMS["no-switch-cost"].changes.items()
    for family in DRAWN:
        assert set(GeneralConfig(**ARMS[f"without-{family}"].changes).families) == set(DRAWN) - {family}


@pytest.mark.usefixtures("coarse_figures")
def test_a_study_trains_flies_and_reports(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """`marlbc arms` with a small team writes a table, a figure, and a CSV with a line per training and mission."""
    small = {"teams": ("wedge-4",), "families": ("gates",), "batch": 16, "updates": 1, "hidden": (8,), "capacity": 500}
    monkeypatch.setitem(ARMS, "no-pooling", ARMS["no-pooling"]._replace(changes={**ARMS["no-pooling"].changes, **small}))
    for name, value in (("MISSIONS", (("field", "wedge-4", "straight"),)), ("MARGINS", (0.05,)), ("TRIED", 1)):
        monkeypatch.setattr(f"marlbc_mj.studies.learners.arms.{name}", value)
    out = tmp_path / "out"
    main(["arms", "--arms", "no-pooling", "--seeds", "2", "--budget", "100", "--layouts", "1", "--out", str(out)])
    assert "no pooling" in capsys.readouterr().out
    assert {path.name for path in out.iterdir()} == {"arms.csv", "arms.md", "arms.pdf", "arms.png", "config.json", MANIFEST}
    with (out / "arms.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["seed"], row["mission"]) for row in rows] == [("1", "field, wedge-4"), ("2", "field, wedge-4")]
    assert all((row["arm"], row["mission_steps"], row["layouts"]) == ("no-pooling", "100", "1") for row in rows)
    assert {row["margin"] for row in rows} == {"0.05"}


def test_the_margin_is_that_with_the_most_successes_and_of_those_with_the_greatest_return():
    """Checked on made-up scores of three margins on two missions."""
    tried = {
        margin: [
            ArmScore(mission, 8, count, 0, total, 1.0, margin) for mission, count, total in (("a", 8, 50.0), ("b", least, more))
        ]
        for margin, least, more in ((0.0, 7, 90.0), (0.05, 8, 20.0), (0.3, 8, 30.0))
    }
    assert max(tried, key=lambda margin: _standing(tried[margin])) == 0.3


def test_shares_are_of_all_layouts_of_a_training():
    """Checked on made-up results of two trainings of one arm on two missions."""
    rows = [
        {"arm": "full", "seed": seed, "mission": mission, "layouts": 4, "succeeded": count, "violated": 1}
        for seed, mission, count in ((1, "a", 4), (1, "b", 2), (2, "a", 3), (2, "b", 0))
    ]
    assert success_of_seeds(rows, ["a", "b"]) == [75.0, 37.5]
    cells = arms_table(rows).rows[0]
    assert cells == ("VDN, the default", "2", "56.2 [37.5, 75.0]", "87.5", "25.0", "4 of 16")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"arms": ("no-pool",)}, "unknown arm 'no-pool'"),
        ({"arms": ("full", "full")}, "an arm is named twice: full, full"),
        ({"seeds": 0}, "seeds must be at least 1, got 0"),
        ({"budget": 0}, "budget must be at least 1, got 0"),
        ({"layouts": 0}, "layouts must be at least 1, got 0"),
    ],
)
def test_what_cannot_be_studied_is_refused(changes, said):
    with pytest.raises(ConfigurationError, match=said):
        ArmStudy(**changes)

"""One SIGKILL of the hundreds in ``make kills``, and planted faults that its checks must find."""

import random
from pathlib import Path

import kills
import numpy as np
import pytest


def test_a_killed_study_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With two workers, a killed study that is run again has the same output as an undisturbed one."""
    monkeypatch.setattr(kills, "_strike", lambda process, whom, rng: process.kill())
    killer = kills.Killer(tmp_path, "local", 2)
    (tmp_path / "digests-whole.json").write_text("3.0")
    assert killer.finish("digests", tmp_path / "digests-whole")[0] == 0
    said = killer.kill("digests", FirstResult())
    assert said["faults"] == [] and said["kills"] == 1 and 0 < said["kept"][0] < 40


class FirstResult(random.Random):
    """Choices that give one kill, soon after the first result."""

    def choice(self, choices):
        return 1 if 1 in choices else choices[0]

    def uniform(self, low: float, high: float) -> float:
        return low


def test_planted_faults_are_found(tmp_path: Path) -> None:
    """Faults are a torn file, an empty file, a different number and an extra file; times may differ."""
    whole, other = tmp_path / "whole", tmp_path / "other"
    for folder, text in ((whole, '{"a": 1, "wall_s": 2}'), (other, '{"a": 1, "wall_s": 3}')):
        folder.mkdir()
        (folder / "a.json").write_text(text)
    assert kills.differences(whole, other) == [] == kills.torn(other)
    (other / "a.json").write_text('{"a": 2')
    (other / "b.txt").write_text("")
    assert [fault.split(":")[0] for fault in kills.torn(other)] == ["a.json is torn", "b.txt is torn"]
    (other / "a.json").write_text('{"a": 2}')
    assert kills.differences(whole, other) == ["b.txt is in one only", "a.json differs"]


def test_logs_differ_where_an_array_does(tmp_path: Path) -> None:
    """Arrays within tuples, such as those of substeps, are compared, too."""
    one, other = (kills._plain((np.arange(3.0), (np.array([value]), "name"))) for value in (1.0, 2.0))
    assert one == kills._plain((np.arange(3.0), (np.array([1.0]), "name"))) and one != other

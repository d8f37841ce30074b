"""Ranks, chances of improvement and significance, against arithmetic by hand and by brute force."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.report import leaderboard
from marlbc_mj.report.leaderboard import make_boards
from marlbc_mj.results.layout_runs import LAYOUT_SCORES, LayoutRun, Method, MissionRuns
from marlbc_mj.results.standings import (
    behind,
    by_cost,
    by_return,
    improvement,
    median_interval,
    notable_layouts,
    on_common_layouts,
    rank_methods,
)
from marlbc_mj.util.errors import ConfigurationError

FACTS = {
    "suite": {"version": "v1", "hash": "0" * 64},
    "date": "2026-11-29",
    "cpu": "x",
    "code": "y",
    "git_revision": "z",
    "versions": {},
}
A, B, C = Method("a", "x"), Method("b", "x"), Method("c", "x")


def run(seed: int, success: bool, total: float = 0.0, failure: str = "", cost: float = 0.0) -> LayoutRun:
    scores = [0.0] * len(LAYOUT_SCORES)
    scores[LAYOUT_SCORES.index("return")], scores[LAYOUT_SCORES.index("cost_integral_sum")] = total, cost
    return LayoutRun(seed, failure, success, not success, not success, not success, False, 1.0, 0.1, tuple(scores))


def flown(method: Method, mission: str, successes: list[bool], total: float = 0.0, track: str = "t") -> MissionRuns:
    return MissionRuns(track, mission, method, tuple(run(k, success, total) for k, success in enumerate(successes)))


def test_ranks_are_averaged_over_layouts_and_then_over_missions() -> None:
    """a wins three layouts of the first mission, b ties it on the second, c is last everywhere."""
    group = [
        *(flown(m, "one", s) for m, s in ((A, [True, True, True]), (B, [False, False, False]))),
        *(flown(m, "two", [True]) for m in (A, B)),
        MissionRuns("t", "one", C, tuple(run(k, False, -1.0) for k in range(3))),
        MissionRuns("t", "two", C, (run(0, True, 0.0, "diverged"),)),
    ]
    rows = rank_methods(group, B)
    assert [row.method for row in rows] == [A, B, C]
    assert [row.rank.value for row in rows] == pytest.approx([(1 + 1.5) / 2, (2 + 1.5) / 2, 3.0])
    assert [row.improvement.value for row in rows] == pytest.approx([(1 + 0.5) / 2, 0.5, 0.0])
    assert [row.shares["success"].value for row in rows] == pytest.approx([1.0, 0.5, 0.5])


def test_success_comes_before_return_and_cost() -> None:
    assert by_return(run(0, True, -1e5)) > by_return(run(0, False, 1e5)) > by_return(run(0, True, 1e5, "diverged"))
    assert by_return(run(0, True, 2.0)) > by_return(run(0, True, 1.0))
    assert by_cost(run(0, True, cost=1e9)) > by_cost(run(0, False, cost=1.0))
    assert by_cost(run(0, True, cost=1.0)) > by_cost(run(0, True, cost=2.0))


def test_every_track_may_weigh_the_same() -> None:
    """One track has two missions, the other has one."""
    group = [flown(m, name, [m == A], track="first") for m in (A, B) for name in ("one", "two")]
    group += [flown(m, "three", [m == B], track="second") for m in (A, B)]
    by_mission, by_track = rank_methods(group), rank_methods(group, by_track=True)
    assert {row.method: row.shares["success"].value for row in by_mission} == pytest.approx({A: 2 / 3, B: 1 / 3})
    assert {row.method: row.shares["success"].value for row in by_track} == pytest.approx({A: 0.5, B: 0.5})


def test_medians_on_the_board_give_every_track_the_same_weight() -> None:
    missions = (("first", "one", 2.0), ("first", "two", 4.0), ("second", "three", 9.0))
    group = [MissionRuns(track, name, A, (run(0, True)._replace(switches=median),)) for track, name, median in missions]
    board = make_boards(group, {"first": "", "second": ""})[0]
    switches = [column.head for column in board.columns].index("switches")
    assert board.rows[0].cells[switches].text == "6.0"  # not 5.0, the mean over missions


def test_a_method_that_did_not_fly_everything_has_no_rank() -> None:
    """It is still shown, but the others' ranks do not count it."""
    group = [flown(A, "one", [True]), flown(A, "two", [True]), flown(B, "one", [True])]
    first, second = rank_methods(group)
    assert (first.method, first.rank.value) == (A, 1.0)
    assert second.method == B and math.isnan(second.rank.value) and set(second.flown) == {"one"}


def test_the_board_shows_only_what_it_compares() -> None:
    """a succeeds on 50 layouts, b on 45 of them and 950 others. If c flew only the 50, these count, and the page says so."""
    group = [flown(A, "one", [k < 50 for k in range(1000)]), flown(B, "one", [k > 4 for k in range(1000)])]
    short = [*group, flown(C, "one", [False] * 50)]
    assert [len(each.runs) for each in on_common_layouts(group)] == [1000, 1000]
    assert [len(each.runs) for each in on_common_layouts(short)] == [50, 50, 50]
    facts = dict(leaderboard._page_facts(on_common_layouts(short), FACTS, 2050))
    assert facts["Runs"] == "150 episodes of 3 methods"
    assert facts["Left out"].startswith("1900 other episodes, on layouts that not all methods of their mission ran,")
    assert "Left out" not in dict(leaderboard._page_facts(group, FACTS, 2000))


def test_few_layouts_show_no_significant_difference() -> None:
    """Fewer than six cannot: even if all are lost, the sign test's p is at least 2 / 2^5 = 6 %."""
    for n in (1, 2, 5):
        assert not behind(np.zeros(n), np.ones(n))
    assert behind(np.zeros(6), np.ones(6))


def test_only_common_layouts_are_compared() -> None:
    more, less = flown(A, "one", [True, False, False]), flown(B, "one", [True])
    assert {row.rank.value for row in rank_methods([more, less])} == {1.5}
    other = MissionRuns("t", "one", B, (run(7, True),))
    with pytest.raises(ConfigurationError, match="no layout of one was run with all methods"):
        rank_methods([more, other])


merits = st.lists(st.tuples(*[st.integers(-3, 3).map(float)] * 2), min_size=1, max_size=12)


@given(merits)
def test_the_chance_of_improvement_is_that_of_all_pairs(pairs: list[tuple[float, float]]) -> None:
    """It is Mann and Whitney's U as a share of all pairs, for every bootstrap sample with that sample's weights."""
    x, y = np.array(pairs).T
    drawn = np.random.default_rng(0).dirichlet(np.ones(len(x)), size=3)
    wins = (x[:, None] > y) + 0.5 * (x[:, None] == y)
    value, samples = improvement(x, y, drawn)
    assert value == pytest.approx(wins.mean())
    assert samples == pytest.approx(np.einsum("ri,ij,rj->r", drawn, wins, drawn))


def test_significance_is_paired() -> None:
    """Ten of fifty layouts that only one method solves make a significant difference; two of fifty do not."""
    y = np.ones(50, dtype=bool)
    for lost, decided in ((10, True), (2, False), (0, False)):
        x = y.copy()
        x[:lost] = False
        assert behind(x, y) is decided
    assert not behind(y, ~y)
    rows = {row.method: row for row in rank_methods([flown(A, "one", [True] * 50), flown(B, "one", [True] * 48 + [False] * 2)])}
    assert rows[A].best == {"one"} and rows[B].best == set() and rows[B].level == {"one"}


def test_worst_and_median_are_runs_that_can_be_looked_at() -> None:
    runs = (run(0, True, 5.0), run(1, False, 9.0), run(2, True, 1.0), run(3, False, 0.0, "cannot start"))
    worst, median = notable_layouts([MissionRuns("t", "one", A, runs)])
    assert (worst.kind, worst.run.seed, median.kind, median.run.seed) == ("worst", 1, "median", 2)
    assert worst.clip == "clips/t-a+x-worst.mp4"
    assert notable_layouts([MissionRuns("t", "one", A, runs[3:])]) == []


def test_the_interval_of_a_median_is_that_of_the_sign_test() -> None:
    """Of 50 values the 18th and the 33rd: the 15 middle ones of the 51 possible counts below the median make up at least 95 %."""
    assert median_interval(np.arange(1.0, 51.0)) == (25.5, 18.0, 33.0)
    assert median_interval(np.array([3.0, 1.0, 2.0])) == (2.0, 1.0, 3.0)
    alone, none = median_interval(np.array([4.0])), median_interval(np.zeros(0))
    assert alone.value == 4.0 and math.isnan(alone.low) and math.isnan(none.value)

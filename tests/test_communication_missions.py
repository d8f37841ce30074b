"""Communication in whole missions: the distributed look-ahead, logs and pictures of links, and the study of networks."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from mcap.reader import make_reader

from marlbc_mj.cli import main
from marlbc_mj.controllers import PD
from marlbc_mj.core.communication import Communication
from marlbc_mj.engine.world import World
from marlbc_mj.episode import Trajectory, run_episode
from marlbc_mj.recording.links import HALF_LIFE, MAX_OPACITY, MIN_OPACITY, MOST_LINKS, drawn_links
from marlbc_mj.recording.log import EpisodeLog, from_trajectory
from marlbc_mj.recording.reader import read_log
from marlbc_mj.recording.schemas import COMMUNICATION, decode_hearing, encode_hearing
from marlbc_mj.recording.stage import make_stage
from marlbc_mj.recording.writer import LogWriter
from marlbc_mj.scenarios import Scenario, make_scenario
from marlbc_mj.studies.batches import Flown, JointFlight
from marlbc_mj.studies.communication import CASES, CommunicationStudy, NetworkCase, neighbor_distance, time_to_agree
from marlbc_mj.studies.runner import run_study
from marlbc_mj.supervisors import DistributedLookAhead, LookAhead, make_supervisor
from marlbc_mj.supervisors.communication import Hearing
from marlbc_mj.supervisors.set_based_rule import IN_COLUMN, IN_FORMATION
from marlbc_mj.util.errors import ConfigurationError

POOR = Communication(range=7.2, delay=0.1, loss=0.2, silent=(0,), silent_from=1.0)


def gates(**changes) -> Scenario:
    return make_scenario("gates", composition="set-based", **changes)


def orders_of(supervisor, scenario: Scenario, steps: int, worlds: int = 1) -> np.ndarray:
    """Orders (T, B, N) that a supervisor gives in the mission that it flies."""
    world, given = World(scenario, worlds=worlds), []
    observation, memory = world.reset(3), supervisor.start(scenario, worlds)
    for _ in range(steps):
        orders, memory = supervisor.decide(observation, memory)
        given.append(orders)
        observation = world.step(orders).observation
    return np.array(given)


# The distributed look-ahead -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("family", "composition", "steps"),
    [("gates", "set-based", 400), ("field", "null-space", 300), ("corridor", "null-space", 850)],
)
def test_with_ideal_communication_it_is_the_central_rule(family, composition, steps):
    """All orders are equal, with ideal communication and with flooding over a range that reaches all agents at once.

    Without the two extra conditions of null-space, orders would differ from step 178 of the field and 787 of the corridor on.
    """
    scenario = make_scenario(family, composition=composition)
    central = orders_of(LookAhead(), scenario, steps)
    assert len(np.unique(central)) == 2
    for given in (scenario, replace(scenario, communication=Communication(range=1000.0))):
        np.testing.assert_array_equal(orders_of(DistributedLookAhead(), given, steps), central)


def test_poor_communication_changes_decisions_and_no_team_depends_on_the_batch():
    ideal, poor = (orders_of(DistributedLookAhead(), gates(**each), 300, 2) for each in ({}, {"communication": POOR}))
    assert (ideal != poor).any()
    np.testing.assert_array_equal(orders_of(DistributedLookAhead(), gates(communication=POOR), 300), poor[:, :1])


@pytest.mark.parametrize(
    ("votes", "age", "expected"),
    [
        ([0, 1, 1, 0], [0, 0, 0, 0], True),
        ([0, 1, 0, 0], [0, 0, 0, 0], False),
        ([0, 1, 1, 0], [0, 0, 2.0, 0], True),
        ([0, 1, 1, 0], [0, 0, 2.1, 0], False),  # votes older than 2 s do not count
        ([1, 0, 0, 0], [0, np.inf, np.inf, np.inf], True),  # an agent without contact decides by its own lane
        ([0, 1, 1, 1], [0, np.inf, np.inf, np.inf], False),
        ([0.49] * 4, [0.1] * 4, True),  # consensus estimates of the mean: nearly two of four
        ([0.3] * 4, [0.1] * 4, False),
    ],
)
def test_an_agent_counts_the_votes_that_it_knows(votes, age, expected):
    heard, ages = (np.array(row, dtype=float)[None, None] for row in (votes, age))
    motion = DistributedLookAhead().agree(heard[..., None], ages, np.array([[IN_FORMATION]]))
    assert motion.tolist() == [[IN_COLUMN if expected else IN_FORMATION]]


@pytest.mark.parametrize(
    ("narrow", "shut", "last", "expected"),
    [
        (0, 0, IN_FORMATION, IN_COLUMN),
        (1, 0, IN_FORMATION, IN_FORMATION),  # a column with a blocked lane does not help
        (1, 1, IN_FORMATION, IN_FORMATION),
        (1, 1, IN_COLUMN, IN_COLUMN),  # the column stays while an agent is shut in
        (1, 0, IN_COLUMN, IN_FORMATION),
    ],
)
def test_under_null_space_one_agent_is_enough_against_a_column_or_for_it(narrow, shut, last, expected):
    votes = np.array([[[[1, 0, 0], [1, narrow, 0], [0, 0, shut]]]], dtype=float)
    assert DistributedLookAhead().agree(votes, np.zeros((1, 1, 3)), np.array([[last]])).tolist() == [[expected]]


def test_a_hold_that_cannot_be_is_refused():
    with pytest.raises(ConfigurationError, match="hold must be positive, got 0"):
        DistributedLookAhead(hold=0.0)


# Logs and pictures --------------------------------------------------------------------------------------------------------------


def fly(path: Path, supervisor: str = "lookahead-distributed", **changes) -> Trajectory:
    scenario = gates(**{"duration": 2.0, "communication": POOR, **changes})
    with LogWriter(path, scenario, PD(), names=(supervisor, "pd"), seed=0, config={}) as log:
        return run_episode(
            World(scenario, PD(), record=True), make_supervisor(supervisor), names=(supervisor, "pd"), on_frame=log.write
        )


@pytest.fixture(scope="module")
def flown(tmp_path_factory) -> tuple[Path, Trajectory]:
    path = tmp_path_factory.mktemp("logs") / "talk.mcap"
    return path, fly(path)


def test_a_log_tells_who_heard_whom(flown):
    """Links and ages are equal to the last bit, and the log has a consistent row per agent."""
    path, trajectory = flown
    log, expected = read_log(path), from_trajectory(trajectory, PD())
    for name in ("link", "age"):
        assert getattr(log, name).dtype == getattr(expected, name).dtype and getattr(log, name).shape == (40, 4, 4)
        np.testing.assert_array_equal(getattr(log, name), getattr(expected, name))
    assert log.link[0, 1, 0] and not log.link[-1, :, 0].any() and log.age[-1, 1, 0] > 0.9
    with open(path, "rb") as stream:
        rows = [json.loads(m.data)["agents"] for _, _, m in make_reader(stream).iter_messages(topics=["/communication"])]
    assert len(rows) == 40 and all(set(row) == set(COMMUNICATION.columns) for row in rows[-1])
    assert rows[0][0]["component"] == 1 and {row["component"] for row in rows[-1]} == {1, 2, 3}
    assert [row["known"] for row in rows[0]] == [1] * 4 and rows[0][0]["oldest"] == 0.0


def test_a_log_of_ideal_communication_or_of_a_central_supervisor_says_nothing_of_it(tmp_path):
    for name, supervisor, changes in (("a", "lookahead-distributed", {"communication": Communication()}), ("b", "lookahead", {})):
        trajectory = fly(tmp_path / f"{name}.mcap", supervisor, duration=0.2, **changes)
        assert trajectory.hearing is None
        assert read_log(tmp_path / f"{name}.mcap").link.shape == (4, 0, 0)


@pytest.mark.parametrize(
    "row", [{"hears": "3", "ages": "0.0 1.0"}, {"hears": "0", "ages": "0.0 1.0"}, {"hears": "x", "ages": "0 0"},
            {"hears": "", "ages": "0.0"}, {"hears": "", "ages": "0.0 y"}],
)  # fmt: skip
def test_rows_that_nobody_wrote_are_refused(row):
    with pytest.raises(ValueError, match="agents|literal|convert"):
        decode_hearing([row, {"hears": "", "ages": "0.0 0.0"}])


def test_rows_read_back():
    link, age = np.array([[False, True], [False, False]]), np.array([[0.0, 0.15], [np.inf, 0.0]])
    written = json.loads(encode_hearing(Hearing(link, age)))["agents"]
    for given, read in zip((link, age), decode_hearing(written), strict=True):
        np.testing.assert_array_equal(given, read)


def test_links_fade_with_the_age_of_the_older_side():
    link, age = np.zeros((3, 3), dtype=bool), np.zeros((3, 3))
    link[0, 1], link[2, 1], age[1, 0], age[2, 1] = True, True, HALF_LIFE, np.inf
    links = drawn_links(np.zeros((3, 2)), link, age)
    assert links.ends.tolist() == [[0, 1], [1, 2]]
    np.testing.assert_allclose(links.opacity, [0.5 * MAX_OPACITY, MIN_OPACITY])
    many = ~np.eye(40, dtype=bool)
    place = np.column_stack([np.arange(40.0), np.zeros(40)])
    ends = drawn_links(place, many, np.zeros((40, 40))).ends
    assert len(ends) == MOST_LINKS and (np.diff(ends, axis=1) <= 12).all()


def test_links_are_in_the_picture(flown):
    """There is one strip per link in the video, and one line per link in the scene of a viewer."""
    stage = make_stage(read_log(flown[0]))
    assert len(stage._links(0.5)) == len(drawn_links(stage.log.position[10], stage.log.link[10], stage.log.age[10]).ends) == 3
    with open(flown[0], "rb") as stream:
        scenes = [SceneUpdate.FromString(m.data) for _, _, m in make_reader(stream).iter_messages(topics=["/scene"])]
    (links,) = (entity for entity in scenes[10].entities if entity.id == "links")
    assert len(links.lines[0].points) == len(links.lines[0].colors) == 6
    assert links.lines[0].colors[0].a < scenes[10].entities[0].lines[0].color.a or links.lines[0].colors[0].a <= MAX_OPACITY


def test_links_are_in_a_recording_of_rerun(flown, tmp_path):
    chunk = pytest.importorskip("rerun.chunk")
    main(["log", "export", str(flown[0]), str(tmp_path / "a.rrd")])
    log: EpisodeLog = read_log(flown[0])
    strips = []
    for each in chunk.RrdReader(str(tmp_path / "a.rrd")).stream():
        batch = each.to_record_batch()
        if each.entity_path == "/scene/links" and "LineStrips3D:strips" in batch.schema.names:
            strips += batch.column("LineStrips3D:strips").to_pylist()
    counts = [np.triu(link | link.T, 1).sum() for link in log.link]
    assert [len(moment) for moment in strips] == counts
    np.testing.assert_allclose(np.array(strips[5][0])[:, :2], log.position[5][[0, 1]], rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("supervisor", [DistributedLookAhead(), make_supervisor("fsams-hysteresis")])
def test_episodes_flown_together_are_those_flown_alone(supervisor):
    """Arrays of the trajectory are equal to the last bit, except decision times and those that joint flights do not keep."""
    scenario = gates(duration=1.0, communication=POOR)
    flight = JointFlight(Flown(scenario, supervisor, PD(), ("supervisor", "controller"), False), (4, 9))
    flight.fly(supervisor)
    assert not flight.failures
    for b, seed in enumerate((4, 9)):
        one, alone = flight.trajectory(b), run_episode(World(scenario, PD(), record=True), supervisor, seed=seed)
        for entry in fields(Trajectory):
            a, b = (getattr(each, entry.name) for each in (one, alone))
            if entry.name not in ("decision_ms", "controller_state", "pose", "hearing"):
                np.testing.assert_equal(a, b, err_msg=entry.name)


# Command line and study ---------------------------------------------------------------------------------------------------------


def test_settings_of_the_command_line(tmp_path, capsys):
    """--set changes entries of communication; other settings and invalid values are refused."""
    run = ["run", "gates", "--supervisor", "lookahead-distributed", "--controller", "pd", "--duration", "0.2"]
    main([*run, "--out", str(tmp_path / "a"), "--set", "communication.range=8", "communication.silent=1,2"])
    config = json.loads((tmp_path / "a" / "config.json").read_text())["scenario"]
    assert config["communication"]["range"] == 8.0 and config["communication"]["silent"] == [1, 2]
    for setting, said in (
        ("communication.range=2", "splits the team into 4 parts at the start"),
        ("communication.reach=2", "unknown setting 'communication.reach'"),
        ("communication.loss=much", "setting communication.loss must be float, got 'much'"),
        ("duration=3", "unknown setting 'duration'"),
    ):
        with pytest.raises(SystemExit) as ended:
            main([*run, "--out", str(tmp_path / "b"), "--set", setting])
        assert ended.value.code == 2 and said in capsys.readouterr().err


def test_the_study_flies_every_case(tmp_path):
    """With two cases on two layouts, the table and the file have a row per case."""
    scenario = gates(duration=0.5, split="test")
    assert neighbor_distance(scenario) == pytest.approx(6.0) and len(CASES) == 29
    study = CommunicationStudy(
        (scenario,), "lookahead-distributed", (1, 2), "pd", cases=(CASES[0], NetworkCase(1.2, 0.1, 0.2, True))
    )
    done = run_study(study, tmp_path / "out")
    assert [job.scenario.communication.range for job in study.jobs()] == [np.inf, pytest.approx(7.2)]
    assert [line.split(",")[:6] for line in (tmp_path / "out" / "communication.csv").read_text().splitlines()[1:]] == [
        ["gates", "inf", "0.0", "0.0", "False", "2"],
        ["gates", "1.2", "0.1", "0.2", "True", "2"],
    ]
    assert "| gates | 1.2 | 0.1 | 20 | agent 1 |" in done.report.text


def test_flooding_agrees_before_consensus_does():
    """Five agents in a row: flooding takes four hops, the first of which takes no time."""
    row = np.column_stack([np.arange(5.0), np.zeros(5)])
    assert time_to_agree(row, Communication(range=1.0)) == pytest.approx(0.15)
    assert 0.15 < time_to_agree(row, Communication(range=1.0, protocol="consensus")) < 10.0

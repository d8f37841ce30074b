"""Settings: rules of fields, values from tables, JSON data and texts; every error gives the place, the fault and valid values."""

import math
import re
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple, get_args, get_type_hints

import pytest
from hypothesis import given
from hypothesis import strategies as st

from marlbc_mj.policies.actions import ACTIONS
from marlbc_mj.policies.states import STATES
from marlbc_mj.scenarios import load_scenario
from marlbc_mj.training.config import PRESETS, TrainConfig, from_json, make_config
from marlbc_mj.training.shaping import Shaping
from marlbc_mj.util.changes import with_settings
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.provenance import plain_data
from marlbc_mj.util.settings import AT_LEAST_ONE, NOT_NEGATIVE, POSITIVE, SHARE, check, convert, json_data, tables, texts


class Point(NamedTuple):
    x: float
    y: float = 0.0


@dataclass(frozen=True)
class Inner:
    share: Annotated[float, SHARE] = 0.5


@dataclass(frozen=True)
class Outer:
    """A dataclass with one field of every kind."""

    count: Annotated[int, AT_LEAST_ONE]
    kind: Literal["a", "b"] = "a"
    flag: bool = False
    name: str = ""
    limit: Annotated[float, POSITIVE] = math.inf
    length: Annotated[float, POSITIVE] = 1.0
    pair: tuple[float, float] = (0.0, 0.0)
    points: tuple[Point, ...] = ()
    inner: Inner = Inner()

    def __post_init__(self):
        check(self)


def refusal(*fragments):
    return pytest.raises(ConfigurationError, match=".*".join(map(re.escape, fragments)))


def test_a_table_fills_every_kind_of_field():
    table = {
        "count": 2, "kind": "b", "flag": True, "name": "n", "limit": math.inf, "length": 3, "pair": [1, 2.5],
        "points": [[1], [2, 3]], "inner": {"share": 1},
    }  # fmt: skip
    made = convert(tables(), table, Outer)
    assert made == Outer(2, "b", True, "n", math.inf, 3.0, (1.0, 2.5), (Point(1.0), Point(2.0, 3.0)), Inner(1.0))
    assert type(made.length) is type(made.points[0].x) is type(made.inner.share) is float


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ({"coumt": 1, "flag": 3}, "unknown key 'coumt'; perhaps 'count'; choose from: count, kind, flag"),
        ({"inner": {"part": 1}, "count": 1}, "unknown key 'inner.part'; choose from: inner.share"),
        ({}, "missing: count"),
        ({"count": 1.0}, "count must be a whole number, got 1.0"),
        ({"count": True}, "count must be a whole number, got True"),
        ({"count": 1, "flag": 1}, "flag must be true or false, got 1"),
        ({"count": 1, "name": 1}, "name must be a string, got 1"),
        ({"count": 1, "kind": "c"}, "unknown kind 'c'; choose from: a, b"),
        ({"count": 1, "kind": ["a"]}, "unknown kind ['a']; choose from: a, b"),
        ({"count": 1, "length": math.inf}, "length must be finite, got inf"),
        ({"count": 1, "limit": math.nan}, "limit must be finite, got nan"),
        ({"count": 1, "limit": -1.0}, "limit must be positive, got -1.0"),
        ({"count": 1, "limit": "no"}, "limit must be a number, got 'no'"),
        ({"count": 1, "pair": 3}, "pair must be a list, got 3"),
        ({"count": 1, "pair": [1, 2, 3]}, "pair must be a list of 2, got [1, 2, 3]"),
        ({"count": 1, "pair": [1, "b"]}, "pair[1] must be a number, got 'b'"),
        ({"count": 1, "points": [[1], []]}, "points[1] must be a list [x, y], got []"),
        ({"count": 1, "points": [[1, True]]}, "points[0].y must be a number, got True"),
        ({"count": 1, "inner": 1}, "inner must be a table, got 1"),
        ({"count": 1, "inner": {"share": "half"}}, "inner.share must be a number, got 'half'"),
        ({"count": 0}, "count must be at least 1, got 0"),
        ({"count": 1, "length": -1}, "length must be positive, got -1.0"),
    ],
)
def test_what_is_wrong_in_a_table_is_named_with_its_place(table, message):
    with pytest.raises(ConfigurationError) as error:
        convert(tables(), table, Outer)
    assert str(error.value).startswith(message)


@given(st.floats())
def test_rules_hold_for_every_number(value):
    """NaN breaks all of them."""
    finite = not math.isnan(value)
    assert SHARE.holds(value) == (0 <= value <= 1) and POSITIVE.holds(value) == (value > 0)
    assert AT_LEAST_ONE.holds(value) == (value >= 1) and NOT_NEGATIVE.holds(value) == (finite and not value < 0)


def test_a_broken_rule_names_the_field_with_its_prefix():
    with refusal("inner.share must be between 0 and 1, got 1.5"):
        check(Inner(1.5), "inner.")


def test_json_data_make_an_equal_dataclass():
    """This holds for every kind of field, including one with an infinite default."""
    whole = Outer(2, "b", True, "n", 4.0, 3.0, (1.0, 2.5), (Point(1.0), Point(2.0, 3.0)))
    for made in (Outer(1), whole):
        data = plain_data(made)
        del data["type"], data["inner"]["type"]
        assert convert(json_data(), data, Outer) == made


@pytest.mark.parametrize("preset", PRESETS)
def test_json_data_make_an_equal_configuration(preset):
    """This includes infinite numbers and whole numbers in float fields; missing fields get their defaults."""
    for config in (PRESETS[preset][0], make_config(preset, gamma=0, threads=3)):
        data = plain_data(config)
        assert from_json(data) == config and plain_data(from_json(data)) == data
        assert from_json({name: value for name, value in data.items() if name != "ppo"}) == config


@pytest.mark.parametrize(
    ("data", "fragments"),
    [
        ({"gama": 1.0}, ("unknown key 'gama'", "gamma")),
        ({"budget": "many"}, ("budget must be a whole number, got 'many'",)),
        ({"hidden": 8}, ("hidden must be a list, got 8",)),
        ({"shaping": {"type": "Shaping", "margn": 1.0}}, ("unknown key 'shaping.margn'", "shaping.margin")),
        ({"state": "pixels"}, ("unknown state 'pixels'", "extended, published")),
        ({"shaping": {"scale": 0.0}}, ("shaping.scale must be positive, got 0.0",)),
    ],
)
def test_json_data_of_no_configuration_are_refused(data, fragments):
    with refusal("not the configuration of a training run", *fragments):
        from_json(data)


@pytest.mark.parametrize(
    ("setting", "fragments"),
    [
        ("gamma", ("--set takes name=value, got 'gamma'",)),
        ("gama=1", ("unknown setting 'gama'", "gamma")),
        ("gamma.x=1", ("unknown setting 'gamma.x'", "gamma")),
        ("shaping=3", ("setting shaping must be set field by field, name.field=value, got '3'",)),
        ("shaping.margn=3", ("unknown setting 'shaping.margn'", "shaping.margin")),
        ("shaping.margin=wide", ("setting shaping.margin must be float, got 'wide'",)),
        ("batch=1.5", ("setting batch must be int, got '1.5'",)),
        ("dueling=perhaps", ("setting dueling must be true or false, got 'perhaps'",)),
        ("hidden=8,x", ("setting hidden must be whole numbers separated by commas, got '8,x'",)),
        ("learner=bold", ("unknown learner 'bold'", "lenient, hysteretic, plain")),
        ("ppo.clip=2", ("ppo.clip must be between 0 and 1, got 2.0",)),
    ],
)
def test_texts_that_are_no_setting_are_refused(setting, fragments):
    with refusal(*fragments):
        with_settings(TrainConfig(), (setting,))


def test_texts_are_read_by_the_fields_they_are_for():
    """A field of floats accepts whole numbers and infinity too."""
    together = with_settings(TrainConfig(), ("worlds=100000", "capacity=1000000", "shaping.dwell=3", "shaping.margin=0.2"))
    assert (together.rows, together.shaping.dwell, together.shaping.margin) == (10, 3.0, 0.2)  # neither alone would be valid
    config = with_settings(TrainConfig(), ("huber=inf", "cool_by=1", "state=published", "shaping.dwell=2", "dueling=FALSE"))
    assert (config.huber, config.cool_by, config.state, config.dueling) == (math.inf, 1.0, "published", False)
    assert config.shaping.dwell == 2.0 and type(config.cool_by) is float


def test_the_choices_of_a_configuration_are_those_that_there_are():
    """Choices of state and action set are those of the tables in other modules."""
    hints = get_type_hints(TrainConfig)
    assert set(get_args(hints["state"])) == set(STATES) and set(get_args(hints["actions"])) == set(ACTIONS)


def test_converters_are_independent():
    """One converter accepts a text as a number, others do not."""
    assert convert(texts(), "3", float) == 3.0 and convert(json_data(), "inf", float) == math.inf
    for converter in (tables(), json_data()):
        with refusal("size must be a number, got '3'"):
            convert(converter, "3", float, "size")


def test_a_shaping_that_follows_no_rule_is_refused():
    with refusal("shaping.scale must be positive, got nan"):
        Shaping(scale=math.nan)


def test_a_kind_of_disturbance_that_is_no_name_is_refused(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text('family = "field"\n[disturbance]\nkind = ["gusts"]\n')
    with refusal("mine.toml", "disturbance.kind ['gusts']", "paper, linear"):
        load_scenario(path)

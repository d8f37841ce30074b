"""Writes and reads the files of a suite run: suite.json, and a CSV file per track with a row per layout."""

import json
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from marlbc_mj.results.layout_runs import MissionRuns, read_layout_rows, write_layout_rows
from marlbc_mj.results.standings import MissionSummary, summarize
from marlbc_mj.results.statistics import Estimate
from marlbc_mj.results.summary import json_numbers
from marlbc_mj.studies.addresses import code_version
from marlbc_mj.studies.suite.definition import TRACKS, VERSION, suite_hash
from marlbc_mj.util.errors import ConfigurationError
from marlbc_mj.util.files import write_json
from marlbc_mj.util.provenance import provenance

FORM = 1
"""Version of the format of suite.json."""
SUITE_FILE = "suite.json"
_OF_OTHERS = ("command", "date", "code", "git_revision", "cpu")
"""Facts that are kept of earlier results that are shown next to new ones."""


class SuiteResults(NamedTuple):
    """Rows of the suite, and facts about their origin."""

    facts: Mapping[str, Any]  # ``suite``, ``versions``, ``git_revision``, ``cpu``, ``platform``, ``code``, ``command``, ``date``
    groups: tuple[MissionRuns, ...]


def describe_suite() -> dict[str, Any]:
    """The facts in suite.json besides results: version and hash of the suite, and how, when and where it is flown."""
    return {
        "suite": {"version": VERSION, "hash": suite_hash()},
        "command": " ".join(["marlbc", *sys.argv[1:]]),
        "date": datetime.now(UTC).date().isoformat(),
        "code": code_version(),
        **provenance(),
    }


def write_suite(results: SuiteResults, folder: Path) -> None:
    """Write suite.json and TRACK.csv for every track that was flown."""
    tracks = dict.fromkeys(each.track for each in results.groups)
    for track in tracks:
        write_layout_rows((each for each in results.groups if each.track == track), folder / f"{track}.csv")
    content = {"form": FORM, **results.facts, "tracks": {track: _track_entry(track, results.groups) for track in tracks}}
    write_json(folder / SUITE_FILE, json_numbers(content))


def _track_entry(track: str, groups: Sequence[MissionRuns]) -> dict[str, Any]:
    """The entry of a track in suite.json: its missions, each with its seeds and its methods."""
    own = [each for each in groups if each.track == track]
    entry: dict[str, Any] = {}
    for mission in dict.fromkeys(each.mission for each in own):
        rows = [each for each in own if each.mission == mission]
        seeds = sorted({run.seed for each in rows for run in each.runs})
        methods = {each.method.key: {**each.method._asdict(), **_numbers(summarize(each))} for each in rows}
        entry[mission] = {"first_seed": seeds[0], "layouts": len(seeds), "methods": methods}
    return entry


def _numbers(summary: MissionSummary) -> dict[str, Any]:
    shares = {name: _with_interval(estimate) for name, estimate in summary.shares.items()}
    medians = {name: _with_interval(estimate) for name, estimate in summary.medians.items()}
    return {"layouts": summary.runs, "shares": shares, "medians": medians, "failures": dict(summary.failures)}


def _with_interval(estimate: Estimate) -> list[float]:
    """The value, and the lower and upper ends of its interval."""
    return list(estimate)


def read_suite(folder: Path) -> SuiteResults:
    """Read the results that :func:`write_suite` wrote.

    Raises:
        ConfigurationError: no such folder, another format or suite, or an incomplete file.
    """
    path = folder / SUITE_FILE
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        form, suite, tracks = content.pop("form"), content["suite"], content.pop("tracks")
        version, found = suite["version"], suite["hash"]
        missing = [name for name in (*_OF_OTHERS, "versions") if name not in content]
    except OSError as error:
        raise ConfigurationError(f"{folder} holds no results of the suite: cannot read {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigurationError(f"{path} is not a file of the suite") from error
    if missing:
        raise ConfigurationError(f"{path} lacks {', '.join(missing)}")
    if form != FORM:
        raise ConfigurationError(f"{path} has format {form}, but this code reads format {FORM}")
    if (version, found) != (VERSION, suite_hash()):
        raise ConfigurationError(
            f"{path} belongs to suite {version} {str(found)[:12]}, this code has {VERSION} {suite_hash()[:12]}: not comparable"
        )
    groups = [each for track in tracks if track in TRACKS for each in read_layout_rows(folder / f"{track}.csv", track)]
    return SuiteResults(content, tuple(groups))


def merge(own: SuiteResults, other: SuiteResults) -> SuiteResults:
    """The rows of both results; if both have a method on a mission, only those of ``own``."""
    there = {(each.track, each.mission, each.method) for each in own.groups}
    kept = [each for each in other.groups if (each.track, each.mission, each.method) not in there]
    beside = [{name: other.facts[name] for name in _OF_OTHERS}, *other.facts.get("beside", ())]
    return SuiteResults({**own.facts, "beside": beside}, (*own.groups, *kept))

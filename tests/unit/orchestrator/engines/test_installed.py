"""Engines by entry points, and the options that each declares."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from orchestrator.engines import installed
from orchestrator.engines.api import EngineError, EngineType, Option
from orchestrator.engines.installed import ENGINES, check_tags, engine_type

DOCUMENTATION = Path(__file__).parents[4] / "docs"


def test_muster_s_own_engines_are_entry_points_and_any_other_is_refused_with_those_that_are() -> None:
    assert ENGINES[:5] == ("local", "docker", "ray", "slurm", "aws-batch")
    assert all(isinstance(engine_type(name), EngineType) for name in ENGINES)
    with pytest.raises(EngineError, match="there is no engine 'kubernetes'; there are local, docker, ray, slurm, aws-"):
        engine_type("kubernetes")


@pytest.mark.parametrize(
    ("value", "why"),
    [
        ("nowhere_at_all:ENGINE", "engine odd: nowhere_at_all:ENGINE can't be imported: No module named"),
        ("orchestrator.engines.local:NONE", "engine odd: .* can't be imported: .*NONE"),
        ("orchestrator.engines.api:Option", "engine odd: orchestrator.engines.api:Option is no EngineType"),
    ],
)
def test_an_entry_point_that_leads_to_no_engine_is_named(value: str, why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    point = installed.EntryPoint("odd", value, installed.GROUP)
    monkeypatch.setitem(installed._POINTS, "odd", point)
    with pytest.raises(EngineError, match=why):
        engine_type("odd")


@pytest.mark.parametrize(
    ("tags", "engines", "of_a_queue"),
    [
        ({"muster:partition": "gpu", "muster:nice": "-5", "owner": "any"}, ["slurm"], False),
        ({"muster:engine": "ray", "muster:hosts": "ray/a,ray/b", "muster:images": "refuse"}, ["ray"], False),
        ({"muster:images": "refuse"}, ["local"], True),
        ({"muster:share": "alice", "muster:qos": "low"}, ["slurm", "aws-batch"], True),
        ({"mustard:partiton": "any"}, ["slurm"], True),
    ],
)
def test_options_of_the_engines_are_tags(tags: dict[str, str], engines: list[str], of_a_queue: bool) -> None:
    check_tags(tags, engines, of_a_queue=of_a_queue)


NO = "has no such option"
WRONG_TAGS = {
    (
        "muster:partiton",
        "gpu",
        "slurm",
        False,
    ): f": a compute environment of the slurm engine {NO}; did you mean partition?",
    ("muster:job-que", "night", "aws-batch", True): f": a queue of the aws-batch engine {NO}; did you mean job-queue?",
    ("muster:gpu", "a100", "local", True): f": a queue of the local engine {NO}; there are images",
    ("muster:nice", "much", "slurm", True): (
        " is 'much', not a whole number; it is sbatch's --nice of a job without priority"
    ),
    ("muster:account", " ", "slurm", True): " is empty; it is an account",
    ("muster:images", "refused", "local", False): " is 'refused'; did you mean refuse?",
}


@pytest.mark.parametrize("case", WRONG_TAGS)
def test_a_tag_that_is_misspelt_or_of_a_wrong_kind_is_refused_with_the_nearest_name(
    case: tuple[str, str, str, bool],
) -> None:
    tag, value, engine, of_a_queue = case
    with pytest.raises(ValueError, match=f"^{re.escape(f'tag {tag}{WRONG_TAGS[case]}')}$"):
        check_tags({tag: value}, [engine], of_a_queue=of_a_queue)


@pytest.mark.parametrize("name", ["slurm", "aws-batch"])
def test_every_option_is_in_the_documentation_of_its_engine(name: str) -> None:
    page = (DOCUMENTATION / "engines" / f"{name}.md").read_text()
    assert {option.name for option in engine_type(name).options} == set(
        re.findall(r"^\| `muster:([a-z-]+)`", page, re.M)
    )


def test_a_whole_number_may_be_negative() -> None:
    for value in ("5", "-5", "0"):
        Option("nice", "a number", int).check(value)

"""Engines by entry points: their options, traits and handles; nothing outside an engine is decided by its name."""

from __future__ import annotations

import ast
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import pytest

import orchestrator
from orchestrator.domain.hosts import Host, Hosts
from orchestrator.engines import installed
from orchestrator.engines.api import EngineError, EngineType, Handle, SecretValues, Traits, read_handle
from orchestrator.engines.installed import ENGINES, check_tags, engine_type, traits_of
from orchestrator.engines.registry import EngineSet
from orchestrator.engines.secrets import SecretsError
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.engines.testing.rigs import make_gang
from tests.support.refusals import refusal

DOCUMENTATION = Path(__file__).parents[4] / "docs"


def test_muster_s_own_engines_are_entry_points_and_any_other_is_refused_with_those_that_are() -> None:
    assert ENGINES[:5] == ("local", "docker", "ray", "slurm", "aws-batch")
    assert all(isinstance(engine_type(name), EngineType) for name in ENGINES)
    with pytest.raises(
        EngineError, match="there is no engine 'kubernetes'; available: local, docker, ray, slurm, aws-"
    ):
        engine_type("kubernetes")


@pytest.mark.parametrize(
    ("value", "why"),
    [
        ("nowhere_at_all:ENGINE", "engine odd: nowhere_at_all:ENGINE can't be imported: No module named"),
        ("orchestrator.engines.local:NONE", "engine odd: .* can't be imported: .*NONE"),
        ("orchestrator.engines.api:Option", "engine odd: orchestrator.engines.api:Option is not an EngineType"),
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
    "muster:partiton|gpu|slurm": f": a compute environment of the slurm engine {NO}; did you mean partition?",
    "muster:job-que|night|aws-batch|queue": f": a queue of the aws-batch engine {NO}; did you mean job-queue?",
    "muster:gpu|a100|local|queue": f": a queue of the local engine {NO}; available: images",
    "muster:nice|much|slurm|queue": " is 'much', not an integer; it is sbatch's --nice of a job without priority",
    "muster:account| |slurm|queue": " is empty; it is an account",
    "muster:images|refused|local": " is 'refused'; did you mean refuse?",
}
"""Tag, value and engine, of a queue or of a compute environment: the message about it."""


@pytest.mark.parametrize("case", WRONG_TAGS)
def test_a_tag_that_is_misspelt_or_of_a_wrong_kind_is_refused_with_the_nearest_name(case: str) -> None:
    tag, value, engine, *queue = case.split("|")
    output = refusal(check_tags, {tag: value}, [engine], of_a_queue=bool(queue))
    assert output == f"tag {tag}{WRONG_TAGS[case]}"


@pytest.mark.parametrize("name", ["slurm", "aws-batch"])
def test_every_option_is_in_the_documentation_of_its_engine(name: str) -> None:
    page = (DOCUMENTATION / "engines" / f"{name}.md").read_text()
    reported = re.findall(r"^\| `muster:([a-z-]+)`", page, re.M)
    assert {option.name for option in engine_type(name).options} == {*reported}


ROOT = Path(orchestrator.__file__).parent
OF_ENGINES = [ROOT / "engines" / each for each in ("local", "docker", "ray", "slurm", "aws_batch")]


def decisions_by_name(tree: ast.AST) -> Iterator[int]:
    """Lines with a comparison to an engine's name, or a collection of several names, to be compared with later."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Compare):
            sides = [node.left, *node.comparators]
            inside = [each for side in sides if isinstance(side, ast.Tuple | ast.List | ast.Set) for each in side.elts]
            if any(is_name(each) for each in (*sides, *inside)):
                yield node.lineno
        elif (
            (isinstance(node, ast.MatchValue) and is_name(node.value))
            or (isinstance(node, ast.Tuple | ast.List | ast.Set) and sum(map(is_name, node.elts)) > 1)
            or (isinstance(node, ast.Dict) and sum(is_name(key) for key in node.keys if key is not None) > 1)
        ):
            yield node.lineno


def is_name(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value in ENGINES


def test_no_code_outside_an_engine_is_decided_by_its_name() -> None:
    found = {
        f"{path.relative_to(ROOT)}:{line}"
        for path in ROOT.rglob("*.py")
        if not any(path.is_relative_to(folder) for folder in OF_ENGINES)
        if any(f"{quote}{name}{quote}" in path.read_text() for name in ENGINES for quote in "\"'")
        for line in decisions_by_name(ast.parse(path.read_text()))
    }
    [order] = [each for each in found if each.startswith("engines/installed.py:")]
    assert found == {order}, "the order in which the engines are listed alone names several"


@pytest.mark.parametrize(
    "text",
    ['x == "local"', 'engine.name not in ("docker", "x")', '_GIVEN = ("local", "ray")', '{"ray": 1, "slurm": 2}'],
)
def test_a_decision_by_name_is_recognised(text: str) -> None:
    assert list(decisions_by_name(ast.parse(text))) == [1]


def test_an_engine_has_the_traits_of_its_type() -> None:
    from orchestrator.engines.local.engine import LocalEngine
    from orchestrator.engines.ray.engine import RayEngine
    from orchestrator.engines.slurm.engine import SlurmEngine

    made: list[type] = [LocalEngine, RayEngine, SlurmEngine]
    if pytest.importorskip("docker") and pytest.importorskip("boto3"):
        from orchestrator.engines.aws_batch.engine import AwsBatchEngine
        from orchestrator.engines.docker.engine import DockerEngine

        made += [AwsBatchEngine, DockerEngine]
    assert {each.name: each.traits for each in made} == {name: engine_type(name).traits for name in ENGINES}


def test_an_engine_that_is_not_installed_counts_as_one_that_can_do_nothing() -> None:
    assert traits_of("gone") == Traits()


@contextmanager
def served(traits: Traits) -> Iterator[EngineSet]:
    engine = FakeEngine(capacity=Hosts([Host("fake/host", 8.0, (), 8192)]))
    engine.traits = traits
    several = EngineSet([engine])
    try:
        yield several
    finally:
        several.close()


CONTAINER = {"image": "any", "secrets": [{"name": "KEY", "valueFrom": "key"}]}


@pytest.mark.parametrize("way", SecretValues)
def test_secrets_go_the_way_that_the_engine_declares(way: SecretValues, monkeypatch: pytest.MonkeyPatch) -> None:
    gang = make_gang("job", "/store", 1, "fake/host", ["any"], [CONTAINER])
    with served(Traits(secrets=way)) as several:
        monkeypatch.setattr(several.secrets, "of", lambda container, queue: {"KEY": "value"})
        if way is SecretValues.NONE:
            with pytest.raises(EngineError, match="the fake engine has no safe way"):
                several.plan(gang)
        else:
            several.plan(gang)
        supplied = several.with_secrets(gang).nodes[0].environment.get("KEY")
        assert supplied == ("value" if way is SecretValues.ENVIRONMENT else None)
        monkeypatch.undo()
        with nullcontext() if way is SecretValues.REFERENCES else pytest.raises(SecretsError):
            several.check_secrets(["fake"], [CONTAINER], "default")


def test_a_user_is_passed_over_with_a_note_by_an_engine_that_can_t_take_one_on() -> None:
    gang = make_gang("job", "/store", 2, "fake/host", ["any"], [{"user": "1000"}, {}])
    note = "muster: user 1000 is not used: nodes run without the image, and the fake engine runs jobs as the user of its nodes"
    for traits, notes in ((Traits(), [note, ""]), (Traits(users=True), ["", ""]), (Traits(images=True), ["", ""])):
        with served(traits) as several:
            assert [node.contract.note for node in several.plan(gang).nodes] == notes


def test_a_handle_is_read_as_it_was_written() -> None:
    facts = {"nodes": [{"pid": 7, "start": "123", "address": "127.64.0.1", "group": ""}]}
    handle = Handle("local", "job/1/2", 1, facts)
    assert json.loads(handle.text()) == {"engine": "local", "gang": "job/1/2", "nodes": 1, "facts": facts}
    assert read_handle(handle.text()) == handle and hash(read_handle(handle.text())) == hash(handle)
    assert read_handle(handle.text()) != Handle("local", "job/1/2", 1, {"nodes": []})


@pytest.mark.parametrize(
    ("engine", "reported", "facts"),
    [
        ("local", {"gang": "job/1/2", "nodes": [{"pid": 7, "start": "1", "address": "a b"}]}, {"nodes"}),
        ("docker", {"gang": "job/1/2", "job": "job", "addresses": ["10.192.0.2"]}, {"job", "addresses"}),
        ("ray", {"ray": "job/1/2", "hosts": ["ray/n1"]}, {"hosts"}),
        ("slurm", {"gang": "job/1/2", "slurm": "17", "native": True, "output": "/a b"}, {"slurm", "native", "output"}),
        ("aws-batch", {"gang": "job/1/2", "aws": "0-1", "queue": "q"}, {"aws", "queue"}),
    ],
)
def test_a_handle_of_an_earlier_version_is_read(engine: str, reported: dict[str, Any], facts: set[str]) -> None:
    found = read_handle(f"{engine} 3 {json.dumps(reported)}")
    assert (found.engine, found.gang, found.nodes) == (engine, "job/1/2", 3)
    assert found.facts == {name: reported[name] for name in facts}


@pytest.mark.parametrize("text", ["", "local", "local 3", "local x {}", "local 3 []", "{}", '{"engine": "local"}', "{"])
def test_a_damaged_handle_is_named(text: str) -> None:
    with pytest.raises(ValueError, match="the handle of a gang is damaged"):
        read_handle(text)

"""Traits of engines: each declares its own, and nothing outside an engine is decided by its name."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest

import orchestrator
from orchestrator.domain.hosts import Host, Hosts
from orchestrator.engines.api import EngineError, SecretValues, Traits
from orchestrator.engines.installed import ENGINES, engine_type, traits_of
from orchestrator.engines.registry import EngineSet
from orchestrator.engines.secrets import SecretsError
from orchestrator.engines.testing.fake import FakeEngine
from orchestrator.engines.testing.rigs import make_gang

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
        given = several.with_secrets(gang).environments[0].get("KEY")
        assert given == ("value" if way is SecretValues.ENVIRONMENT else None)
        monkeypatch.undo()
        with nullcontext() if way is SecretValues.REFERENCES else pytest.raises(SecretsError):
            several.check_secrets(["fake"], [CONTAINER], "default")


def test_a_user_is_refused_by_an_engine_that_can_t_take_one_on() -> None:
    gang = make_gang("job", "/store", 1, "fake/host", ["any"], [{"user": "1000"}])
    refused = pytest.raises(EngineError, match="the fake engine runs jobs as the user of its nodes")
    for traits, outcome in (
        (Traits(), refused),
        (Traits(users=True), nullcontext()),
        (Traits(images=True), nullcontext()),
    ):
        with served(traits) as several, outcome:
            several.plan(gang)

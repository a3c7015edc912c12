"""The job YAML: what is wrong with it is reported in one line, with file, line and key; what is right compiles."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from orchestrator.domain.errors import SpecError
from orchestrator.domain.gang import gang_needs
from orchestrator.spec.changes import override
from orchestrator.spec.compile import compile_definition
from orchestrator.spec.file import load
from orchestrator.spec.model import KINDS, Spec, validate
from orchestrator.spec.values import known_tasks
from shared_store.contract.error_text import OF_PLUGIN
from tests.support.refusals import refusal
from worker.tasks.run.find import BUILT_IN

pytestmark = pytest.mark.usefixtures("installed_once")
REPOSITORY = Path(__file__).parents[4]
SHIPPED = sorted((REPOSITORY / "job_specs").glob("*.yaml"))
TRAIN = "train: {task: Cartpole, worlds: 4, iterations: 2}"
COMMAND = "name: a\ncommand: [x]\n"


def ppo(text: str) -> str:
    return f"name: a\ntrain:\n  task: Cartpole\n  worlds: 4\n  iterations: 2\n  ppo: {{{text}}}\n"


def problem(tmp_path: Path, text: str | bytes, *assignments: str) -> str:
    """The message about a file, without the directory that it lies in."""
    path = tmp_path / "job.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    message = refusal(load, str(path), list(assignments), error=SpecError)
    assert "\n" not in message
    return message.replace(f"{tmp_path}/", "")


# -- what is wrong ----------------------------------------------------------------------------------------------------

LETTERS = "expected letters, digits, '_' and '-', starting with a letter or digit, at most 100"
RUN_LETTERS = "expected letters, digits, '.', '_' and '-', starting with a letter or digit, at most 128"
TASKS = ", ".join(known_tasks())
TOP = ", ".join(Spec.model_fields)

NODES = "expected an integer number of nodes, or {min: 2, max: 4}"
ONE_OF = f"expected exactly one of {', '.join(KINDS)}; found"
MAPPING = "expected an object of keys such as name, nodes, train; found"
LINES = {
    "checkpoint: {evry: 1}": "checkpoint.evry: unknown key; did you mean every?",
    "checkpoint: {whatever: 1}": "checkpoint.whatever: unknown key; did you mean every?",
    "retry: {zz: 1}": "retry.zz: unknown key; valid here: attempts",
    "nodes: {min: 3, mx: 4}": "nodes.mx: unknown key; did you mean max? (also wrong or missing: nodes.max)",
    "nodes: {min: 3}": "nodes.max: is required",
    "nodes: three": f"nodes: {NODES}, found 'three'",
    "nodes: true": f"nodes: {NODES}, found True",
    "nodes: 1.5": f"nodes: {NODES}, found 1.5",
    "nodes: 0": "nodes.min: expected a value greater than or equal to 1, found 0 (also wrong or missing: nodes.max)",
    "nodes: 5001": "nodes.min: expected a value less than or equal to 5000, found 5001 (also wrong or missing: nodes.max)",
    "nodes: {min: 3, max: 2}": "nodes: min (3) is more than max (2)",
    "resources: 3": "resources: expected an object, found an integer (3)",
    "resources: {memory: 1MiB}": "resources.memory: expected a value greater than or equal to 4, found 1",
    "resources: {memory: 4.5}": "resources.memory: expected an integer, found a number (4.5)",
    "resources: {cpus: 0}": "resources.cpus: expected a value greater than 0, found 0",
    "resources: {cpus: .inf}": "resources.cpus: expected a finite number, found a number (inf)",
    "timeout: soon": "timeout: expected a duration such as 90s, 45m, 2h or 1d, found 'soon'",
    "timeout: 5s": "timeout: expected a value greater than or equal to 60, found '5s'",
    "timeout: true": "timeout: expected a number, found true or false (True)",
    "retry: {attempts: '3'}": "retry.attempts: expected an integer, found a string ('3')",
    "on_child_failure: resart": "on_child_failure: expected 'restart', 'fail' or 'ignore', found 'resart'",
    "checkpoint: {keep: 1}": "checkpoint.keep: expected a value greater than or equal to 2, found 1",
    "environment: [a]": "environment: expected an object, found a list",
    "environment: {MUSTER_X: a}": (
        "environment: MUSTER_X is reserved; names that start with AWS_BATCH or MUSTER_ are set by Muster"
    ),
    "environment: {a=b: a}": (
        "environment: 'a=b' can't be set: a name has no '=', and neither name nor value a zero byte"
    ),
}
"""Of a third line: the message about it."""
PPO = {
    "learning_rat: 1.0": "learning_rat: unknown key; did you mean learning_rate?",
    "schedule: adaptiv": "schedule: expected 'adaptive' or 'fixed', found 'adaptiv'",
    "gamma: 1.5": "gamma: expected a value less than or equal to 1, found 1.5",
    "hidden_sizes: 64": "hidden_sizes: expected a list, found an integer (64)",
    "normalize_observations: 'yes'": "normalize_observations: expected true or false, found a string ('yes')",
    "learning_rate: 5e-4": "learning_rate: expected a number, found a string ('5e-4'); in YAML it is written 5.0e-4",
    "learning_rate: 1.5e3": "learning_rate: expected a number, found a string ('1.5e3'); in YAML it is written 1.5e+3",
    "learning_rate: .nan": "learning_rate: expected a finite number, found a number (nan)",
}
"""Of settings of ppo."""
FILES: dict[str, str] = {
    **{f"{COMMAND}{line}\n": f":3: {output}" for line, output in LINES.items()},
    **{ppo(settings): f":6: train.ppo.{output}" for settings, output in PPO.items()},
    f"name: a\n{TRAIN}\nnodez: 2\n": ":3: nodez: unknown key; did you mean nodes?",
    f"name: a\n{TRAIN}\nxyzzyq: 2\n": f":3: xyzzyq: unknown key; valid here: {TOP}",
    f"name: a\n{TRAIN}\nrally: {{run: x}}\n": f":3: rally: unknown key; valid here: {TOP} ({OF_PLUGIN})",
    f"name: a\n{TRAIN}\nnodez: {{run: x}}\n": f":3: nodez: unknown key; did you mean nodes? ({OF_PLUGIN})",
    "nme: a\ncommand: [x]\n": ":1: nme: unknown key; did you mean name? (also wrong or missing: name)",
    f"name: a\n{TRAIN}\nnodez: 2\nretyr: 2\n": ":3: nodez: unknown key; did you mean nodes? (also wrong or missing: retyr)",
    "name: a\ntrain:\n  task: Cartpole\n  worlds: 4\n  iteration: 2\n": (
        ":5: train.iteration: unknown key; did you mean iterations? (also wrong or missing: train.iterations)"
    ),
    "name: a\ncommand: [x]\nresources:\n  gpu: 1\n": ":4: resources.gpu: unknown key; did you mean gpus?",
    "name: a\nevaluate: {run: x, checkpont: 3}\n": ":2: evaluate.checkpont: unknown key; did you mean checkpoint?",
    "": f": {MAPPING} nothing",
    "- a\n": f": {MAPPING} a list",
    "text": f": {MAPPING} a string ('text')",
    "command: [x]\n": ": name: is required",
    "name: a\n": f": {ONE_OF} none",
    f"name: a\ncommand: [x]\n{TRAIN}\n": f": {ONE_OF} train and command",
    "name: a\ncommand: [x]\ntrain: {task: Ant}\n": f": {ONE_OF} train and command",
    "name: a\ntrain: {worlds: 4, iterations: 2}\n": ":2: train.task: is required",
    "name: a\nevaluate: {}\n": ":2: evaluate.run: is required",
    "name: a\ncommand: [x]\nresources:\n  gpus: 1\n  memory: 4 gigs\n": (
        ":5: resources.memory: expected an amount of memory such as 512MiB or 4GiB, found '4 gigs'"
    ),
    "name: a b\ncommand: [x]\n": f":1: name: {LETTERS}, found 'a b'",
    f"name: {'a' * 101}\ncommand: [x]\n": f":1: name: {LETTERS}, found '{'a' * 56}…",
    "name: 7\ncommand: [x]\n": ":1: name: expected a string, found an integer (7)",
    "name: on\ncommand: [x]\n": ":1: name: expected a string, found true or false (True)",
    "name: a\ncommand: python x\n": ":2: command: expected a list, found a string ('python x')",
    "name: a\ncommand:\n  - python\n  - 3\n": ":4: command.1: expected a string, found an integer (3)",
    'name: a\ncommand: [x, "a\\0b"]\n': ":2: command.1: expected a string without a zero byte, found 'a\\x00b'",
    "name: a\ncommand: [x]\nenvironment:\n  A: 1\n": ":4: environment.A: expected a string, found an integer (1)",
    "name: a\ntrain: Cartpole\n": ":2: train: expected an object, found a string ('Cartpole')",
    "name: a\ntrain: {task: Cartpoel, worlds: 4, iterations: 2}\n": (
        f":2: train.task: no task is called 'Cartpoel'; did you mean Cartpole? (your own: module:Class; {OF_PLUGIN})"
    ),
    "name: a\ntrain: {task: zzz, worlds: 4, iterations: 2}\n": (
        f":2: train.task: no task is called 'zzz'; available: {TASKS} (your own: module:Class; {OF_PLUGIN})"
    ),
    "name: a\nevaluate: {run: ../x}\n": f":2: evaluate.run: {RUN_LETTERS}, found '../x'",
    "name: a\nexport: {run: x, checkpoint: new}\n": (
        ":2: export.checkpoint: expected an iteration, best or latest, found 'new'"
    ),
}
"""Of whole files."""
NOT_YAML: dict[str | bytes, str] = {
    "name: a\nname: b\n": ":2: name: given twice, first on line 1",
    f"name: a\n{TRAIN}\nresources:\n  memory: 4GiB\n  memory: 5GiB\n": (
        ":5: resources.memory: given twice, first on line 4"
    ),
    "name: [a\n": ":2: not valid YAML: expected ',' or ']', but got '<stream end>'",
    "name: a\n\tb: c\n": ":2: not valid YAML: found character '\\t' that cannot start any token",
    "name: *x\n": ":1: not valid YAML: found undefined alias 'x'",
    "? [a]\n: b\n": ":1: not valid YAML: found unhashable key",
    "name: a\n---\nname: b\n": ":2: not valid YAML: but found another document",
    "name: !!python/object/apply:os.getcwd []\n": (
        ":1: not valid YAML: could not determine a constructor for the tag "
        "'tag:yaml.org,2002:python/object/apply:os.getcwd'"
    ),
    "name: \x01\n": ": not valid YAML: unacceptable character #x0001: special characters are not allowed",
    "a: &x {b: *x}\n": ":1: not valid YAML: an alias stands inside of what it stands for",
    b"name: \xff\n": ": not a text file (UTF-8)",
}


@pytest.mark.parametrize("text", FILES)
def test_a_wrong_or_missing_key_or_value_is_reported_with_its_line_and_what_is_valid(tmp_path: Path, text: str) -> None:
    assert problem(tmp_path, text) == f"job.yaml{FILES[text]}"


@pytest.mark.parametrize("text", NOT_YAML)
def test_text_that_is_not_yaml_is_reported_with_its_line(tmp_path: Path, text: str | bytes) -> None:
    assert problem(tmp_path, text).startswith(f"job.yaml{NOT_YAML[text]}")


def test_a_file_that_can_t_be_read_is_named(tmp_path: Path) -> None:
    for path, output in ((tmp_path / "none.yaml", "No such file or directory"), (tmp_path, "Is a directory")):
        assert refusal(load, str(path), error=SpecError) == f"{path}: {output}"


VALUES = st.none() | st.booleans() | st.integers(-3, 300) | st.floats() | st.text(max_size=6)
KEYS = st.sampled_from([*Spec.model_fields, "task", "worlds", "ppo", "min", "cpus", "zzz"]) | st.integers(0, 3)


@given(
    st.recursive(
        VALUES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=4), max_leaves=12
    )
)
def test_any_document_is_a_spec_or_refused_in_one_line(document: object) -> None:
    try:
        assert isinstance(validate(document, "job.yaml"), Spec)
    except SpecError as error:
        assert str(error).startswith("job.yaml: ")
        assert "\n" not in str(error)


# -- overrides --------------------------------------------------------------------------------------------------------


def test_a_value_on_the_command_line_takes_effect(tmp_path: Path) -> None:
    path = tmp_path / "job.yaml"
    path.write_text(f"name: a\n{TRAIN}\n")
    spec = load(str(path), ["train.iterations=9", "train.ppo.clip=0.3", "nodes={min: 1, max: 2}", "name=b"])
    assert spec.train
    assert (spec.train.iterations, spec.train.ppo.clip, spec.nodes.max, spec.name) == (9, 0.3, 2, "b")
    document = {"train": {"worlds": 4}}
    assert override(document, ["train.worlds=8"]) == {"train": {"worlds": 8}}
    assert document == {"train": {"worlds": 4}}, "it stays as it was"


NOT_AN_ASSIGNMENT = "expected KEY=VALUE, such as train.iterations=600"
OVERRIDES = {
    "x": f" x: {NOT_AN_ASSIGNMENT}",
    "=3": f" =3: {NOT_AN_ASSIGNMENT}",
    "train..x=3": f" train..x=3: {NOT_AN_ASSIGNMENT}",
    "name.x=1": " name.x=1: name is not a section",
    "nodes=[": (
        " nodes=[: the value is not valid YAML (line 1, nodes): expected the node content, but found '<stream end>'"
    ),
    "train.config={a: &a 1}": (
        " train.config={a: &a 1}: the value is not valid YAML (line 1, train.config.a): "
        "anchors and aliases (&a) are not accepted here; write the value out"
    ),
    "train.config={a: .inf}": ": train.config.a: expected a finite number, found a number (inf)",
    f"{'a.' * 60}a=1": f" {('a.' * 60)[:76]} … (47 more characters): the key has 61 levels; at most 50",
    "train.ppo.clp=0.3": ": train.ppo.clp: unknown key; did you mean clip?",
}


@pytest.mark.parametrize("assignment", OVERRIDES)
def test_a_wrong_override_is_reported(tmp_path: Path, assignment: str) -> None:
    assert problem(tmp_path, f"name: a\n{TRAIN}\n", assignment) == f"--set{OVERRIDES[assignment]}"


# -- what is right ----------------------------------------------------------------------------------------------------


SECONDS = {"90s": 90, "45m": 2700, "2h": 7200, "1d": 86400, "1.5 h": 5400, "600": 600}
MEBIBYTES = {"512MiB": 512, "4GiB": 4096, "0.5 GiB": 512, "1TiB": 2**20, "1GB": 953, "64": 64}


def command(**changes: object) -> Spec:
    return validate({"name": "a", "command": ["x"], **changes}, "s")


def test_durations_and_amounts_of_memory_are_read_in_their_units() -> None:
    assert {text: command(timeout=yaml.safe_load(text)).timeout for text in SECONDS} == SECONDS
    given = {text: {"memory": yaml.safe_load(text)} for text in MEBIBYTES}
    assert {text: command(resources=each).resources.memory for text, each in given.items()} == MEBIBYTES


def test_a_number_of_nodes_is_a_range_of_one_and_a_node_has_one_rank_a_gpu_and_at_least_one() -> None:
    assert (command(nodes=3).nodes.min, command(nodes=3).nodes.max) == (3, 3)
    assert [command(resources={"gpus": gpus}).ranks_per_node for gpus in (0, 1, 8)] == [1, 1, 8]


def test_the_known_tasks_are_the_installed_ones_and_a_user_s_is_named_by_module_and_class() -> None:
    document = {"name": "a", "train": {"task": "my_robot.tasks:Walker", "worlds": 1, "iterations": 1}}
    assert validate(document, "s").train.task == "my_robot.tasks:Walker"
    assert BUILT_IN.keys() <= set(known_tasks())


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.name)
def test_every_shipped_spec_is_valid_and_compiles_to_batch_requests(path: Path) -> None:
    spec = load(str(path))
    definition = compile_definition(spec, "/somewhere")
    assert json.loads(json.dumps(definition)) == definition
    needs = gang_needs(definition["nodeProperties"])
    assert len(needs.nodes) == spec.nodes.max and validate(needs.spec, "MUSTER_SPEC") == spec, "it comes back as it was"


# -- agreement with the worker ----------------------------------------------------------------------------------------


def bomb(levels: int) -> str:
    """Entries of a mapping in which each key stands for eight times the one before."""
    entries = ["a0: &a0 [x, x, x, x, x, x, x, x]"]
    entries += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 8)}]" for n in range(1, levels)]
    return ", ".join(entries)


def test_a_file_may_use_aliases_while_they_stand_for_little(tmp_path: Path) -> None:
    train = "{task: 'my:Task', worlds: 4, iterations: 2, config: {first: &c {size: 3}, second: {<<: *c}}}"
    (tmp_path / "job.yaml").write_text(f"name: a\ntrain: {train}\n")
    loaded = load(str(tmp_path / "job.yaml")).train
    assert loaded is not None and loaded.config == {"first": {"size": 3}, "second": {"size": 3}}
    output = problem(tmp_path, f"name: a\n{TRAIN}\nenvironment: {{{bomb(7)}}}\n")
    assert output == "job.yaml:3: not valid YAML: more than 10000 values with the aliases written out"


@pytest.mark.parametrize(
    ("value", "output"),
    [
        (f"{{{bomb(9)}}}", "train.config.a0): anchors and aliases (&a0) are not accepted here; write the value out"),
        ("[" * 5000, "nested deeper than 50 levels"),
        (f"[{'1,' * 11_000}1]", "more than 10000 values"),
        (f"0x{'f' * 20_000}", "a number of more than 64 bits"),
        ("!!binary /w==", "binary is not a kind of value that JSON has"),
        (f"'{'x' * 30_000}'", "30015 characters of changes; at most 24576"),
    ],
)
def test_a_change_beyond_a_limit_is_refused_in_one_short_line_that_names_it(value: str, output: str) -> None:
    refused = refusal(override, {}, [f"train.config={value}"], error=SpecError)
    assert output in refused and len(refused) < 400

"""The pydantic model of the job YAML: its schema, and errors that name file, line and key.

The spec compiles to ``RegisterJobDefinition`` and ``SubmitJob`` requests (:mod:`orchestrator.spec.compile`); there is no second
job model. It is carried whole in the definition's environment, so that a run can be resumed with changes.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self, get_args

from pydantic import (
    AfterValidator,
    BaseModel,
    Field,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    ValidationError,
    create_model,
    model_serializer,
    model_validator,
)

from orchestrator.domain.errors import SpecError
from orchestrator.domain.storable import Problem, not_finite, not_storable
from orchestrator.spec.sections import (
    ACCEPT,
    CheckpointPolicy,
    Evaluation,
    Logs,
    NodeRange,
    OfCheckpoint,
    Resources,
    Retry,
    Share,
)
from orchestrator.spec.settings import effective_problem, section_of, settings_classes, task_config, train_section
from orchestrator.spec.tracking_services import TrackingServices, key_in
from orchestrator.spec.values import (
    Argument,
    Duration,
    Environment,
    JobName,
    Secrets,
    Section,
    TaskName,
    place_of,
)
from shared_store.contract import plugins
from shared_store.contract.entry_points import clash
from shared_store.contract.error_text import OF_PLUGIN, Refused, explain, kind_of, nearest, other_places, path_of, shown
from shared_store.volume.texts import beside

KINDS = ("train", *plugins.evaluating(), "export", "record", "render", "command")
"""The kinds of jobs: a spec has exactly one of these keys."""


ALGORITHMS = settings_classes()
"""The settings class of each installed algorithm."""


def _algorithm_name(value: str) -> str:
    if words := clash(entry_points(group="muster.algorithms"), value):
        raise ValueError(words)
    known = list(ALGORITHMS)
    if value in known or re.fullmatch(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*", value):
        return value
    hint = nearest(value, known, f"available: {', '.join(known)}, or your own as module:Class")
    raise ValueError(f"no algorithm is called {shown(value)}; {hint}")


class _Train(Section):
    """Train a policy."""

    task: TaskName = Field(description="name of a task, or module:Class")
    worlds: int = Field(ge=1, description="simulated worlds of each rank")
    iterations: int = Field(ge=1)
    seed: int = Field(default=1, ge=0, lt=2**31)
    algorithm: Annotated[str, AfterValidator(_algorithm_name)] = Field(
        default="ppo", description="what learns: a name, or module:Class of your own; its settings stand under its name"
    )
    settings: dict[str, Any] = Field(default_factory=dict, description="of an algorithm of your own")
    config: dict[str, Any] = Field(default_factory=dict, description="overrides of the task's own configuration")
    accept_changed_robot: bool = ACCEPT
    hyperparameters: dict[str, Any] | str | None = Field(
        default=None,
        exclude=True,
        description="settings under other names that the task knows, or a JSON file of them; they become settings of ppo or sac",
    )

    @property
    def section(self) -> str:
        """Name of the section that holds the algorithm's settings."""
        return self.algorithm if self.algorithm in ALGORITHMS else "settings"

    @model_serializer(mode="wrap")
    def _without_other_algorithms(self, write: SerializerFunctionWrapHandler) -> dict[str, Any]:
        others = {"settings", *ALGORITHMS} - {self.section}
        written: dict[str, Any] = write(self)
        return {name: value for name, value in written.items() if name not in others}

    def overrides(self) -> dict[str, Any]:
        """The algorithm's settings that the job gives."""
        if self.section == "settings":
            return self.settings
        section: BaseModel = getattr(self, self.section)
        return {name: value for name, value in section.model_dump(mode="json").items() if value is not None}


if TYPE_CHECKING:
    Train = _Train
else:
    Train = train_section(_Train, {name: section_of(name, each, Section) for name, each in ALGORITHMS.items()})


class Evaluate(OfCheckpoint):
    """Evaluate a checkpoint of a run with the mean action."""

    episodes: int = Field(default=100, ge=1, le=1_000_000, description="of all ranks together")
    worlds: int = Field(default=1024, ge=1, description="simulated worlds of each rank, at most one for each episode")
    seed: int | None = Field(
        default=None, ge=0, lt=2**63, description="of the worlds; by default one that follows from the training's"
    )
    config: dict[str, Any] = Field(
        default_factory=dict, description="changes of the task's configuration with which the run was trained"
    )
    keep: bool = Field(default=True, description="whether the checkpoint is kept from now on")


class Export(OfCheckpoint):
    """Export the policy of a checkpoint as a bundle: ONNX, TorchScript, contract, and how they were compared with it."""

    episodes: int = Field(default=16, ge=0, description="on which bundle and policy are compared, at least; 0: none")
    worlds: int = Field(default=16, ge=1, description="simulated worlds of the comparison")


class Record(OfCheckpoint):
    """Record a checkpoint's policy on a few worlds as an MCAP file."""

    worlds: int = Field(default=4, ge=1, le=16, description="worlds that are recorded")
    episodes: int = Field(default=2, ge=1, description="episodes of each world")
    seed: int | None = Field(
        default=None, ge=0, lt=2**31, description="of the worlds; not that of the training where absent"
    )


class Render(OfCheckpoint):
    """Film a checkpoint's policy."""

    format: Literal["mp4", "gif", "png"] = Field(default="gif", description="png: six moments side by side")
    worlds: int = Field(default=4, ge=1, le=16, description="worlds, side by side")
    seconds: float = Field(default=6.0, gt=0, le=600, description="simulated")
    width: int = Field(default=640, ge=64, le=4096, description="of a frame [px]")
    height: int = Field(default=360, ge=64, le=4096, description="of a frame [px]")

    @model_validator(mode="after")
    def _has_even_sides(self) -> Render:
        if self.format == "mp4" and (self.width % 2 or self.height % 2):
            raise ValueError(
                f"an .mp4 has even sides: width {self.width // 2 * 2} and height {self.height // 2 * 2}, say, not "
                f"{self.width} and {self.height}"
            )
        return self


class _Spec(Section):
    """One job."""

    name: JobName
    queue: str = "default"
    share: Share | None = Field(default=None, description="share identifier, in a queue with a fair-share policy")
    priority: int = Field(default=0, ge=0, le=9999, description="within the share; greater is served first")
    preemptible: bool = Field(
        default=False, description="a job of higher priority may have its place: it checkpoints, leaves and waits again"
    )
    nodes: NodeRange = Field(default_factory=lambda: NodeRange(min=1, max=1))
    resources: Resources = Field(default_factory=Resources)
    train: Train | None = None
    evaluate: Evaluate | None = None
    export: Export | None = None
    record: Record | None = None
    render: Render | None = None
    command: list[Argument] | None = Field(
        default=None, min_length=1, description="program and arguments, run on every node"
    )
    environment: Environment = Field(default_factory=dict)
    secrets: Secrets = Field(
        default_factory=dict, description="variables and the names of their values, which the controller has"
    )
    track: TrackingServices | None = Field(default=None, description="services that get a training's metrics as well")
    image: Argument = Field(
        default="muster", min_length=1, description="container image; engines without images ignore it"
    )
    checkpoint: CheckpointPolicy = Field(default_factory=CheckpointPolicy)
    evaluation: Evaluation | None = Field(default=None, description="of checkpoints, while the job trains")
    logs: Logs = Field(default_factory=Logs)
    retry: Retry = Field(default_factory=Retry)
    on_child_failure: Literal["restart", "fail", "ignore"] = "restart"
    timeout: Annotated[Duration, Field(ge=60)] | None = Field(default=None, description="of each attempt, such as 2h")

    _notes: tuple[str, ...] = PrivateAttr(default=())
    stall_timeout: Annotated[Duration, Field(gt=0)] = Field(
        default=300.0, description="of one training iteration; a rank that takes longer is stuck, such as 5m"
    )

    @model_validator(mode="before")
    @classmethod
    def _no_second_kind(cls, document: Any) -> Any:
        """Checked first: other errors in a section that should not exist help nobody."""
        names = [kind for kind in KINDS if document.get(kind) is not None] if isinstance(document, Mapping) else []
        if len(names) > 1:
            raise ValueError(f"expected exactly one of {', '.join(KINDS)}; found {' and '.join(names)}")
        return document

    @model_validator(mode="after")
    def _is_consistent(self) -> _Spec:
        names = [kind for kind in KINDS if getattr(self, kind) is not None]
        if not names:
            raise ValueError(f"expected exactly one of {', '.join(KINDS)}; found none")
        if self.evaluation is not None and self.train is None:
            raise ValueError(f"evaluation is for jobs that train, not for {names[0]}")
        if names[0] in plugins.sections() and (self.nodes.max > 1 or self.resources.gpus > 1):
            raise ValueError(f"{names[0]}: it runs on one node with at most one GPU")
        if both := sorted(self.secrets.keys() & self.environment.keys()):
            raise ValueError(f"secrets: {both[0]} is in environment, too; give it once")
        if self.track is not None and self.train is None:
            raise ValueError(f"track: only a training has metrics to track; this job has {self.kind}")
        if self.track is not None and (key := key_in(self.environment)):
            raise ValueError(
                f"environment.{key}: the key would be stored in the run; remove it, and give it as a secret: "
                f"secrets: {{{key}: NAME}}"
            )
        return self

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the submitter."""
        _, texts = beside(self.document())
        kept = (
            f"{each.key}: {each.file}: {len(text.encode()):,} bytes: kept beside the job"
            for each, text in texts.items()
        )
        return (*self._notes, *kept)

    def document(self) -> dict[str, Any]:
        """It as JSON."""
        return self.model_dump(mode="json", exclude_none=True)

    def with_notes(self, notes: Iterable[str]) -> Self:
        """This spec, with further notes."""
        self._notes += tuple(notes)
        return self

    @property
    def kind(self) -> str:
        """Which of :data:`KINDS` this job is."""
        return next(kind for kind in KINDS if getattr(self, kind) is not None)

    @property
    def ranks_per_node(self) -> int:
        return max(1, self.resources.gpus)


def _section_model(section: plugins.JobSection) -> type[OfCheckpoint]:
    """The model of a plug-in's section. Raises PluginError: it can't be imported, or its key is there already."""
    model: type[OfCheckpoint] = plugins.load(section.model, type)
    if not issubclass(model, OfCheckpoint):
        raise plugins.failed(
            section.model, TypeError("it is not a subclass of orchestrator.spec.sections.OfCheckpoint")
        )
    if section.key in _Spec.model_fields:
        raise plugins.failed(
            section.model, ValueError(f"{section.key} is a key of every job; choose another for the section")
        )
    return model


if TYPE_CHECKING:
    Spec = _Spec
else:
    _added = {key: (_section_model(section) | None, None) for key, section in plugins.sections().items()}
    Spec = create_model("Spec", __base__=_Spec, __doc__=_Spec.__doc__, **_added)


def validate(
    value: object,
    source: str,
    lines: Mapping[tuple[str | int, ...], int] | None = None,
    *,
    merged: bool = True,
) -> Spec:
    """A spec from a plain mapping.

    Args:
        value: The content of the YAML or of a request.
        source: Its name in errors (a file name).
        lines: Line of each key path in the file, for errors; 0 of one that ``--set`` gave.
        merged: Whether what is given is also checked together with the defaults of task and algorithm, as far as they are known here.

    Raises:
        SpecError: One line naming the file, line and key, what was expected, and the nearest valid name.
    """
    if not isinstance(value, dict):
        raise SpecError(f"{source}: expected an object of keys such as name, nodes, train; found {kind_of(value)}")
    if problem := not_storable(value):
        path, words = problem
        raise SpecError(f"{place_of(path, source, lines)}{words}")
    try:
        value, notes = _plain(value)
    except Refused as error:
        raise SpecError(f"{place_of(error.path, source, lines)}{error.words}") from None
    try:
        spec = Spec.model_validate(value)
    except ValidationError as error:
        problems = error.errors(include_url=False)
        # a misspelt key comes before the one that is missing for it: it has a line, and a nearest name
        first = min(problems, key=lambda problem: problem["type"] != "extra_forbidden")
        path = path_of(first)
        more = other_places(map(path_of, problems), path)
        raise SpecError(f"{place_of(path, source, lines)}{_explain(first, path)}{more}") from None
    problem = not_finite(value)
    if not problem and spec.train:
        problem = _of_another_algorithm(spec.train) or (_problem_of(spec.train) if merged else None)
    if problem:
        path, words = problem
        raise SpecError(f"{place_of(path, source, lines)}{words}")
    return spec.with_notes([*notes, *(_notes_of(spec.train) if spec.train and merged else ())])


def _plain(document: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The document with plain settings in the place of ``train.hyperparameters``, and notes about them. Raises Refused."""
    train = document.get("train")
    if not isinstance(train, dict) or train.get("hyperparameters") is None:
        return document, []
    where, task = ("train", "hyperparameters"), train.get("task")
    kind = task_config(task) if isinstance(task, str) else None
    if kind is None or not hasattr(kind, "plain_settings"):
        raise Refused(where, f"task {shown(task)} is not installed, so they are not known; give train.ppo or train.sac")
    if isinstance(train["hyperparameters"], str):
        raise Refused(where, "a file is read for a job YAML alone; write its settings out")
    try:
        plain, notes = kind.plain_settings(train)
    except Refused as error:
        raise Refused(("train", *error.path), error.words) from None
    return {**document, "train": plain}, notes


def _of_another_algorithm(train: _Train) -> Problem | None:
    """Settings of an algorithm that is not the chosen one would change nothing."""
    names = [name for name in ALGORITHMS if any(value is not None for value in dict(getattr(train, name)).values())]
    names += ["settings"] if train.settings else []
    for name in names:
        if name != train.section:
            words = f"the algorithm is {train.algorithm}, so its settings belong under train.{train.section}"
            return ("train", name), words
    return None


def _problem_of(train: _Train) -> Problem | None:
    """A value of the task's configuration or of the algorithm's settings that the rank would refuse, and why; None where there is none.

    The settings of a task that is not installed here are checked by its rank.
    """
    kind = task_config(train.task)
    if kind is None:
        return None
    try:
        if train.config and (problem := kind.problem_with(train.config)):
            path, words = problem
            return ("train", "config", *path), words
        if settings := ALGORITHMS.get(train.algorithm):
            problem = effective_problem(settings, train.algorithm, kind.configured(train.config), train.overrides())
            if problem:
                path, words = problem
                return ("train", train.algorithm, *path), words
    except Exception:  # a defect of a user's class: its rank shows the traceback
        return None
    return None


def _notes_of(train: _Train) -> list[str]:
    """Notes on values of the task's configuration, which is valid as far as it is known here."""
    kind, found = task_config(train.task), list[str]()
    with suppress(Exception):  # a defect of a user's class: its rank shows the traceback
        found += kind.configured(train.config).notes(train.algorithm) if kind and train.config else ()
    return found


def _explain(problem: Any, path: tuple[str | int, ...]) -> str:
    if problem["type"] == "extra_forbidden":
        valid, algorithm = _keys_at(path[:-1]), ALGORITHMS.get(str(path[-2])) if len(path) == 3 else None
        if other := getattr(algorithm, "elsewhere", {}).get(str(path[-1])):
            return f"{path[-2]} has no such setting; {other}"
        hint = nearest(path[-1], valid, "valid here: " + ", ".join(valid))
        is_section = len(path) == 1 and isinstance(problem["input"], dict)
        return f"unknown key; {hint}" + (f" ({OF_PLUGIN})" if is_section else "")
    return explain(problem)


def _keys_at(path: tuple[str | int, ...]) -> list[str]:
    model: type[BaseModel] = Spec
    for part in path:
        annotation = model.model_fields[str(part)].annotation if str(part) in model.model_fields else None
        kinds = [kind for kind in (annotation, *get_args(annotation)) if isinstance(kind, type)]
        section = next((kind for kind in kinds if issubclass(kind, BaseModel)), None)
        if section is None:
            return []
        model = section
    return list(model.model_fields)

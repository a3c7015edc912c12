"""Tracking services: W&B and MLflow, each as what :mod:`worker.track` needs of it. Imports neither before it is asked for.

A service reports how far it has a run's history, and gets what comes after: nothing is sent twice, whatever died in between.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from shared_store.volume.evaluations import flattened
from shared_store.volume.files import remove_tree
from shared_store.volume.metrics import scalars

OUTCOMES = {"finished": "FINISHED", "stopped": "KILLED", "failed": "FAILED"}
"""The possible ends of a training, and MLflow's word for each."""
_METRICS, _PARAMETERS = 1000, 100
"""Most that MLflow takes in one request."""
_LONGEST = 6000
"""Characters of one of MLflow's parameters."""


class ServiceRefused(Exception):
    """The service can't be used as the job asks for it; the message, one line, says what to do."""


@dataclass(frozen=True)
class Tracked:
    """The facts that a service gets about a run, besides its metrics."""

    name: str
    task: str
    config: Mapping[str, Any]
    """Settings of the training, git commit, versions."""
    directory: Path
    """For files of the service's own."""


@dataclass(frozen=True)
class TrainingEnd:
    """The end of a training and the files uploaded then."""

    outcome: str
    """One of :data:`OUTCOMES`."""
    last: int
    """Its last iteration."""
    figures: Mapping[str, float]
    """Of the evaluation of its last checkpoint, by name."""
    files: Sequence[Path]


class Service:
    """One of the services. Each method may raise any error of the service; the caller tries again.

    Args:
        tracked: The run.
        settings: Of the service, in the job.

    Attributes:
        identity: By which the service knows the open run.
    """

    def __init__(self, tracked: Tracked, settings: Mapping[str, Any]) -> None:
        self._tracked, self._settings = tracked, settings
        self.identity = ""

    def prepare(self) -> None:
        """Find package and credentials, without the network. Raises ServiceRefused."""

    def open(self, identity: str | None, fresh: str) -> int:
        """Begin to send to the run ``identity``, or to a new one called ``fresh``; returns the last iteration that it has, 0 for none."""
        raise NotImplementedError

    @property
    def place(self) -> str:
        """Address of the open run for a browser."""
        raise NotImplementedError

    def send(self, records: Sequence[Mapping[str, Any]]) -> None:
        """Send whole iterations, in order."""

    def finish(self, ending: TrainingEnd) -> None:
        """Upload what exists at the end, and close the run."""

    def leave(self) -> None:
        """Close the run as it is."""


class WandB(Service):
    """Weights & Biases, through its own client: it sends on threads, and tries again while its server can't be reached."""

    _offline = False
    _run: Any = None

    def prepare(self) -> None:
        self._wandb = _package("wandb")
        # before its first use: it writes nothing to the terminal, and asks for no key
        known = self._wandb.setup(settings=self._wandb.Settings(silent=True, console="off")).settings
        mode = self._settings.get("mode") or known.mode
        if mode == "disabled":
            raise ServiceRefused("WANDB_MODE is disabled; remove wandb from track, or choose online or offline")
        self._offline = mode in ("offline", "dryrun")
        if self._offline:
            return
        what_to_do = "set WANDB_API_KEY where the job runs, as a secret or with `wandb login`, or choose mode: offline"
        try:
            has_key = self._wandb.login(verify=False)
        except self._wandb.errors.UsageError:  # there is no terminal to ask at
            has_key = False
        except (self._wandb.Error, ValueError) as error:
            raise ServiceRefused(f"{one_line(error).rstrip('.')}; {what_to_do}") from None
        if not has_key:
            raise ServiceRefused(f"there is no key for {known.base_url}; {what_to_do}")

    def open(self, identity: str | None, fresh: str) -> int:
        self.identity = identity or fresh
        directory = self._tracked.directory
        directory.mkdir(exist_ok=True)
        if self._offline:  # a file that a kill has cut lacks what was in memory: the new one has the whole history
            for old in (directory / "wandb").glob(f"offline-run-*-{self.identity}"):
                remove_tree(old)
        labels = {key: self._settings[key] for key in ("entity", "group", "tags") if self._settings.get(key)}
        project = self._settings.get("project") or os.environ.get("WANDB_PROJECT") or self._tracked.task
        settings = {"silent": True, "console": "off", "save_code": False, "disable_job_creation": True}
        self._run = self._wandb.init(
            id=self.identity,
            name=self.identity,
            project=project,
            dir=str(directory),
            mode="offline" if self._offline else "online",
            resume=None if self._offline else "allow",
            config=dict(self._tracked.config),
            settings=self._wandb.Settings(**settings, init_timeout=30),
            **labels,
        )
        return max(0, self._run.step - 1) if self._run.resumed else 0

    @property
    def place(self) -> str:
        if self._offline:
            return f"offline, in {Path(self._run.dir).parent} (send it with `wandb sync`)"
        return str(self._run.url)

    def send(self, records: Sequence[Mapping[str, Any]]) -> None:
        for record in records:
            time = {"_timestamp": record["time"]} if "time" in record else {}
            self._run.log({**scalars(record), **time}, step=record["iteration"])

    def finish(self, ending: TrainingEnd) -> None:
        pictures = {f"media/{path.stem}": path for path in ending.files if path.suffix == ".png"}
        if pictures:  # a part of the last iteration
            images = {name: self._wandb.Image(str(path)) for name, path in pictures.items()}
            self._run.log(images, step=ending.last)
        for path in ending.files:
            self._run.save(str(path), base_path=str(path.parent), policy="now")
        self._run.summary.update(dict(ending.figures))
        if ending.outcome == "stopped":
            self._run.mark_preempting()
        self._run.finish(exit_code=0 if ending.outcome == "finished" else 1)

    def leave(self) -> None:
        self._run.finish()


class MLflow(Service):
    """MLflow: a tracking server, or a database file."""

    def prepare(self) -> None:
        # its own patience is ten minutes a request; what it gives up is tried again here
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
        os.environ.setdefault("MLFLOW_HTTP_REQUEST_TIMEOUT", "20")
        uri = self._settings.get("uri") or os.environ.get("MLFLOW_TRACKING_URI")
        if not uri:
            raise ServiceRefused("there is no server: set track.mlflow.uri, or MLFLOW_TRACKING_URI where the job runs")
        self._entities = _package("mlflow.entities")
        try:
            self._client = _package("mlflow").MlflowClient(uri)
        except Exception as error:  # MlflowException, and whatever else a URI leads to
            raise ServiceRefused(one_line(error)) from None

    def open(self, identity: str | None, fresh: str) -> int:
        name = self._settings.get("experiment") or os.environ.get("MLFLOW_EXPERIMENT_NAME") or self._tracked.task
        found = self._client.get_experiment_by_name(name)
        self._experiment = found.experiment_id if found else self._client.create_experiment(name)
        if identity is None:  # one that was created before a kill, and was not noted
            same = self._client.search_runs([self._experiment], f"tags.`muster.run` = '{fresh}'", max_results=1)
            tags = {**self._settings.get("tags", {}), "muster.run": fresh}
            made = same[0] if same else self._client.create_run(self._experiment, run_name=fresh, tags=tags)
            identity = str(made.info.run_id)
        self.identity = identity
        self._client.update_run(identity, status="RUNNING")
        self._describe()
        steps = self._client.get_metric_history(identity, "train/env_steps")
        return max((each.step for each in steps), default=0)

    def _describe(self) -> None:
        """Send the parameters that the run lacks: all of a new one, the rest where a kill came between."""
        has = self._client.get_run(self.identity).data.params
        lacking = [(key, value) for key, value in flattened(self._tracked.config) if key not in has]
        for part in _parts([self._entities.Param(key, str(value)[:_LONGEST]) for key, value in lacking], _PARAMETERS):
            self._client.log_batch(self.identity, params=part)

    @property
    def place(self) -> str:
        return f"{self._client.tracking_uri}, experiment {self._experiment}, run {self.identity}"

    def send(self, records: Sequence[Mapping[str, Any]]) -> None:
        batch: list[Any] = []
        for record in records:  # whole iterations, so that the last one that is there is complete
            time = int(record.get("time", 0.0) * 1000)
            metrics = [
                self._entities.Metric(name, value, time, record["iteration"])
                for name, value in sorted(scalars(record).items(), key=lambda pair: pair[0] == "train/env_steps")
            ]
            if batch and len(batch) + len(metrics) > _METRICS:
                self._client.log_batch(self.identity, metrics=batch)
                batch = []
            batch += metrics
        for part in _parts(batch, _METRICS):
            self._client.log_batch(self.identity, metrics=part)

    def finish(self, ending: TrainingEnd) -> None:
        for name, value in ending.figures.items():
            self._client.log_metric(self.identity, name, value, step=ending.last)
        for path in ending.files:
            self._client.log_artifact(self.identity, str(path))
        self._client.set_terminated(self.identity, OUTCOMES[ending.outcome])

    def leave(self) -> None:
        self._client.set_terminated(self.identity, OUTCOMES["stopped"])


SERVICES: dict[str, type[Service]] = {"wandb": WandB, "mlflow": MLflow}


def one_line(error: BaseException) -> str:
    """An error as a line of at most 300 characters, without a key."""
    return without_key(" ".join(str(error).split()))[:300] or type(error).__name__


def without_key(text: str) -> str:
    """A text whose URIs name no user and no password."""
    return re.sub(r"//[^/@\s]*@", "//", text)


def _package(name: str) -> Any:
    package = name.partition(".")[0]
    try:
        return import_module(name)
    except ImportError as error:
        raise ServiceRefused(
            f"{package} can't be imported where this job runs ({one_line(error)}); pip install 'muster[{package}]' there"
        ) from None


def _parts(values: list[Any], size: int) -> Iterator[list[Any]]:
    yield from (values[start : start + size] for start in range(0, len(values), size))

"""The configuration of the ``aws-batch`` engine: facts about an account in ``$MUSTER_HOME/aws.json``, written by ``muster aws up``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from orchestrator.engines.api import EngineError
from orchestrator.engines.aws_batch import OPTIONS
from shared_store.contract.error_text import explain, nearest, shown


class AwsConfig(BaseModel):
    """The account, the queue and the resources on AWS that jobs use."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    region: str
    job_queue: str
    """Name or ARN."""
    image: str
    """The image that stands for ``muster`` there."""
    log_group: str = "/aws/batch/job"
    file_system: str | None = None
    """EFS file system; without one ``store`` must be on the instances already."""
    access_point: str | None = None
    store: str = "/muster/store"
    """Path of the shared volume on a node."""
    store_is_shared: bool | None = None
    """Whether the controller's own store is that volume; None: where it is mounted from it."""
    job_role: str | None = None
    instance_type: str | None = None
    share: str | None = None
    """Share identifier, where the queue has a fair-share policy."""
    efa: bool = False
    max_vcpus: int = Field(default=256, ge=1)
    """vCPUs to which the compute environment may grow, until AWS has answered."""
    poll: float = Field(default=2.0, gt=0)
    """Seconds between two polls of a gang and its logs."""
    quiet: float = Field(default=6.0, ge=0)
    """Seconds without a line after a node's end, after which its log is whole: AWS's log driver sends every five."""
    endpoint_url: str | None = None
    stack: str | None = None
    profile: str | None = None

    def with_options(self, options: Mapping[str, str]) -> AwsConfig:
        """The same with the values of tags."""
        found = {option.name.replace("-", "_"): options[option.name] for option in OPTIONS if options.get(option.name)}
        return self.model_copy(update=found)


def config_path(home: Path) -> Path:
    return home / "aws.json"


def load_config(home: Path) -> AwsConfig:
    """Read ``aws.json``. Raises EngineError where it is missing or damaged: one line with what to do."""
    path = config_path(home)
    try:
        return AwsConfig.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        raise EngineError(
            f"{path} is missing: the aws-batch engine does not know where to send jobs; make the stack with `muster aws up`"
        ) from None
    except OSError as error:
        raise EngineError(f"{path}: can't be read: {error.strerror}; make it readable for this user") from None
    except ValidationError as error:
        raise EngineError(f"{path}: {problem_of(error)}") from None


def problem_of(error: ValidationError) -> str:
    """The key and what is wrong with it, in one line."""
    # a misspelt key comes before the one that is missing for it
    problem = min(error.errors(), key=lambda problem: problem["type"] != "extra_forbidden")
    if not problem["loc"]:  # the document as a whole
        wrong = problem["msg"] if problem["type"] == "json_invalid" else explain(problem)
        return f"{wrong}; `muster aws up` writes it anew"
    key = problem["loc"][0]
    if problem["type"] == "extra_forbidden":
        return f"unknown key {shown(key)}; {nearest(key, AwsConfig.model_fields)}"
    return f"{key}: {explain(problem)}"


def save_config(home: Path, config: AwsConfig) -> Path:
    """Write ``aws.json``; returns its path. Raises OSError."""
    home.mkdir(mode=0o700, parents=True, exist_ok=True)
    path = config_path(home)
    path.write_text(config.model_dump_json(indent=1, exclude_none=True) + "\n")
    return path


def is_mounted_from(path: Path, file_system: str | None, mounts: str) -> bool:
    """Whether ``path`` lies on a mount of the EFS file system; without one, on any NFS.

    Args:
        path: A directory, with its links followed.
        file_system: Id, ``fs-…``. Amazon's own mount helper hides it behind a tunnel on 127.0.0.1.
        mounts: What ``/proc/self/mountinfo`` says.
    """
    best, kind, source = "", "", ""
    for line in mounts.splitlines():
        left, _, right = line.partition(" - ")
        point = left.split()[4]
        if f"{path}/".startswith(point.rstrip("/") + "/") and len(point) >= len(best):
            best, (kind, source) = point, right.split()[:2]
    return kind.startswith("nfs") and (file_system is None or source.startswith((file_system, "127.0.0.1:")))

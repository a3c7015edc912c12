"""The AWS Batch engine."""

from __future__ import annotations

from orchestrator.engines.api import Engine, EngineError, EngineType, Option, SecretValues, Setting, Traits

TRAITS = Traits(elastic=True, images=True, users=True, secrets=SecretValues.REFERENCES, launches=8)


def _make(setting: Setting) -> Engine:
    try:
        from orchestrator.engines.aws_batch.engine import AwsBatchEngine
    except ModuleNotFoundError as error:
        raise EngineError("the aws-batch engine is not installed: pip install 'muster[aws]'") from error
    return AwsBatchEngine(setting.home)


OPTIONS = (
    Option("job-queue", "an AWS Batch queue"),
    Option("image", "the image that `muster` means"),
    Option("job-role", "a role of the jobs"),
    Option("instance-type", "a type of instance"),
    Option("share", "a share identifier"),
)
"""Each stands over the key of the same name, with ``_``, in ``aws.json``."""

ENGINE = EngineType(_make, OPTIONS, TRAITS)

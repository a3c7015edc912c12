"""AWS's own models of its services: data that botocore ships. Its sessions and clients, which take long to import, are not needed."""

from __future__ import annotations

from functools import cache
from typing import Any

from botocore.loaders import Loader
from botocore.model import ServiceModel
from botocore.validate import ParamValidator


@cache
def service_model(name: str) -> Any:
    """The newest model of a service, such as ``batch`` or ``logs``."""
    return ServiceModel(Loader().load_service_model(name, "service-2"), name)


def problem_with(service: str, operation: str, request: dict[str, Any]) -> str:
    """What the model has against a request, in one line in botocore's words; empty where it is valid."""
    report = ParamValidator().validate(request, service_model(service).operation_model(operation).input_shape)
    return " ".join(report.generate_report().split())

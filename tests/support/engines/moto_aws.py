"""moto as AWS, with its server in this process, and what it lacks of CloudFormation for our template."""

from __future__ import annotations

import json
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from moto.batch import models as batch
from moto.batch.utils import lowercase_first_key
from moto.cloudformation.parsing import ResourceMap
from moto.ec2.models import ec2_backends
from moto.ec2.models.route_tables import RouteTable
from moto.efs.models import AccessPoint
from moto.server import ThreadedMotoServer


def _definition(
    cls: Any, /, resource_name: str, cloudformation_json: dict[str, Any], account_id: str, region_name: str, **_: Any
) -> Any:
    """moto takes every definition of a template for one of a single container; this passes on what it is."""
    properties = cloudformation_json["Properties"]
    given: dict[str, Any] = dict(
        def_name=resource_name,
        parameters={},
        _type=properties["Type"],
        tags={},
        retry_strategy=lowercase_first_key(properties["RetryStrategy"]),
        container_properties=None,
        node_properties=lowercase_first_key(properties["NodeProperties"]),
        eks_properties=None,
        timeout=lowercase_first_key(properties["Timeout"]),
        platform_capabilities=None,
        propagate_tags=properties["PropagateTags"],
    )
    return batch.batch_backends[account_id][region_name].register_job_definition(**given)


_environment_of = batch.ComputeEnvironment.create_from_cloudformation_json


def _environment(
    cls: Any, /, resource_name: str, cloudformation_json: dict[str, Any], account_id: str, region_name: str, **_: Any
) -> Any:
    """moto wants a service role; AWS takes its service-linked one, which it makes with the first compute environment."""
    roles = batch.batch_backends[account_id][region_name].iam_backend
    made = (role for role in roles.roles.values() if role.name == "AWSServiceRoleForBatch")
    role = next(made, None) or roles.create_service_linked_role("batch.amazonaws.com", "", "")
    properties = {"ServiceRole": role.arn, **cloudformation_json["Properties"]}
    return _environment_of(resource_name, {"Properties": properties}, account_id, region_name)


def _delete_table(table: RouteTable, account: str, region: str) -> None:
    ec2_backends[account][region].route_tables.pop(table.id, None)


_delete = ResourceMap.delete


def _delete_stack(resources: ResourceMap) -> None:
    """moto does not know the newer word for a resource that outlives its stack, where that was ever whole."""
    for resource in resources._resource_json_map.values():
        if resource.get("DeletionPolicy") == "RetainExceptOnCreate":
            resource["DeletionPolicy"] = "Retain"
    _delete(resources)


@contextmanager
def moto_server() -> Iterator[str]:
    """The URL of a moto that has no account's state yet."""
    with pytest.MonkeyPatch.context() as patch:
        reference = property(lambda point: point.access_point_id)  # what `Ref` of one gives
        patch.setattr(AccessPoint, "physical_resource_id", reference, raising=False)
        patch.setattr(RouteTable, "delete", _delete_table, raising=False)
        patch.setattr(batch.JobDefinition, "create_from_cloudformation_json", classmethod(_definition))
        patch.setattr(batch.ComputeEnvironment, "create_from_cloudformation_json", classmethod(_environment))
        patch.setattr(ResourceMap, "delete", _delete_stack)
        server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        server.start()
        try:
            host, port = server.get_host_and_port()
            url = f"http://{host}:{port}"
            post(url, "/moto-api/reset", {})
            post(url, "/moto-api/config", {"batch": {"use_docker": False}})
            yield url
        finally:
            server.stop()


def post(url: str, path: str, body: object) -> None:
    request = urllib.request.Request(url + path, json.dumps(body).encode(), {"Content-Type": "application/json"})
    urllib.request.urlopen(request, timeout=30).read()

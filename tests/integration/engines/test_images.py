"""Images of the Docker engine: one that brings its command, and one that can't be pulled."""

from __future__ import annotations

import io
import socket
import tarfile
from collections.abc import Iterator
from typing import Any

import pytest

from shared_store import __version__
from tests.conftest import Serving
from tests.support import definitions
from tests.support.engines.images import PATH, host_files


@pytest.fixture(scope="module")
def served(docker_client: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    with Serving(tmp_path_factory.mktemp("images"), "--engine", "docker") as server:
        yield server


ENTRY = 'ENTRYPOINT ["echo", "entrypoint"]'


@pytest.mark.parametrize("labels", [(), (f"LABEL muster.version={__version__}",)], ids=["plain", "supervised"])
@pytest.mark.parametrize(
    ("kind", "own", "lines"),
    [
        ("container", (ENTRY, 'CMD ["of", "the image"]'), ("entrypoint of the image", "entrypoint of the job")),
        ("multinode", (ENTRY, 'CMD ["of", "the image"]'), ("entrypoint of the image", "entrypoint of the job")),
        ("multinode", (ENTRY,), ("entrypoint", "entrypoint of the job")),
        ("container", ('CMD ["echo", "command alone"]',), ("command alone",)),
        ("container", ("ENTRYPOINT exec sh -c 'echo entrypoint of the shell'",), ("entrypoint of the shell",)),
    ],
)
def test_a_definition_without_a_command_runs_that_of_its_image_unless_the_submission_has_one(
    served: Serving,
    docker_client: Any,
    kind: str,
    own: tuple[str, ...],
    lines: tuple[str, ...],
    labels: tuple[str, ...],
) -> None:
    """As Docker runs it by itself."""
    empty = io.BytesIO()
    with tarfile.open(fileobj=empty, mode="w"):
        pass
    changes = [*own, *labels]
    docker_client.api.import_image_from_data(empty.getvalue(), repository="muster-test-own", tag="1", changes=changes)
    properties = {**definitions.container(env={"PATH": PATH}), "image": "muster-test-own:1", **host_files()}
    del properties["command"]
    make = definitions.single if kind == "container" else definitions.multinode
    arn = served.client.batch("RegisterJobDefinition", **make("own", properties))["jobDefinitionArn"]
    change: dict[str, Any] = {"containerOverrides": {"command": ["of", "the job"]}}
    if kind == "multinode":
        change = {"nodeOverrides": {"nodePropertyOverrides": [{"targetNodes": "0:", **change}]}}
    for more, line in zip(({}, change), lines, strict=False):
        job = served.client.batch("SubmitJob", jobName="own", jobQueue="default", jobDefinition=arn, **more)["jobId"]
        assert served.wait(job)["status"] == "SUCCEEDED", served.detail(job)
        assert line in served.log(job)
    docker_client.images.remove("muster-test-own:1", force=True)


def test_an_image_that_can_t_be_pulled_is_the_container_s_reason(served: Serving) -> None:
    with socket.create_server(("127.0.0.1", 0)) as closed:
        image = f"127.0.0.1:{closed.getsockname()[1]}/none:1"
    needs = {"resourceRequirements": definitions.NEEDS, "image": image}
    arn = served.client.batch("RegisterJobDefinition", **definitions.single("far", needs))["jobDefinitionArn"]
    job = served.client.batch("SubmitJob", jobName="far", jobQueue="default", jobDefinition=arn)["jobId"]
    assert served.wait(job)["status"] == "FAILED"
    [detail] = served.client.batch("DescribeJobs", jobs=[job])["jobs"]
    assert (
        detail["container"]["reason"].startswith("CannotPullContainerError: ") and "exitCode" not in detail["container"]
    )
    assert detail["attempts"][0]["container"]["reason"] == detail["container"]["reason"]

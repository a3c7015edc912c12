"""Images of the Docker engine: one that brings its command, and one that can't be pulled."""

from __future__ import annotations

import io
import socket
import tarfile
from collections.abc import Iterator
from typing import Any

import pytest

from tests.conftest import Serving
from tests.support import definitions
from tests.support.engines.images import PATH, host_files


@pytest.fixture(scope="module")
def served(docker_client: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Serving]:
    with Serving(tmp_path_factory.mktemp("images"), "--engine", "docker") as server:
        yield server


@pytest.mark.parametrize("kind", ["container", "multinode"])
def test_a_definition_without_a_command_runs_that_of_its_image_unless_the_submission_has_one(
    served: Serving, docker_client: Any, kind: str
) -> None:
    empty = io.BytesIO()
    with tarfile.open(fileobj=empty, mode="w"):
        pass
    own = ['ENTRYPOINT ["echo", "entrypoint"]', 'CMD ["of", "the image"]']
    docker_client.api.import_image_from_data(empty.getvalue(), repository="muster-test-own", tag="1", changes=own)
    properties = {**definitions.container(env={"PATH": PATH}), "image": "muster-test-own:1", **host_files()}
    del properties["command"]
    make = definitions.single if kind == "container" else definitions.multinode
    arn = served.client.batch("RegisterJobDefinition", **make("own", properties))["jobDefinitionArn"]
    change: dict[str, Any] = {"containerOverrides": {"command": ["of", "the job"]}}
    if kind == "multinode":
        change = {"nodeOverrides": {"nodePropertyOverrides": [{"targetNodes": "0:", **change}]}}
    for more, line in (({}, "entrypoint of the image"), (change, "entrypoint of the job")):
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

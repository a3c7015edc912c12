"""Images made of nothing but this machine's own files, mounted read-only: no registry is needed."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from tests.conftest import REPOSITORY, Serving
from tests.support.definitions import NEEDS, multinode
from tests.support.definitions import container as properties

PLAIN, SUPERVISED = "muster-test-plain:1", "muster-test:1"
"""An empty image, and one that says that Muster is in it."""
PATH = f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin:/bin"


def host_files() -> dict[str, Any]:
    """``containerProperties`` with which an empty image has this machine's programs, Python and this repository."""
    needed = {"/usr", "/bin", "/lib", "/lib64", "/etc"}
    needed |= {str(REPOSITORY), sys.base_prefix, str(Path(sys.executable).parent.parent)}
    paths = sorted(path for path in needed if Path(path).is_dir())
    paths = [path for path in paths if not any(path != other and path.startswith(f"{other}/") for other in paths)]
    return {
        "volumes": [{"name": f"v{number}", "host": {"sourcePath": path}} for number, path in enumerate(paths)],
        "mountPoints": [
            {"sourceVolume": f"v{number}", "containerPath": path, "readOnly": True} for number, path in enumerate(paths)
        ],
    }


def plain(served: Serving, image: str, script: str, queue: str = "default", **container: Any) -> str:
    """A gang of one in ``image``; returns the job id."""
    needs = {"resourceRequirements": [NEEDS[0], {"type": "MEMORY", "value": "64"}], "image": image, **container}
    definition = multinode("plain", properties(["sh", "-c", script], **needs))
    arn = served.client.batch("RegisterJobDefinition", **definition)["jobDefinitionArn"]
    job: str = served.client.batch("SubmitJob", jobName="plain", jobQueue=queue, jobDefinition=arn)["jobId"]
    return job

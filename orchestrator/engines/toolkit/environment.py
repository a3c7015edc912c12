"""The environment that an engine's processes have from the controller's own: what programs need to run, and what a user names."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Collection, Mapping, Sequence

from shared_store.contract.node import sealed

INHERIT = "MUSTER_INHERIT"
"""Variable that names others to inherit, with spaces between: ``muster serve --inherit NAME``."""
PRIVATE = (
    *("MUSTER_TOKEN", "MUSTER_URL", "MUSTER_KILL_AT", "MUSTER_DATABASE", "PGPASSWORD", "PGPASSFILE", INHERIT),
    *("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_SECURITY_TOKEN"),
    *("AWS_CONTAINER_AUTHORIZATION_TOKEN", "RAY_AUTH_TOKEN", "SLURM_JWT"),
)
"""Variables of the controller that jobs don't get, whoever names them: its credentials for the database and the engines."""
COMMON = (
    *("PATH", "HOME", "USER", "LOGNAME", "SHELL", "HOSTNAME", "TZ", "LANG", "LANGUAGE", "TERM", "TMPDIR", "PWD"),
    *("VIRTUAL_ENV", "LD_LIBRARY_PATH", "LD_PRELOAD", "DISPLAY", "MUJOCO_GL", "PYOPENGL_PLATFORM"),
    *("http_proxy", "https_proxy", "ftp_proxy", "no_proxy", "all_proxy"),
    *("HTTP_PROXY", "HTTPS_PROXY", "FTP_PROXY", "NO_PROXY", "ALL_PROXY"),
    *("SSL_CERT_FILE", "SSL_CERT_DIR", "REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE", "AWS_CA_BUNDLE", "PIP_CERT"),
    *("GIT_SSL_CAINFO", "NODE_EXTRA_CA_CERTS"),
)
"""Variables without which programs do not find their files, their libraries or the network."""
FAMILIES = (
    *("LC_", "XDG_", "PYTHON", "CONDA", "MUSTER_", "WARP_", "NEWTON_", "TORCH", "PYTORCH_", "CUDA_", "NVIDIA_"),
    *("NCCL_", "GLOO_", "TP_", "OMP_", "MKL_", "OPENBLAS_", "KMP_", "RAY_", "ROS_", "RMW_", "ZENOH_"),
)
"""What the names of the settings of interpreters, libraries and Muster itself begin with."""
_SECRET = re.compile(r"(KEY|TOKEN|PASSWORD|PASSWD|SECRET|CREDENTIAL)S?$")
"""How the names of secrets end: such a variable is inherited only if a user names it, whatever its family."""


def named_variables() -> list[str]:
    """The variables that ``--inherit`` names, without those that are the controller's own."""
    return [name for name in os.environ.get(INHERIT, "").split() if name not in PRIVATE]


def inherited(
    withheld: Collection[str] = (),
    prefixes: tuple[str, ...] = (),
    kept: Collection[str] = (),
    named: Collection[str] | None = None,
) -> dict[str, str]:
    """This process's variables that jobs may have.

    Args:
        withheld, prefixes: Names, and beginnings of names, that are left out, too, unless a user names them.
        kept: Names that stay all the same, private or not.
        named: Others that jobs get; None: :func:`named_variables`.
    """
    added = {*(named_variables() if named is None else named), *kept}
    left_out = {*PRIVATE, *withheld}

    def is_common(name: str) -> bool:
        known = name in COMMON or (name.startswith(FAMILIES) and not _SECRET.search(name))
        return known and name not in left_out and not name.startswith(prefixes)

    return {name: value for name, value in os.environ.items() if name in added or is_common(name)}


def supervised(command: Sequence[str]) -> list[str]:
    """The command of a node that runs in this process's Python environment."""
    # -P: a folder called "worker" in the job's directory must not hide ours
    return [sys.executable, "-P", "-m", "worker.supervisor", "--", *command]


def node_environment(
    own: Mapping[str, str], gpus: str, job: Mapping[str, str], contract: Mapping[str, str]
) -> dict[str, str]:
    """The environment of such a node; what stands later goes over what stands before.

    Args:
        own: Of this machine: see :func:`inherited`.
        gpus: ``CUDA_VISIBLE_DEVICES``.
        job: The job's own.
        contract: The node contract.
    """
    path = f"{os.path.dirname(sys.executable)}:{own.get('PATH', '/usr/bin:/bin')}"
    return {**own, "PATH": path, "CUDA_VISIBLE_DEVICES": gpus, **sealed(job, contract)}

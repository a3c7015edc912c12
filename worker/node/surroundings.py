"""The surroundings of a program on a node that is a plain process: variables, directory, user, memory.

A job from YAML has the directory where it was submitted and the machine's variables. One that came through the Batch API was
written for a container: it starts in an empty directory, which goes with the attempt, with a standard PATH and of the machine's
variables those only that say where things are: language, time zone, proxies, certificates, GPUs.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import ipaddress
import os
import pwd
import shutil
import socket
import struct
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

from shared_store.contract.node import NodeContract, job_variables, rank_variables
from shared_store.process.memory_groups import killed_for_memory, make_memory_group

_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
_KEPT = (
    *("LANG", "LANGUAGE", "TZ", "TMPDIR", "LD_LIBRARY_PATH", "WARP_CACHE_PATH"),
    *("http_proxy", "https_proxy", "ftp_proxy", "no_proxy", "all_proxy"),
    *("HTTP_PROXY", "HTTPS_PROXY", "FTP_PROXY", "NO_PROXY", "ALL_PROXY"),
    *("SSL_CERT_FILE", "SSL_CERT_DIR", "REQUESTS_CA_BUNDLE", "CURL_CA_BUNDLE", "AWS_CA_BUNDLE", "PIP_CERT"),
    *("GIT_SSL_CAINFO", "NODE_EXTRA_CA_CERTS"),
)
_KEPT_PREFIXES = ("LC_", "CUDA_", "NVIDIA_", "NCCL_", "GLOO_")
_SIOCGIFADDR = 0x8915
KEEP = "MUSTER_KEEP_DIRECTORY"
"""A job that sets this variable to 1 keeps its directories when the attempt is over."""


class Surroundings:
    """Of the ranks of one node, made before they start."""

    def __init__(self, contract: NodeContract, scratch: Path, environment: Mapping[str, str] = os.environ) -> None:
        """Args:
        contract: Of the node.
        scratch: The supervisor's own directory, which goes with it.
        environment: The supervisor's variables.

        Raises OSError.
        """
        own = job_variables(environment)
        self.environment = rank_variables(environment)
        self.directory: Path | None = None
        """Working directory; None: that of the supervisor."""
        self.prefix: list[str] = []
        """Put before the command."""
        self.kept: Path | None = None
        """The files that are not removed at the end."""
        made = [scratch]
        if contract.isolation:
            if own.get(KEEP) == "1":
                self.kept = Path(tempfile.mkdtemp(prefix=f"muster-kept-{contract.job[:8]}-{contract.node_index}-"))
            above = self.kept or scratch
            home, work = above / "home", above / "work"
            home.mkdir()
            work.mkdir()
            if "MUSTER_DIRECTORY" not in own:
                self.directory = work
            path = f"{Path(sys.executable).parent}:{_PATH}" if contract.isolation == "muster" else _PATH
            kept = {*_KEPT, *contract.to_env()}
            inherited = {
                name: value for name, value in environment.items() if name in kept or name.startswith(_KEPT_PREFIXES)
            }
            self.environment = {**inherited, "PATH": path, "HOME": str(home), **own}
            made += [above, home, work]
        if contract.user:
            self._become(contract, contract.user, made)

    def _become(self, contract: NodeContract, user: str, directories: list[Path]) -> None:
        """Have the program run as ``UID:GID``, and these directories belong to it."""
        uid, gid = (int(part) for part in user.split(":"))
        for directory in directories:
            os.chown(directory, uid, gid)
        try:
            found = pwd.getpwuid(uid)
            groups = "--init-groups"
            own = {} if contract.isolation else {"HOME": found.pw_dir}
            self.environment |= {"USER": found.pw_name, "LOGNAME": found.pw_name, **own}
        except KeyError:
            groups = "--clear-groups"
        # a change of the user takes back the tie to the supervisor's life: setpriv ties anew
        if (setpriv := shutil.which("setpriv")) is None:
            raise FileNotFoundError(errno.ENOENT, "setpriv is not installed, which the job's user needs")
        self.prefix = [setpriv, f"--reuid={uid}", f"--regid={gid}", groups, "--pdeathsig=KILL", "--"]


class MemoryLimit:
    """What the ranks of a node may use together, with all that they start."""

    def __init__(self, contract: NodeContract) -> None:
        """Make the control group that the contract names, if it names one."""
        self.problem = ""
        """Why there is no limit although the contract names one; empty where there is one, or none is wanted."""
        self.group = contract.memory_group
        """Directory of the control group that a rank's command enters; empty for no limit."""
        self._used_up = False
        if self.group:
            limit = contract.memory_limit
            try:
                make_memory_group(self.group, limit << 20)
            except OSError as error:
                self.problem = f"muster: memory is not limited to {limit} MiB: {error.strerror}: {error.filename}"
                self.group = ""

    def is_used_up(self) -> bool:
        """Whether the kernel has ended a process of the node for it."""
        if self.group and not self._used_up:
            self._used_up = killed_for_memory(self.group)
        return self._used_up


def interface_of(address: str | None, peer: str) -> str | None:
    """Name of the interface that holds ``address``, or, without one, of that which leads to ``peer``; None if none does."""
    try:
        found = ipaddress.ip_address(address or address_towards(peer))
    except (OSError, ValueError):
        return None
    if found.is_loopback:
        return "lo"  # the whole of 127.0.0.0/8 is on it
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            with contextlib.suppress(OSError):  # it has no IPv4 address
                held = fcntl.ioctl(probe.fileno(), _SIOCGIFADDR, struct.pack("256s", name.encode()[:15]))[20:24]
                if held == found.packed:
                    return name
    return None


def address_towards(peer: str) -> str:
    """This node's IPv4 address on the route to ``peer``. Raises OSError."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((peer, 9))  # sends nothing: it only asks the kernel for the route
        return str(probe.getsockname()[0])

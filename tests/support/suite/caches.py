"""Where compiled kernels are kept between runs and between clones: below the user's cache directory, for this user alone."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from importlib import metadata
from pathlib import Path


def kernel_cache() -> Path:
    """The directory for these versions and this kind of processor; it is made, with mode 700.

    Warp names what it keeps there by a hash of its source, so that clones of other commits share it.

    Raises:
        RuntimeError: The directory belongs to another user, who could put compiled code there.
    """
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "muster"
    flags = next((line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("flags")), "")
    versions = [metadata.version(name) for name in ("warp-lang", "newton", "mujoco-warp")]
    made_of = hashlib.sha256("\n".join([sys.version, platform.machine(), flags, *versions]).encode()).hexdigest()
    directory = root / "kernels" / made_of[:16]
    for each in (root, root / "kernels", directory):
        each.mkdir(mode=0o700, parents=True, exist_ok=True)
        if each.stat().st_uid != os.getuid():
            raise RuntimeError(f"{each} belongs to another user; set XDG_CACHE_HOME to a directory of yours")
        each.chmod(0o700)
    return directory

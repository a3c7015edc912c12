"""The wheel of compiled kernels is one that the unpacking side takes."""

from __future__ import annotations

import csv
import json
import zipfile
from pathlib import Path

from worker.kernels import making, package


def test_a_wheel_holds_binaries_and_marks_but_no_sources_and_can_be_unpacked(tmp_path: Path) -> None:
    build, cache = tmp_path / "build", tmp_path / "cache"
    for target, ending in (("sm90", "sm90.cubin"), ("ptx90", "sm90.ptx")):
        for module in ("wp_a_0123abc", "wp_b_0123abc"):  # the second is of a task that is not packed
            (build / target / module).mkdir(parents=True)
            for suffix in (ending, "meta", "cu"):
                (build / target / module / f"{module}.{suffix}").write_text(f"{module} {target}")
        (build / f"{target}.Ant.json").write_text(json.dumps(["wp_a_0123abc", f"wp_muster_{target}"]))
    wheel = making.pack(build, ["Ant"], ["sm90", "ptx90"])
    again = wheel.read_bytes()
    assert making.pack(build, ["Ant"], ["sm90", "ptx90"]).read_bytes() == again
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path)
        record = next(name for name in archive.namelist() if name.endswith("/RECORD"))
        assert {name for name, *_ in csv.reader(archive.read(record).decode().splitlines())} == set(archive.namelist())
    for path in (tmp_path / "muster_kernels", *(tmp_path / "muster_kernels").iterdir()):
        path.chmod(0o755)
    cache.mkdir()
    assert package.unpack(tmp_path / "muster_kernels", package.Gpu(90, (13, 4)), cache) == "sm90"
    files = {str(each.relative_to(cache)) for each in cache.rglob("*") if each.is_file()}
    assert files == {f"wp_a_0123abc/wp_a_0123abc.{suffix}" for suffix in ("sm90.cubin", "meta")}
    assert (cache / "wp_muster_sm90").is_dir()

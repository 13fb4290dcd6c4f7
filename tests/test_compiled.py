"""The C of the contact points is compiled once, wherever DOLFINx keeps its compiled forms."""

import os
import subprocess
import sys
from pathlib import Path

SCRIPT = """
from extrusion.compiled import ray
assert ray() is ray()
print(ray().lib.ray_points)
"""


def started(cache: Path, **changes: str) -> subprocess.Popen[str]:
    """A process that loads the library."""
    return subprocess.Popen(
        [sys.executable, "-c", SCRIPT],
        env={**os.environ, "XDG_CACHE_HOME": str(cache), **changes},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def test_two_processes_leave_one_library(tmp_path: Path) -> None:
    """Nothing is left of the compilation, and the next one finds what they made."""
    for process in [started(tmp_path) for _ in range(2)]:
        output = process.communicate(timeout=120)[0]
        assert process.returncode == 0, output
    (library,) = (tmp_path / "fenics").iterdir()
    assert library.name.startswith("extrusion_ray_")
    made = library.stat()
    process = started(tmp_path)
    output = process.communicate(timeout=120)[0]
    assert process.returncode == 0, output
    assert library.stat().st_mtime_ns == made.st_mtime_ns
    assert library.stat().st_ino == made.st_ino


def test_without_a_compiler(tmp_path: Path) -> None:
    """One line that names it, and nothing left behind."""
    process = started(tmp_path, CC="/no/such/cc")
    output = process.communicate(timeout=120)[0]
    assert process.returncode != 0
    assert output.splitlines()[-1].startswith("extrusion.errors.InputError: CC = '/no/such/cc': ray.c does not compile")
    assert not list((tmp_path / "fenics").iterdir())


def test_a_cache_that_cannot_be_written(tmp_path: Path) -> None:
    """One line that names the folder."""
    (tmp_path / "fenics").write_text("not a folder")
    process = started(tmp_path)
    output = process.communicate(timeout=120)[0]
    assert process.returncode != 0
    assert output.splitlines()[-1].startswith("extrusion.errors.InputError: cache_dir = ")

"""What someone is told whose machine lacks something: one line with the remedy, and nothing installed."""

import importlib.metadata
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from extrusion.check import require_dolfinx
from extrusion.errors import InputError

ROOT = Path(__file__).parents[1]
TOOLS = ("sh", "dirname", "cat", "cksum", "tr", "rm", "mkdir", "sed", "tail")
needs_venv = pytest.mark.skipif(find_spec("ensurepip") is None, reason="this Python has no venv")


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """A copy of the scripts, and ``bin``: a PATH with neither Python nor compiler."""
    for name in ("demos/run", "tests/run", ".ci/environment", "pyproject.toml"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / "bin").mkdir()
    for tool in TOOLS:
        (tmp_path / "bin" / tool).symlink_to(shutil.which(tool) or pytest.skip(f"no {tool}"))
    fake(tmp_path, "uname", "echo Linux x86_64")
    return tmp_path


def fake(root: Path, name: str, body: str) -> None:
    """A command in the doctored PATH."""
    command = root / "bin" / name
    command.write_text(f"#!{root}/bin/sh\n{body}\n")
    command.chmod(0o755)


def refusal(root: Path, script: str = "demos/run", **environment: str) -> str:
    """The one line on stderr of a script that gives up, and writes nothing."""
    before = sorted(root.rglob("*"))
    run = subprocess.run(
        [root / "bin" / "sh", root / script],
        env={"PATH": str(root / "bin"), "HOME": str(root)} | environment,
        cwd="/",
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert run.returncode == 2, run.stderr
    assert run.stdout == ""
    assert sorted(root.rglob("*")) == before
    (line,) = run.stderr.splitlines()
    return line


@pytest.mark.parametrize("script", ["demos/run", "tests/run"])
def test_no_python(bare: Path, script: str) -> None:
    assert "no Python >= 3.12 with venv: install one" in refusal(bare, script)


def test_python_too_old_or_without_venv(bare: Path) -> None:
    """Every interpreter that was asked is named, with what it lacks."""
    fake(bare, "python3", "echo is 3.11; exit 1")
    fake(bare, "python3.13", "echo has no venv: apt-get install python3.13-venv; exit 1")
    assert "(python3 is 3.11, python3.13 has no venv: apt-get install python3.13-venv)" in refusal(bare)


def test_named_python_does_not_serve(bare: Path) -> None:
    """The name is taken at its word: no other Python is looked for."""
    fake(bare, "python3.12", f'exec "{sys.executable}" "$@"')
    assert "EXTRUSION_PYTHON=/no/python does not serve" in refusal(bare, EXTRUSION_PYTHON="/no/python")


def test_other_platform(bare: Path) -> None:
    fake(bare, "uname", "echo Darwin arm64")
    assert "is for Linux on x86_64 and this is Darwin arm64" in refusal(bare)


@needs_venv
def test_no_compiler(bare: Path) -> None:
    assert "no C compiler" in refusal(bare, EXTRUSION_PYTHON=sys.executable)


@needs_venv
def test_no_python_header(bare: Path) -> None:
    """Without Python.h the first form would fail, with a page of cffi."""
    fake(bare, "cc", "while read -r line; do case $line in *Python.h*) exit 1 ;; esac; done")
    assert "cc finds no Python.h" in refusal(bare, EXTRUSION_PYTHON=sys.executable, CC="cc")


@needs_venv
def test_foreign_venv_is_left_alone(bare: Path) -> None:
    """A .venv that the scripts did not make is somebody's work."""
    fake(bare, "cc", "exit 0")
    (bare / ".venv" / "bin").mkdir(parents=True)
    assert "is not of this script's making" in refusal(bare, EXTRUSION_PYTHON=sys.executable, CC="cc")


@pytest.mark.parametrize(
    ("installed", "told"),
    [
        ({}, "DOLFINx = 'not installed': install DOLFINx 0.11"),
        ({"fenics-dolfinx": "0.5.2"}, "DOLFINx = 'fenics-dolfinx 0.5.2': install DOLFINx 0.11"),
        ({"fenics-dolfinx": "0.110.0"}, "DOLFINx = 'fenics-dolfinx 0.110.0': install DOLFINx 0.11"),
    ],
)
def test_dolfinx_missing_or_other(monkeypatch: pytest.MonkeyPatch, installed: dict[str, str], told: str) -> None:
    def version(name: str) -> str:
        if name not in installed:
            raise importlib.metadata.PackageNotFoundError(name)
        return installed[name]

    monkeypatch.setattr(importlib.metadata, "version", version)
    with pytest.raises(InputError) as caught:
        require_dolfinx()
    assert str(caught.value).startswith(told)


def test_complex_petsc(monkeypatch: pytest.MonkeyPatch) -> None:
    """This environment's own DOLFINx serves; with complex scalars it would not."""
    require_dolfinx()
    from petsc4py import PETSc

    monkeypatch.setattr(PETSc, "ScalarType", np.complex128)
    with pytest.raises(InputError, match="complex-scalar PETSc"):
        require_dolfinx()

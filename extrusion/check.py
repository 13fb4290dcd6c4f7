"""Whether the DOLFINx of this environment serves."""

from __future__ import annotations

import importlib.metadata

import numpy as np

from extrusion.errors import InputError

_SERIES = ["0", "11"]
# The two wheels; then conda, containers, distributions and source.
_DISTRIBUTIONS = ("dolfinx-solver-real", "dolfinx-solver-complex", "fenics-dolfinx")
_REMEDY = (
    "install DOLFINx 0.11 with real-scalar PETSc: "
    'pip install "extrusion[fenicsx]" (Linux on x86_64), '
    'or conda install -c conda-forge fenics-dolfinx=0.11 "petsc=*=real*", '
    "or use the container dolfinx/dolfinx:v0.11.0"
)


def require_dolfinx() -> None:
    """Check DOLFINx, and load MPI and PETSc in the order its wheel needs.

    To be called before the first import of DOLFINx. Without a DOLFINx 0.11 nothing is loaded.

    Raises:
        InputError: If DOLFINx is missing, not of series 0.11, does not load, or has a complex-scalar PETSc.
    """
    found = _installed()
    if found is None:
        raise InputError("DOLFINx", "not installed", _REMEDY)
    if found.split()[1].split(".")[:2] != _SERIES:
        raise InputError("DOLFINx", found, _REMEDY)
    try:
        from mpi4py import MPI  # noqa: F401  # first: the wheel's libraries link the MPI that mpi4py has loaded
        from petsc4py import PETSc
    except ImportError as error:
        raise InputError("DOLFINx", found, f"does not load ({error}): {_REMEDY}") from error
    if np.dtype(PETSc.ScalarType).kind == "c":
        raise InputError("DOLFINx", f"{found}, complex-scalar PETSc", _REMEDY)


def _installed() -> str | None:
    """Distribution and version, ``"fenics-dolfinx 0.11.0"``."""
    for name in _DISTRIBUTIONS:
        try:
            return f"{name} {importlib.metadata.version(name)}"
        except importlib.metadata.PackageNotFoundError:
            continue
    return None

"""What is in C: contact points of curves, sums over contact points, the surface's linear algebra.

Compiled when first used, and kept, as DOLFINx compiles and keeps its forms.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sysconfig
import tempfile
from functools import cache
from importlib import resources
from pathlib import Path
from types import ModuleType
from typing import Any

from mpi4py import MPI  # noqa: F401  the wheel's DOLFINx needs the MPI that it loads

import _cffi_backend
import cffi
import numpy as np
from numpy.typing import NDArray

from dolfinx.jit import get_options

from extrusion.errors import InputError


def pointer(array: NDArray[Any]) -> Any:
    """C's pointer to a contiguous array's numbers, which must outlive it."""
    return FFI.from_buffer(KINDS[array.dtype], array)


FFI: Any = _cffi_backend.FFI()
"""As compiled modules have it, in C: what cffi.FFI does in Python takes as long as a small sum."""

KINDS = {
    np.dtype(name): FFI.typeof(f"{kind}[]")
    for name, kind in (("f4", "float"), ("f8", "double"), ("i4", "int32_t"), ("i8", "int64_t"), ("?", "int8_t"))
}
"""Of NumPy's numbers in C."""


PRELUDE = """
#include <stdint.h>
#include <string.h>
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#define WIDE __attribute__((target_clones("avx2", "default")))
#else
#define WIDE
#endif
"""


@cache
def library(name: str) -> ModuleType:
    """``{name}.c`` as a module of cffi (with ``lib`` and ``ffi``), from DOLFINx's cache of compiled forms.

    Functions with REAL in their names are there twice, for float and for double; those that are WIDE are too, for
    processors with wider registers: no sum is in another order there.

    Processes that find nothing there compile each for itself, and one of the results stays.

    Raises:
        InputError: There is no C compiler that works, or the cache cannot be written.
    """
    header, source = (resources.files("extrusion").joinpath(f"{name}.{kind}").read_text("utf-8") for kind in "hc")
    if "REAL" in source:
        source = "".join(source.replace("REAL", kind) for kind in ("double", "float"))
    options = get_options()
    arguments = [*options["cffi_extra_compile_args"], "-std=c17", "-O3", "-fno-fast-math", "-ffp-contract=off"]
    suffix = sysconfig.get_config_var("EXT_SUFFIX")
    key = repr((PRELUDE, header, source, arguments, cffi.__version__, suffix))
    module_name = f"extrusion_{name}_{hashlib.sha256(key.encode()).hexdigest()[:16]}"
    folder = Path(options["cache_dir"])
    path = folder / f"{module_name}{suffix}"
    if not path.exists():
        ffi = cffi.FFI()
        ffi.cdef(header)
        ffi.set_source(module_name, f"{PRELUDE}{header}{source}", extra_compile_args=arguments)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(dir=folder) as there:
                os.replace(ffi.compile(tmpdir=there), path)
        except OSError as error:
            remedy = f"cannot be written ({error.strerror}): let XDG_CACHE_HOME name another folder"
            raise InputError("cache_dir", str(folder), remedy) from None
        except Exception as error:  # cffi's own, or setuptools'
            remedy = (
                f"{name}.c does not compile ({str(error).splitlines()[0]}): install a C compiler and Python's headers"
            )
            raise InputError("CC", os.environ.get("CC", "cc"), remedy) from None
    spec = importlib.util.spec_from_file_location(module_name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def ray() -> ModuleType:
    """The contact points of curves (`library`)."""
    return library("ray")


def blocks() -> ModuleType:
    """Blocks of the compliance (`library`)."""
    return library("blocks")

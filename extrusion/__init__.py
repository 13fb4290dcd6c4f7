"""An elastic billet pushed through a die: large-sliding contact on FEniCSx.

::

    from extrusion import run, cases

    result = run(cases.A, order=2)
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from extrusion.result import Result as Result
    from extrusion.result import run as run

__version__ = "0.1.0"

__all__ = ["Result", "__version__", "run"]


def __dir__() -> list[str]:
    return [*globals(), "Result", "run"]


def __getattr__(name: str) -> Any:
    if name not in ("Result", "run"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from extrusion import result

    return getattr(result, name)

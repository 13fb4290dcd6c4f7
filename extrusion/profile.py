"""The scene in the (r, y) half-plane: the die's polygon, the billet's rectangle, and their named points.

The only place with coordinates. All lengths in mm; r is the radius, y the axis of extrusion::

    H-----------I
    |    die    |
    G.          |
       `--.     |      bore A..F, faced by the billet's side L-M    (zone 1)
           F    |      cone F..G, faced by the billet's front K-L   (zone 2)
           |    |      clamped H-I, I-J, J-A;  G-H on the axis
           E    |
          D     |
          |     |
          C     |
    K-------LB  |
    | billet||  |      rear M-N, axis N-K
    N-------MA--J
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from extrusion.errors import InputError

Array = npt.NDArray[np.float64]
Edge = tuple[str, str]

BILLET = ("N", "M", "L", "K")
"""Corners of the billet's rectangle, counter-clockwise from the rear on the axis."""


@dataclass(frozen=True, kw_only=True)
class Profile:
    """Die and billet of one scene. Checked, and lists turned into tuples, when built.

    Attributes:
        die: Vertices ``(name, r, y)`` of the die's closed polygon, in order, either way round.
        bore: Consecutive die vertices that zone 1 may touch, from the entry inwards.
        cone: Consecutive die vertices that zone 2 may touch; empty if there is no second zone.
        fixed: Clamped die edges, by their end vertices.
        radius: Radius of the billet.
        length: Length of the billet; its rear face is at y = 0.
        divisions: ``(name, name, n)``: edges of die or billet that `sheet_mesh` cuts in n equal parts.

    Raises:
        InputError: If a value has the wrong type or size, a name is unknown, or the polygon crosses itself.
    """

    die: tuple[tuple[str, float, float], ...]
    bore: tuple[str, ...]
    cone: tuple[str, ...] = ()
    fixed: tuple[Edge, ...]
    radius: float
    length: float
    divisions: tuple[tuple[str, str, int], ...] = ()

    def __post_init__(self) -> None:
        def put(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        for name in ("radius", "length"):
            put(name, _number(getattr(self, name), f"profile.{name}", "mm"))
            if getattr(self, name) <= 0:
                raise InputError(f"profile.{name}", getattr(self, name), "give a positive length, mm")
        put("die", tuple(_vertex(v) for v in _sequence(self.die, "profile.die")))
        self._check_polygon()
        put("bore", self._path(self.bore, "profile.bore"))
        put("cone", self._path(self.cone, "profile.cone") if _sequence(self.cone, "profile.cone") else ())
        put("fixed", tuple(self._die_edge(e) for e in _sequence(self.fixed, "profile.fixed")))
        put("divisions", tuple(self._division(d) for d in _sequence(self.divisions, "profile.divisions")))
        if not self.fixed:
            raise InputError("profile.fixed", self.fixed, "name at least one clamped die edge")
        for field, edges in (("fixed", self.fixed), ("divisions", self.divisions)):
            _distinct([tuple(sorted(e[:2])) for e in edges], f"profile.{field}", "name each edge once")
        taken = [tuple(sorted(e)) for group in ("bore", "cone", "fixed") for e in self.edges[group]]
        _distinct(taken, "profile.fixed", "an edge belongs to one of bore, cone and fixed")

    @property
    def points(self) -> dict[str, tuple[float, float]]:
        """(r, y) of every named point, die vertices first, then the billet's N, M, L, K."""
        corners = ((0.0, 0.0), (self.radius, 0.0), (self.radius, self.length), (0.0, self.length))
        return {name: (r, y) for name, r, y in self.die} | dict(zip(BILLET, corners, strict=True))

    @property
    def die_edges(self) -> tuple[Edge, ...]:
        """The die's edges in the order of its polygon, the closing one last."""
        return _closed([name for name, _, _ in self.die])

    @property
    def billet_edges(self) -> tuple[Edge, ...]:
        """The billet's edges: rear N-M, side M-L, front L-K, axis K-N."""
        return _closed(BILLET)

    @property
    def edges(self) -> dict[str, tuple[Edge, ...]]:
        """The edges of every facet group of a mesh.

        ``rear, side, front, axis`` of the billet; ``bore, cone, fixed`` of the die, and ``die_axis``: its
        edges on the axis that are none of these (u_r = 0 there).
        """
        bore, cone = tuple(itertools.pairwise(self.bore)), tuple(itertools.pairwise(self.cone))
        taken = {frozenset(e) for e in (*bore, *cone, *self.fixed)}
        center = {name for name, r, _ in self.die if r == 0}
        die_axis = tuple(e for e in self.die_edges if center.issuperset(e) and frozenset(e) not in taken)
        rear, side, front, axis = self.billet_edges
        billet = {"rear": (rear,), "side": (side,), "front": (front,), "axis": (axis,)}
        return {**billet, "bore": bore, "cone": cone, "fixed": self.fixed, "die_axis": die_axis}

    def curve(self, names: Sequence[str]) -> Array:
        """Points of a polyline by name, ``shape=(len(names), 2)``."""
        points = self.points
        return np.array([points[name] for name in names], dtype=float).reshape(-1, 2)

    def normals(self, names: Sequence[str]) -> Array:
        """Unit normals out of the die along consecutive die vertices, ``shape=(len(names) - 1, 2)``.

        Along the bore they point towards the axis. `names` may run either way round the polygon.
        """
        names = self._path(names, "profile normals")
        edge = np.diff(self.curve(names), axis=0)
        forward = all((a, b) in self.die_edges for a, b in itertools.pairwise(names))
        sign = math.copysign(1.0, _area(self.curve([n for n, _, _ in self.die]))) * (1 if forward else -1)
        return sign * np.column_stack([edge[:, 1], -edge[:, 0]]) / np.linalg.norm(edge, axis=1)[:, None]

    def bore_radius(self, y: npt.ArrayLike) -> Array:
        """Radius of the undeformed bore at `y`; its first and last segments are extended past the ends.

        Raises:
            InputError: If the bore is no graph over y (y must grow, or fall, from vertex to vertex).
        """
        r, s = self.curve(self.bore).T
        if s[-1] < s[0]:
            r, s = r[::-1], s[::-1]
        if np.any(np.diff(s) <= 0):
            raise InputError("profile.bore", self.bore, "y must grow from vertex to vertex for a radial gap")
        y = np.asarray(y, dtype=float)
        i = np.clip(np.searchsorted(s, y, side="right") - 1, 0, len(s) - 2)
        radius: Array = r[i] + (r[i + 1] - r[i]) * (y - s[i]) / (s[i + 1] - s[i])
        return radius

    def overlap(self, billet: str, die: Sequence[str]) -> float:
        """How deep the billet stands in a part of the die at t = 0, mm; 0 where that is no graph over its edge.

        Args:
            billet: "side", whose depth is radial, or "front", axial.
            die: Consecutive die vertices.
        """
        across, along, edge, most = (
            (0, 1, self.radius, self.length) if billet == "side" else (1, 0, self.length, self.radius)
        )
        curve = self.curve(die)
        p, c = curve[np.argsort(curve[:, along], kind="stable")].T[[along, across]]
        low, high = max(float(p[0]), 0.0), min(float(p[-1]), most)
        rising = np.diff(curve[:, along])
        if low >= high or not (np.all(rising > 0) or np.all(rising < 0)):
            return 0.0
        at = np.array([low, high, *p[(p > low) & (p < high)]])
        return max(0.0, float(np.max(edge - np.interp(at, p, c))))

    def division(self, a: str, b: str) -> int:
        """Divisions of the edge a-b, named either way round.

        Raises:
            InputError: If none are given.
        """
        for p, q, n in self.divisions:
            if {p, q} == {a, b}:
                return n
        raise InputError("profile.divisions", self.divisions, f"add the edge {a}-{b}, or give a mesh size")

    def with_divisions(self, *divisions: tuple[str, str, int]) -> Profile:
        """The same scene with other divisions on some edges: ``with_divisions(("L", "M", 100))``."""
        new = [self._division(d) for d in divisions]
        changed = [{a, b} for a, b, _ in new]
        kept = [d for d in self.divisions if set(d[:2]) not in changed]
        return dataclasses.replace(self, divisions=(*kept, *new))

    def to_dict(self) -> dict[str, Any]:
        """Lists, strings and numbers only, as TOML holds them; `from_dict` reads it back."""

        def plain(value: Any) -> Any:
            return [plain(v) for v in value] if isinstance(value, tuple) else value

        return {f.name: plain(getattr(self, f.name)) for f in dataclasses.fields(self)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Profile:
        """Profile from plain data.

        Raises:
            InputError: If a key is unknown or missing, or a value is refused by `Profile`.
        """
        if not isinstance(data, Mapping):
            raise InputError("profile", data, "give a table")
        fields = {f.name: f.default is dataclasses.MISSING for f in dataclasses.fields(cls)}
        for key, value in data.items():
            if key not in fields:
                raise InputError(f"profile.{key}", value, f"unknown key; valid keys are {', '.join(fields)}")
        for key, required in fields.items():
            if required and key not in data:
                raise InputError(f"profile.{key}", None, "missing; give it a value")
        return cls(**data)

    def _check_polygon(self) -> None:
        if len(self.die) < 3:
            raise InputError("profile.die", self.die, "a polygon has at least three vertices")
        names = [name for name, _, _ in self.die]
        _distinct(names, "profile.die", "give each vertex a name of its own")
        if clash := [name for name in names if name in BILLET]:
            raise InputError("profile.die", clash[0], "rename it: N, M, L, K are the billet's corners")
        points = np.array([v[1:] for v in self.die])
        ends = [(points[i], points[(i + 1) % len(points)]) for i in range(len(points))]
        for i, j in itertools.combinations(range(len(points)), 2):
            if np.array_equal(points[i], points[j]):
                raise InputError("profile.die", f"{names[i]}-{names[j]}", "vertices coincide; drop one")
        for i, j in itertools.combinations(range(len(ends)), 2):
            if _meet(*ends[i], *ends[j]):
                pair = " and ".join("-".join(self.die_edges[k]) for k in (i, j))
                raise InputError("profile.die", pair, "these edges cross or touch; a die's outline may not")

    def _path(self, names: object, field: str) -> tuple[str, ...]:
        """`names` as consecutive die vertices."""
        path = tuple(_sequence(names, field))
        edges = {frozenset(e) for e in self.die_edges}
        known = [name for name, _, _ in self.die]
        for name in path:
            if not isinstance(name, str) or name not in known:
                raise InputError(field, name, f"name die vertices: {', '.join(known)}")
        _distinct(path, field, "name each vertex once")
        if len(path) < 2:
            raise InputError(field, path, "name at least two die vertices")
        for a, b in itertools.pairwise(path):
            if {a, b} not in edges:
                raise InputError(field, f"{a}-{b}", "name vertices that follow one another along the die")
        return path

    def _die_edge(self, edge: object) -> Edge:
        path = self._path(edge, "profile.fixed")
        if len(path) != 2:
            raise InputError("profile.fixed", path, "give each edge as a pair of die vertices")
        return path[0], path[1]

    def _division(self, division: object) -> tuple[str, str, int]:
        field = "profile.divisions"
        item = tuple(_sequence(division, field))
        if len(item) != 3:
            raise InputError(field, item, "give name, name, number")
        a, b, n = item
        edges = self.die_edges + self.billet_edges
        if not any({a, b} == set(e) for e in edges if isinstance(a, str) and isinstance(b, str)):
            raise InputError(field, f"{a}-{b}", f"name an edge: {', '.join('-'.join(e) for e in edges)}")
        if isinstance(n, bool) or not isinstance(n, int) or not 1 <= n <= 10_000:
            raise InputError(f"{field} {a}-{b}", n, "give an integer from 1 to 10000")
        return a, b, n


def _number(value: object, field: str, unit: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise InputError(field, value, f"give a number, {unit}")
    if not math.isfinite(value):
        raise InputError(field, value, f"give a finite number, {unit}")
    return float(value)


def _sequence(value: object, field: str) -> list[Any]:
    if not isinstance(value, list | tuple):
        raise InputError(field, value, "give a list")
    return list(value)


def _vertex(value: object) -> tuple[str, float, float]:
    item = _sequence(value, "profile.die")
    if len(item) != 3 or not isinstance(item[0], str) or not item[0]:
        raise InputError("profile.die", item, "give each vertex as name, r, y")
    r, y = (_number(x, f"profile.die {item[0]}", "mm") for x in item[1:])
    if r < 0:
        raise InputError(f"profile.die {item[0]}", r, "r is a radius: give r >= 0")
    return item[0], r, y


def _closed(names: Sequence[str]) -> tuple[Edge, ...]:
    return tuple(itertools.pairwise((*names, names[0])))


def _distinct(items: Sequence[Any], field: str, remedy: str) -> None:
    for i, item in enumerate(items):
        if item in items[:i]:
            raise InputError(field, "-".join(item) if isinstance(item, tuple) else item, remedy)


def _area(points: Array) -> float:
    """Signed area of a closed polygon, positive counter-clockwise."""
    following = np.roll(points, -1, axis=0)
    return 0.5 * float(np.sum(points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0]))


def _side(a: Array, b: Array, p: Array) -> float:
    """Sign of p's side of the line a-b: +1 left, -1 right, 0 on it to round-off."""
    e, f = b - a, p - a
    turn = e[0] * f[1] - e[1] * f[0]
    return 0.0 if abs(turn) <= 1e-12 * np.linalg.norm(e) * np.linalg.norm(f) else math.copysign(1.0, turn)


def _meet(a: Array, b: Array, p: Array, q: Array) -> bool:
    """Whether the segments a-b and p-q have a point in common, besides b = p or q = a of neighbours."""
    if np.array_equal(b, p) or np.array_equal(q, a):
        s, one, other = (b, a, q) if np.array_equal(b, p) else (a, b, p)
        return _side(s, one, other) == 0 and float((one - s) @ (other - s)) > 0
    sides = _side(a, b, p), _side(a, b, q), _side(p, q, a), _side(p, q, b)
    if not any(sides):  # one line: do they overlap along it?
        along = np.argmax(np.abs(b - a))
        first, second = sorted([a[along], b[along]]), sorted([p[along], q[along]])
        return bool(first[0] <= second[1] and second[0] <= first[1])
    return sides[0] * sides[1] <= 0 and sides[2] * sides[3] <= 0


# fmt: off
SSNV504 = Profile(
    die=(
        ("A", 50, 0), ("B", 50, 70), ("C", 45, 85), ("D", 45, 115), ("E", 48, 135), ("F", 48, 205),
        ("G", 0, 220), ("H", 0, 230), ("I", 60, 230), ("J", 60, 0),
    ),
    bore=("A", "B", "C", "D", "E", "F"),
    cone=("F", "G"),
    fixed=(("H", "I"), ("I", "J"), ("J", "A")),
    radius=50,
    length=65,
    divisions=(
        ("A", "B", 14), ("B", "C", 6), ("C", "D", 8), ("D", "E", 6), ("E", "F", 10),
        ("F", "G", 10), ("G", "H", 2), ("H", "I", 12), ("I", "J", 46), ("J", "A", 2),
        ("L", "M", 10), ("M", "N", 8), ("N", "K", 10), ("K", "L", 8),
    ),
)
# fmt: on
"""The scene of the sheet SSNV504, with the divisions of its axisymmetric mesh."""

"""Cases as values: the sheet's numbers, TOML and back, and what is refused."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from extrusion import cases
from extrusion.cases import A, Case, Zone
from extrusion.errors import InputError


def changed(path: str, value: Any) -> dict[str, Any]:
    """Case A as tables, with the value at ``a.b.0.c`` put in; None takes it out."""
    data = cases.to_dict(A)
    *parents, last = path.split(".")
    table: Any = data
    for key in parents:
        table = table[int(key)] if isinstance(table, list) else table[key]
    if value is None:
        del table[last]
    elif isinstance(table, list):
        table[int(last)] = value
    else:
        table[last] = value
    return data


def test_a_is_the_sheets() -> None:
    """K's six figures, and the run with contact only checked, as the sheet prints them."""
    solved = {f.t: f.value for f in A.figures if f.contact == "solved"}
    assert solved == {5: 5.0, 20: 20.825, 50: 55.880, 70: 78.690, 140: 144.895, 155: 155.096}
    checked = {(f.point, f.quantity, f.t): f.value for f in A.figures if f.contact == "check"}
    assert checked == {("K", "u_y", 155): 155.096, ("M", "gap", 100): -5.0, ("M", "gap", 155): -2.0}
    assert {f.t for f in A.figures if f.tolerance != 1e-3} == {20, 50}
    assert {f.tolerance for f in A.figures if f.t in (20, 50)} == {2e-3}
    assert A.times() == [5.0 * i for i in range(1, 32)]
    assert (A.billet.E, A.billet.nu, A.die_material.E, A.die_material.nu) == (5000, 0.45, 200000, 0.3)


@pytest.mark.parametrize(
    "case",
    [
        A,
        replace(
            A,
            name="mine",
            title='a "quoted" \\ title, größer',
            method="nitsche",
            gamma=0.1 + 0.2,
            theta=-1,
            size=3.7,
            figures=(),
        ),
        replace(A, mesh="/a mesh.msh", die="rigid", increments=((10, 15), (5, 20), (35, 155))).with_contact(
            "bilateral"
        ),
        replace(
            A, zones=(Zone(name="front", billet="front", die="cone", ray="y", slave="die", gap="ray", smooth=True),)
        ),
    ],
    ids=lambda case: case.name,
)
def test_toml_and_back(case: Case, tmp_path: Path) -> None:
    """No field is lost or rounded."""
    path = tmp_path / "case.toml"
    path.write_text(cases.to_toml(case), encoding="utf-8")
    assert cases.read_toml(path) == case


@pytest.mark.parametrize(
    ("path", "value", "field"),
    [
        ("materials.billet.E", 0.0, "materials.billet.E"),
        ("materials.billet.nu", 0.5, "materials.billet.nu"),
        ("materials.die.nu", -1, "materials.die.nu"),
        ("materials.die.E", float("nan"), "materials.die.E"),
        ("materials.die.E", "steel", "materials.die.E"),
        ("materials.steel", {"E": 1.0}, "materials.steel"),
        ("metod", "nodal", "metod"),
        ("billet", "steel", "billet"),
        ("mesh", 3, "mesh"),
        ("name", " A", "name"),
        ("name", "a\nb", "name"),
        ("method", "glue", "method"),
        ("order", 3, "order"),
        ("order", 2.0, "order"),
        ("order", True, "order"),
        ("theta", 0.5, "theta"),
        ("figures.0.point", "X", "figures.point"),
        ("figures.0.quantity", "u_z", "figures.quantity"),
        ("figures.0.t", 0, "figures.t"),
        ("figures.0.tolerance", -0.1, "figures.tolerance"),
        ("gamma", -1.0, "gamma"),
        ("size", float("inf"), "size"),
        ("zones.0.closure", "bilateral", "zones.1.closure"),
        ("zones.0.ray", "x", "zones.1.ray"),
        ("zones.1.name", "1", "zones"),
        ("zones.1.name", None, "zones.2.name"),
        ("zones", [], "zones"),
        ("zones", 3, "zones"),
        ("increments", [], "increments"),
        ("increments", [[5, 20], [5, 20]], "increments"),
        ("increments", [[-5, 20]], "increments"),
        ("increments", [5, 155], "increments"),
        ("increments", [[1e-4, 155]], "increments"),
        ("increments", None, "increments"),
        ("profile.die", [["A", 50, 0], ["B", 60, 70], ["C", 60, 0], ["D", 50, 70]], "profile.die"),  # crosses itself
        ("profile.die.1", ["B", float("nan"), 70], "profile.die B"),
        ("profile.radius", 0, "profile.radius"),
        ("profile.radius", 70, "zones.1.die"),  # the bore has 50
        ("profile.length", 650, "zones.2.die"),  # the die has 230
        ("profile.bore", ["A", "C"], "profile.bore"),
        ("name", "", "name"),
    ],
)
def test_refused(path: str, value: Any, field: str) -> None:
    """A bad value is told by its place in the file, in one line."""
    with pytest.raises(InputError) as error:
        cases.from_dict(changed(path, value))
    assert error.value.field == field
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("billet", "die", "slave", "along"),
    [("side", "bore", "billet", "r"), ("front", "cone", "billet", "y"), ("side", "bore", "die", "r")],
)
def test_a_ray_along_the_master_is_refused(billet: str, die: str, slave: str, along: str) -> None:
    """The gap along a ray needs a master that each ray meets once; to the closest point it does not."""
    zone = cases.Zone(name="1", billet=billet, die=die, slave=slave, ray=along)
    across = replace(zone, ray="y" if along == "r" else "r")
    case = replace(A, method="nitsche", zones=(zone,), figures=())
    if die == "bore":
        with pytest.raises(InputError, match=f"zones.1.ray = '{across.ray}': .*gap = 'closest'"):
            replace(case, zones=(across,))
        replace(case, method="nodal", zones=(across,))
    else:  # a cone is a graph over either
        replace(case, zones=(across,))


def test_overlap() -> None:
    """The bore has r = 50 up to y = 70, then narrows by 1 in 3; the cone falls from y = 220 to 205 at r = 48."""

    def depth(edge: str, die: str, **changes: float) -> float:
        profile = replace(A.profile, **changes)
        return profile.overlap(edge, getattr(profile, die))

    assert depth("side", "bore") == 0
    assert depth("side", "bore", radius=52) == pytest.approx(2)
    assert depth("side", "bore", length=76) == pytest.approx(2)
    assert depth("side", "bore", length=209) == pytest.approx(5)
    assert depth("front", "cone", length=209) == pytest.approx(4)
    assert depth("front", "cone", radius=44, length=213) == pytest.approx(213 - 206.25)
    assert depth("front", "cone", radius=20, length=213) == 0
    assert depth("side", "cone", length=212) == pytest.approx(50 - 48 * 8 / 15)
    assert depth("front", "bore", length=300) == 0  # no graph over r


def test_overlap_counts_where_there_is_contact() -> None:
    """A zone's own surfaces, and not where contact is only checked."""
    deep = replace(A.profile, radius=70)
    with pytest.raises(InputError, match=r"zones.1.die = 'bore': the billet .* is 20 mm deep in it"):
        replace(A, profile=deep, zones=A.zones[:1], figures=())
    assert replace(A.with_contact("check"), profile=deep).profile.radius == 70
    assert replace(A, profile=deep, zones=A.zones[1:], figures=()).profile.radius == 70


def test_numpys_values_are_plain_ones() -> None:
    """From an array of orders, say; and TOML has them."""
    case = replace(A, order=np.int64(2), method=np.str_("nitsche"), zones=(replace(A.zones[0], smooth=np.True_),))
    assert (type(case.order), type(case.method), type(case.zones[0].smooth)) == (int, str, bool)
    assert "order = 2" in cases.to_toml(case)


def test_increments() -> None:
    """A uniform increment ends at the wanted t, the last one shortened; without one the case's table is cut off."""
    assert A.with_increment(7, 20).times() == [7, 14, 20]
    table = replace(A, increments=((5, 20), (10, 70), (35, 140)))
    assert table.with_increment(until=45).times() == [5, 10, 15, 20, 30, 40, 45]
    assert table.with_increment(35).end == 140
    with pytest.raises(InputError, match="until"):
        table.with_increment(until=155)

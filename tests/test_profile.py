"""The scene: what is asked of it, and what it refuses."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest

from extrusion.errors import InputError
from extrusion.profile import SSNV504, Profile

REVERSED = replace(SSNV504, die=SSNV504.die[::-1])
DIE = {name: (name, r, y) for name, r, y in SSNV504.die}


def moved(name: str, r: float, y: float) -> dict[str, object]:
    """The die of SSNV504 with one vertex elsewhere."""
    return {"die": [(name, r, y) if v[0] == name else v for v in SSNV504.die]}


def test_ssnv504_encloses_the_areas_of_the_published_meshes() -> None:
    """A wrong coordinate changes an area; the meshes of the published test have 3587.5 and 3250 mm2."""
    for names, area in (([v[0] for v in SSNV504.die], 3587.5), ("NMLK", 3250.0)):
        (r, y), (r1, y1) = SSNV504.curve(names).T, np.roll(SSNV504.curve(names), -1, axis=0).T
        assert abs(np.sum(r * y1 - y * r1)) / 2 == pytest.approx(area)


@pytest.mark.parametrize("profile", [SSNV504, REVERSED])
def test_normals_point_out_of_the_die(profile: Profile) -> None:
    """Whichever way the polygon or the names run; the wrong sign lets the billet through the die."""
    bore = [(-1, 0), (-3, -1), (-1, 0), (-20, 3), (-1, 0)]
    expected = np.array(bore) / np.linalg.norm(bore, axis=1)[:, None]
    np.testing.assert_allclose(profile.normals(profile.bore), expected, atol=1e-15)
    np.testing.assert_allclose(profile.normals(profile.bore[::-1]), expected[::-1], atol=1e-15)
    np.testing.assert_allclose(profile.normals(profile.cone), np.array([[-15, -48]]) / np.hypot(15, 48))


def test_bore_radius_extends_the_end_segments() -> None:
    """Past its ends the bore goes on straight, it is not held constant."""
    y = [-10, 0, 70, 77.5, 85, 100, 125, 170, 300]
    np.testing.assert_allclose(SSNV504.bore_radius(y), [50, 50, 50, 47.5, 45, 45, 46.5, 48, 48])
    throat = replace(SSNV504, bore=("B", "C", "D", "E"), fixed=SSNV504.fixed)
    np.testing.assert_allclose(throat.bore_radius([40, 155]), [60, 51])
    np.testing.assert_allclose(replace(throat, bore=throat.bore[::-1]).bore_radius([40, 155]), [60, 51])
    with pytest.raises(InputError, match="y must grow"):
        replace(SSNV504, bore=("A", "B", "C", "D", "E"), cone=(), **moved("C", 45, 60)).bore_radius(0)


def test_only_free_edges_on_the_axis_are_held_radially() -> None:
    """G-H; were it clamped, it would belong to `fixed` alone."""
    assert SSNV504.edges["die_axis"] == (("G", "H"),)
    assert replace(SSNV504, fixed=(("H", "G"),)).edges["die_axis"] == ()


def test_toml_gives_the_same_profile_back() -> None:
    """Lists for tuples and integers for floats make no difference; equal profiles hash alike."""
    text = "\n".join(f"{key} = {json.dumps(value)}" for key, value in SSNV504.to_dict().items())
    profile = Profile.from_dict(tomllib.loads(text.replace(".0", "")))
    assert profile == SSNV504
    assert hash(profile) == hash(SSNV504)


def test_with_divisions_replaces_the_edge_named_either_way() -> None:
    """Named L-M or M-L, the edge has one number."""
    profile = SSNV504.with_divisions(("M", "L", 100))
    assert profile.division("L", "M") == 100
    assert len(profile.divisions) == len(SSNV504.divisions)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"radius": 0}, "profile.radius = 0.0: give a positive"),
        ({"length": float("nan")}, "profile.length = nan: give a finite"),
        ({"radius": True}, "profile.radius = True: give a number"),
        ({"die": [DIE["A"], DIE["B"]]}, "at least three"),
        ({"die": ["A", "B", "C"]}, "profile.die = 'A': give a list"),
        (moved("C", -1, 85), "profile.die C = -1.0: r is a radius"),
        (moved("C", float("inf"), 85), "profile.die C = inf: give a finite"),
        (moved("C", 50, 70), "'B-C': vertices coincide"),
        (moved("C", 65, 85), "'B-C and I-J': these edges cross"),
        (moved("C", 50, 40), "'A-B and B-C': these edges cross"),
        (moved("C", 60, 85), "'B-C and I-J': these edges cross or touch"),
        ({"die": [*SSNV504.die, ("A", 55, -5)]}, "profile.die = 'A': give each vertex a name of its own"),
        ({"die": [*SSNV504.die, ("K", 55, -5)]}, "profile.die = 'K': rename"),
        ({"bore": ("A", "Q")}, "profile.bore = 'Q': name die vertices: A, B, C"),
        ({"bore": ("A", "C")}, "profile.bore = 'A-C': name vertices that follow"),
        ({"bore": ()}, "profile.bore = .*: name at least two"),
        ({"cone": ("E", "F", "G")}, "profile.fixed = 'E-F': an edge belongs to one"),
        ({"fixed": ()}, "profile.fixed = .*: name at least one"),
        ({"fixed": (("H", "I", "J"),)}, "profile.fixed = .*: give each edge as a pair"),
        ({"divisions": (("A", "B", 0),)}, "profile.divisions A-B = 0: give an integer"),
        ({"divisions": (("A", "L", 3),)}, "profile.divisions = 'A-L': name an edge"),
        ({"divisions": (("A", "B", 3), ("B", "A", 3))}, "profile.divisions = 'A-B': name each edge once"),
        ({"bores": ("A", "B")}, "profile.bores = .*: unknown key; valid keys are die, bore, cone"),
    ],
)
def test_bad_values_are_refused(change: dict[str, object], message: str) -> None:
    """The message names the field and the value met."""
    with pytest.raises(InputError, match=message):
        Profile.from_dict(SSNV504.to_dict() | change)


def test_missing_key_is_named() -> None:
    """Not a TypeError about __init__."""
    data = SSNV504.to_dict()
    del data["radius"]
    with pytest.raises(InputError, match=r"profile\.radius = None: missing"):
        Profile.from_dict(data)

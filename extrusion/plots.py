"""Pictures of a run, drawn from a `Result` or from the files it left. matplotlib is imported when one is drawn."""

from __future__ import annotations

import csv
import io
import json
import tomllib
import zipfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from extrusion.cases import Case, Zone, from_dict
from extrusion.errors import InputError
from extrusion.result import PICTURED, Array, Result, Snapshots, element_name, per_thickness

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Kind = Literal["billet", "history", "pressure"]
KINDS: tuple[Kind, ...] = get_args(Kind)

RING = 0.004
"""Width along the axis of a ring of contact points in three dimensions, by the billet's radius."""


@dataclass(frozen=True)
class Record:
    """What the pictures show of a run."""

    case: Case
    t: Array  # (steps,) mm
    u_y_K: Array  # (steps,) mm
    reaction: Array  # (steps,) N
    pressure: dict[float, tuple[Array, Array]]  # t -> y (mm) and pressure (MPa) along the side; or r, along the front
    snapshots: Snapshots | None

    @classmethod
    def of(cls, result: Result) -> Record:
        """The record of a run, on rank 0."""
        zone = _pictured_zone(result.case)
        pressure = {}
        for step in result.steps:
            if zone.name in step.zones:
                state = step.zones[zone.name]
                y, r = state.x[:, 1], np.linalg.norm(np.delete(state.x, 1, axis=1), axis=1)
                pressure[step.t] = y if zone.billet == "side" else r, state.pressure
        return cls(result.case, result.t, result.point("K")[:, 1], result.reaction, pressure, result.snapshots)

    @classmethod
    def read(cls, folder: str | Path) -> Record:
        """The record that a run left in a folder.

        Raises:
            InputError: A file is missing or is not what a run writes.
        """
        folder = Path(folder)
        reading = "run.json"
        try:
            with (folder / reading).open(encoding="utf-8") as file:
                case = from_dict(tomllib.loads(json.load(file)["toml"]))
            reading = "history.csv"
            with (folder / reading).open(encoding="utf-8", newline="") as file:
                rows = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(file)]
            t, u_y_K, reaction = (np.array([row[k] for row in rows]) for k in ("t", "u_y_K", "reaction"))
            points: dict[float, list[tuple[float, float]]] = {}
            zone = _pictured_zone(case)
            along = ("y",) if zone.billet == "side" else ("x", "z") if case.space == "3d" else ("r",)
            if rows:
                reading = "contact.csv"
                with (folder / reading).open(encoding="utf-8", newline="") as file:
                    for row in csv.DictReader(file):
                        if row["zone"] == zone.name:
                            place = float(np.hypot.reduce([float(row[name]) for name in along]))
                            points.setdefault(float(row["t"]), []).append((place, float(row["pressure"])))
            snapshots = None
            reading = "snapshots.npz"
            if (folder / reading).exists():
                with np.load(folder / reading) as data:
                    snapshots = Snapshots(**data)
        except FileNotFoundError as error:
            raise InputError(
                "DIR", str(folder), f"no {Path(error.filename).name} there; give a folder of extrusion run"
            ) from None
        except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile):
            raise InputError("DIR", str(folder), f"its {reading} is not what extrusion run writes; run again") from None
        pressure = {t: (a[:, 0], a[:, 1]) for t, a in ((t, np.array(rows)) for t, rows in points.items())}
        return cls(case, t, u_y_K, reaction, pressure, snapshots)


def _pictured_zone(case: Case) -> Zone:
    """The zone along the billet's side, or the first."""
    return next((zone for zone in case.zones if zone.billet == "side"), case.zones[0])


def write(record: Record, folder: str | Path, kinds: Iterable[Kind] = KINDS) -> list[Path]:
    """Draw every kind of picture there is data for, as PNG.

    Raises:
        InputError: matplotlib is missing, the folder cannot be written, or there is no step to draw.
    """
    paths = []
    for kind in kinds:
        if kind == "billet" and record.snapshots is None:
            continue
        path = Path(folder) / f"{kind}.png"
        half = path.with_name(f".{path.name}")  # until it is whole
        figure = draw(record, kind)
        try:
            # compressed at level 6 it takes a fifth longer for 4 %
            figure.savefig(half, format="png", dpi=150, pil_kwargs={"compress_level": 4})
            half.replace(path)
        except OSError as error:
            raise InputError("out", str(path), f"cannot be written ({error.strerror})") from None
        paths.append(path)
    return paths


def draw(record: Record, kind: Kind) -> Figure:
    """One picture, without touching matplotlib's global state or a display.

    Raises:
        InputError: The kind is unknown, matplotlib is missing, or there is no step to draw.
    """
    painters: dict[str, Callable[[Record], Figure]] = {
        "billet": billet,
        "history": history,
        "pressure": pressure,
    }
    if kind not in painters:
        raise InputError("kind", kind, f"choose one of {', '.join(KINDS)}")
    if not len(record.t):
        raise InputError("steps", 0, "there is no accepted step to draw")
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise InputError("matplotlib", "not installed", 'pip install "extrusion[plot]"') from None
    except Exception as error:  # of its settings
        raise InputError("matplotlib", "does not load", str(error)) from None
    return painters[kind](record)


def billet(record: Record) -> Figure:
    """The deformed billet in the die, mirrored about the axis, coloured by von Mises stress (cell means)."""
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import Normalize
    from matplotlib.ticker import MaxNLocator

    snapshots = record.snapshots
    if snapshots is None:
        raise InputError("snapshots", None, "only rank 0 has them, and only after a step")
    order = np.argsort(snapshots.t)
    profile = record.case.profile
    outline = np.array([vertex[1:] for vertex in profile.die])
    rim, top = outline.max(axis=0)
    bottom = min(0.0, outline[:, 1].min())
    in_billet = np.unique(snapshots.triangles[snapshots.billet])
    places = snapshots.points[in_billet] + snapshots.displacement[:, in_billet]
    rim, top = max(rim, places[..., 0].max()), max(top, places[..., 1].max())
    n = len(order)
    height = 5.2
    width = height * 0.8 * 2 * rim / (top - bottom)
    total = n * width + 2.1
    figure = _figure(record, total, height, right=1.3)
    axes = figure.subplots(1, n, sharey=True, squeeze=False)[0]
    bar = figure.add_axes((1 - 1.15 / total, 0.16, 0.2 / total, 0.66))
    stress = snapshots.von_mises[:, snapshots.billet]
    norm = Normalize(0.0, max(_most(stress, snapshots), 1e-6 * record.case.billet.E))
    cells = None
    for ax, i in zip(axes, order, strict=True):
        x = snapshots.points + snapshots.displacement[i]
        die = [outline] if snapshots.billet.all() else x[snapshots.triangles[~snapshots.billet]]
        body = x[snapshots.triangles[snapshots.billet]]
        for side in (1, -1):
            mirror = np.array([side, 1])
            ax.add_collection(
                PolyCollection([p * mirror for p in die], facecolor="0.75", edgecolor="0.75", linewidth=0.3)
            )
            cells = PolyCollection(
                body * mirror, array=stress[i], cmap="turbo", norm=norm, edgecolor="face", linewidth=0.3
            )
            ax.add_collection(cells)
        ax.axvline(0, color="0.2", linewidth=0.6, dashes=(12, 3, 2, 3))
        ax.set(xlim=(-rim, rim), ylim=(bottom, top), aspect="equal", xlabel="r [mm]")
        ax.set_title(f"t = {snapshots.t[i]:g} mm", fontsize="medium")
        ax.tick_params(direction="out", top=False, right=False)
        ax.xaxis.set_major_locator(MaxNLocator(4, prune="both"))  # the next panel's begin where these end
    axes[0].set_ylabel("y [mm]")
    peak = f"von Mises stress [MPa], peak {stress.max():.4g}"
    figure.colorbar(cells, cax=bar, label=peak, extend="max")
    return figure


def _most(stress: Array, snapshots: Snapshots) -> float:
    """What 99.5 % of the billet's section stay below: the peaks at L and at the die's corners are singular."""
    x = snapshots.points[snapshots.triangles[snapshots.billet]]
    u, v = x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]
    area = np.broadcast_to(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]), stress.shape).ravel()
    order = np.argsort(stress, axis=None)
    below = np.cumsum(area[order])
    return float(stress.ravel()[order[np.searchsorted(below, 0.995 * below[-1])]])


def history(record: Record) -> Figure:
    """Reaction on the rear face, and how far K is ahead of it, against t; the sheet's figures as marks."""
    figure = _figure(record, 7.2, 5.6, left=1.0)
    top, bottom = figure.subplots(2, 1, sharex=True)
    top.axhline(0, color="0.6", linewidth=0.8)
    peak = np.max(np.abs(record.reaction))
    prefix, unit = next(((name, size) for name, size in (("M", 1e6), ("k", 1e3)) if peak >= size), ("", 1.0))
    force = record.reaction / unit
    top.plot(record.t, force, ".-", color="C0")
    unit_name = f"[{prefix}N{per_thickness(record.case)}]"
    linear = _linear_part(force)
    if linear < np.max(np.abs(force)):
        unit_name += f", logarithmic from {linear:g} on"
        ticks = _ticks(force, linear)
        top.set_yscale("symlog", linthresh=linear)
        top.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
        top.minorticks_off()
    if peak < 1e-6:  # N: less than the residual that Newton's method leaves
        top.set_ylim(-1, 1)
    top.set_ylabel(f"reaction on the rear face\n{unit_name}")
    bottom.axhline(0, color="0.6", linewidth=0.8)
    bottom.plot(record.t, record.u_y_K - record.t, ".-", color="C0", label="computed")
    checked = all(zone.contact == "check" for zone in record.case.zones)
    wanted = "check" if checked else "solved"
    sheet = [
        (f.t, f.value - f.t, f.tolerance * abs(f.value))
        for f in record.case.figures
        if (f.point, f.quantity, f.contact) == ("K", "u_y", wanted) and f.t <= record.t[-1]
    ]
    if sheet:
        t, value, tolerance = zip(*sheet, strict=True)
        bottom.errorbar(
            t, value, tolerance, fmt="o", mfc="none", color="C3", capsize=3, label="sheet, with its tolerance"
        )
        bottom.legend(frameon=False)
    bottom.set(xlabel="t, displacement of the rear face [mm]", ylabel="u_y(K) - t [mm]")
    for ax in (top, bottom):
        ax.grid(alpha=0.25)
        ax.margins(x=0.02)
    return figure


def _linear_part(force: Array) -> float:
    """Up to where an axis is linear: all of it, unless a few values are far larger than the rest."""
    size = np.abs(force)
    acts = size > 1e-3 * size.max()  # else the billet moves freely
    usual = float(np.quantile(size[acts], 0.6)) if acts.any() else 0.0
    if not 0.0 < 8 * usual < size.max():
        return float(size.max())
    decade = 10.0 ** np.floor(np.log10(usual))
    return float(decade * next(part for part in (1, 2, 5, 10) if part * decade >= usual))


def _ticks(force: Array, linear: float) -> Array:
    """Of an axis that is logarithmic beyond its linear part: halves of that, and 1, 2, 5 in each decade after it."""
    decades = 10.0 ** np.arange(np.floor(np.log10(linear)), np.log10(np.max(np.abs(force))) + 1)
    beyond = np.outer(decades, [1, 2, 5]).ravel()
    size = np.concatenate([[0.5 * linear, linear], beyond[beyond >= 1.5 * linear]])
    ticks = np.concatenate([-size[::-1], [0.0], size])
    low, high = min(force.min(), 0.0), max(force.max(), 0.0)
    return np.asarray(ticks[((ticks > 1.2 * low) & (ticks < 1.2 * high)) | (ticks == 0)])


def pressure(record: Record) -> Figure:
    """Contact pressure along the billet's side, normal to the die, at the pictured t; the die's vertices as lines.

    Along its front where no zone is on the side. In three dimensions the mean round the axis, with a band from the
    least to the most.
    """
    profile = record.case.profile
    figure = _figure(record, 8, 4.2)
    ax = figure.subplots()
    times = (
        sorted({min(record.pressure, key=lambda t: abs(t - target)) for target in PICTURED}) if record.pressure else []
    )
    for i, t in enumerate(times):
        y, p = record.pressure[t]
        if record.case.space == "3d":
            y, p, least, most = rings(y, p, RING * profile.radius)
            ax.fill_between(y, least, most, color=f"C{i}", alpha=0.25, linewidth=0)
        ax.plot(y, p, ".-", color=f"C{i}", markersize=4, linewidth=1, label=f"t = {t:g} mm")
    zone = _pictured_zone(record.case)
    axis, component = ("y", 1) if zone.billet == "side" else ("r", 0)
    for name in getattr(profile, zone.die):
        vertex = profile.points[name][component]
        ax.axvline(vertex, color="0.75", linewidth=0.8, zorder=0)
        ax.annotate(
            name,
            (vertex, 1),
            xycoords=("data", "axes fraction"),
            xytext=(0, 3),
            textcoords="offset points",
            ha="center",
            color="0.4",
        )
    ax.set(xlabel=f"{axis} [mm]", ylabel=f"contact pressure on the {zone.billet} [MPa]")
    ax.grid(alpha=0.25, axis="y")
    if times:
        ax.legend(framealpha=1, edgecolor="none")  # over the die's lines
    return figure


def rings(y: Array, p: Array, width: float) -> tuple[Array, Array, Array, Array]:
    """Points at about the same y put together: y, and the mean, the least and the most of p, by growing y.

    Args:
        y: Positions along the axis, mm.
        p: A value at each.
        width: Of a ring along y, at most, mm.
    """
    order = np.argsort(y, kind="stable")
    y, p = y[order], p[order]
    starts, edge = [], -np.inf
    for i, here in enumerate(y):
        if here > edge:
            starts.append(i)
            edge = here + width
    count = np.diff([*starts, len(y)])
    mean = [np.add.reduceat(values, starts) / count for values in (y, p)]
    return mean[0], mean[1], np.minimum.reduceat(p, starts), np.maximum.reduceat(p, starts)


def _figure(record: Record, width: float, height: float, left: float = 0.75, right: float = 0.2) -> Figure:
    """An empty figure (inches) outside pyplot, with the run as its title; a notebook shows it.

    Its margins are set: to find them out, matplotlib would draw all text twice.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    figure.subplots_adjust(
        *(left / width, 0.55 / height, 1 - right / width, 1 - 0.6 / height), wspace=0.04, hspace=0.08
    )
    case = record.case
    figure.suptitle(f"Case {case.name}: {case.method}, {element_name(case)}, {case.die} die", fontsize="medium")

    def png() -> bytes:
        figure.savefig(buffer := io.BytesIO(), format="png")
        return buffer.getvalue()

    figure._repr_png_ = png
    return figure

"""The study of hard cases: its cells, what it calls lost, and that it can be taken up again."""

from dataclasses import replace
from pathlib import Path

import pytest

from extrusion import study
from extrusion.stepping import Step

CELL = study.Cell(2, "unilateral", "rigid", "nitsche", 2, "displacement", 0.45, 4.0, 155.0)


def test_cells_are_distinct() -> None:
    """960 + 192 + 112 cells, none twice."""
    cells = list(study.cells())
    assert len(cells) == len(set(cells)) == 1264


def test_a_cell_is_measured_against_the_reference() -> None:
    """One increment of 155 mm ends at the reference's K."""
    outcome = study.solve(CELL)
    assert outcome.status == "converged"
    assert outcome.cuts == 0
    assert 0 < outcome.K_error < 5e-4
    assert outcome.reaction_error < 0.01


def test_contact_lost_in_silence_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run whose ram and die are out of balance counts as converged."""
    monkeypatch.setattr(Step, "die_reaction", property(lambda step: 0.0, lambda step, value: None), raising=False)
    assert study.solve(CELL).status == "lost"


def test_what_cannot_work_is_named(tmp_path: Path) -> None:
    """A cell that is excluded is run all the same, or has no reason."""
    assert study.excluded(replace(CELL, method="nodal"))
    assert study.solve(replace(CELL, nu=0.4999)).status == "excluded"
    assert not study.excluded(replace(CELL, nu=0.4999, form="mixed"))
    assert study.solve(replace(CELL, part=3, theta=1, gamma=1.0)).status == "refused"


def test_a_study_is_taken_up_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cells are done twice, or the table read back differs from what was written."""
    pytest.importorskip("matplotlib")
    cells = [CELL, replace(CELL, theta=-1, gamma=1.0), replace(CELL, method="nodal")]
    monkeypatch.setattr(study, "cells", lambda: iter(cells))
    done: list[study.Cell] = []
    path = tmp_path / "table.csv"
    for expected in (cells, []):
        rows = study.run(path, lambda number, of, cell, outcome: done.append(cell))
        assert done == expected
        done.clear()
    assert [row["status"] for row in rows] == ["converged", "converged", "excluded"]
    assert study.summary(rows) == [("2 nitsche", 2, 2, 0, 0), ("2 nodal", 1, 0, 1, 0)]
    study.draw(rows, tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000

"""Blocks of low rank are the matrix that they stand for, in less memory."""

from typing import Any

import numpy as np
import pytest
import scipy.sparse
from numpy.testing import assert_allclose

from extrusion.compliance import FORCES, WHOLE, Block, Blocks, Compliance
from extrusion.gap import Array, Index

N, READ = 1000, 2600


def smooth() -> tuple[Array, Index]:
    """What forces on half a plane do: -log of the distance; and where each force's own displacement is read."""
    own = np.sort(np.random.default_rng(1).choice(READ // 2, N // 2, replace=False))
    own = np.stack([2 * own, 2 * own + 1], axis=1).ravel()  # two forces a node
    x = np.arange(READ) // 2
    return -np.log(np.abs(x[own][:, None] - x) + 0.5) * (1 + 0.1 * (np.arange(READ) % 2)), own


def made(C: Array, own: Index, single: bool = False, of: slice = slice(None)) -> Compliance:
    """In blocks, those of some forces."""
    compliance = Compliance(own, own // 2, C.shape[1], single)
    for number in compliance.missing(np.arange(len(own))[of]):
        compliance.make(number, C[compliance.blocks[number]])
    return compliance


def test_displacements() -> None:
    """A far part at the wrong columns, a rank too low, forces whose rows have not been made."""
    C, own = smooth()
    f = np.random.default_rng(2).standard_normal(N)
    compliance = made(C, own)
    assert len(compliance.blocks) == 8
    assert all(own[rows.start] // 2 != own[rows.start - 1] // 2 for rows in compliance.blocks[1:])
    assert_allclose(compliance.displacements(f), f @ C, rtol=0, atol=1e-12 * np.abs(C).max() * np.abs(f).sum())
    assert compliance.nbytes < 0.45 * C.nbytes
    some = made(C, own, of=slice(0, 300))
    assert some.made == some.blocks[2].stop < N
    assert_allclose(some.displacements(f), f[: some.made] @ C[: some.made], atol=1e-8)
    assert some.missing(np.array([10, 290, 700, 701])) == [5]


def test_what_is_not_smooth_stays() -> None:
    """Nothing of a matrix without low rank is lost, and a small one is one block."""
    C = np.random.default_rng(3).standard_normal((N, READ))
    f = np.ones(N)
    compliance = made(C, smooth()[1])
    assert compliance.nbytes == C.nbytes
    assert_allclose(compliance.displacements(f), f @ C, atol=1e-10)
    assert len(Compliance(np.arange(WHOLE), np.arange(WHOLE), 900, False).blocks) == 1
    assert Compliance(np.zeros(0, dtype=int), np.zeros(0, dtype=int), 0, False).displacements(np.zeros(0)).shape == (0,)


@pytest.mark.parametrize("columns", [slice(0, READ), slice(900, 1400), slice(0, 300), slice(2300, READ)])
@pytest.mark.parametrize("single", [False, True])
def test_parts(columns: slice, single: bool) -> None:
    """Rows of kept forces with what follows them, and of followers, over some columns: also none of a block's own."""
    C, own = smooth()
    compliance = made(C, own, single, slice(200, 700))
    at = np.arange(compliance.blocks[1].start + 4, compliance.blocks[5].stop - 40, 2)
    kept, others = at, at[at % 3 > 0] + 1  # of every node its first force, of some the second
    slope = np.linspace(0.5, 2.0, len(others))
    two = np.searchsorted(kept, others - 1)
    dtype: Any = np.float32 if single else np.float64
    E = scipy.sparse.csr_array((slope.astype(dtype), (two, np.arange(len(others)))), shape=(len(kept), len(others)))
    w, h = (np.random.default_rng(4).standard_normal(len(rows)) for rows in (kept, others))
    found = list(compliance.parts(kept, others, (two, np.arange(len(others)), slope.astype(dtype)), columns))
    accuracy = 1e-5 if single else 1e-11
    for vector, rows, blocks in (
        (w, C[kept] + E @ C[others], [(k, 3, block) for k, _, block, _ in found]),
        (h, C[others], [(o, 3, block) for _, o, _, block in found]),
    ):
        out = np.zeros(3 + columns.stop - columns.start, dtype=dtype)
        Blocks(blocks).add(vector.astype(dtype), out)
        expected = vector @ rows[:, columns]
        assert_allclose(out[3:], expected, atol=accuracy * np.abs(C).max() * len(vector))
        assert_allclose(np.concatenate([b.whole() for _, _, b in blocks]), rows[:, columns], atol=accuracy * 10)


def test_a_block_is_as_wide_as_its_forces() -> None:
    """Of the columns, those around the forces stay as they are."""
    rows, near = smooth()[0][:FORCES], slice(0, 400)
    (block,) = Block.of(rows, near, [np.float64])
    assert block.near == near
    assert block.D.shape == (FORCES, 400)
    assert 5 < block.U.shape[1] < 48
    assert_allclose(block.whole(), rows, atol=1e-12)


def test_two_links_of_a_row() -> None:
    """The three forces of a node in space may be one row, with two others added to it."""
    C, own = smooth()
    compliance = Compliance(own, own // 4, READ, False)
    for number in compliance.missing(np.arange(N)):
        compliance.make(number, C[compliance.blocks[number]])
    kept, others = np.array([8, 500]), np.array([9, 10, 501, 502])
    links = np.array([0, 0, 1, 1]), np.arange(4), np.array([0.5, -2.0, 3.0, 0.25])
    found = [block for _, _, block, _ in compliance.parts(kept, others, links, slice(0, READ))]
    expected = C[kept] + [0.5 * C[9] - 2 * C[10], 3 * C[501] + 0.25 * C[502]]
    assert_allclose(np.concatenate([block.whole() for block in found]), expected, atol=1e-10)


@pytest.mark.parametrize("single", [False, True])
def test_matrices_that_run_down_their_columns(single: bool) -> None:
    """C goes along the rows."""
    C, own = smooth()
    compliance = made(np.asfortranarray(C), own, single)
    f = np.random.default_rng(2).standard_normal(N)
    assert_allclose(compliance.displacements(f), f @ C, rtol=0, atol=1e-12 * np.abs(C).max() * np.abs(f).sum())
    out = np.zeros(READ, dtype=np.float32 if single else np.float64)
    every, none = np.arange(N), np.zeros(0, dtype=int)
    parts = compliance.parts(every, none, (none, none, np.zeros(0)), slice(0, READ))
    Blocks([(k, 0, block) for k, _, block, _ in parts]).add(f.astype(out.dtype), out)
    assert_allclose(out, f @ C, rtol=0, atol=(1e-6 if single else 1e-12) * np.abs(C).max() * np.abs(f).sum())
    with pytest.raises(TypeError, match="float64"):
        Blocks([(0, 0, compliance._made[0][0])]).add(f.astype(np.float32), out)  # type: ignore[index]


def test_nothing_far_away() -> None:
    """Far parts without any rank are columns of zeros, not none."""
    own = np.arange(0, READ, 2)
    C = np.exp(-3.0 * np.abs(own[:, None] - np.arange(READ)))
    compliance = made(C, own)
    none = own[:0]
    parts = compliance.parts(np.arange(len(own)), none, (none, none, np.zeros(0)), slice(0, READ))
    found = [block for _, _, block, _ in parts]
    assert min(block.U.shape[1] for block in found) == 0
    assert_allclose(np.concatenate([block.whole() for block in found]), C, atol=1e-13)
    assert found[0].part(np.arange(3), slice(2000, READ)).whole().shape == (3, READ - 2000)

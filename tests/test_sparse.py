"""Small sparse matrices against SciPy's and dense ones."""

from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.sparse
from numpy.testing import assert_allclose, assert_array_equal

from extrusion.condensed import SMALL, _factored
from extrusion.gap import Array
from extrusion.sparse import Sparse, Triplets

DTYPES = pytest.mark.parametrize("dtype", [np.float32, np.float64])
SHAPE = 30, 20


def made(dtype: Any) -> tuple[Sparse, Array]:
    """A matrix from triplets, some of which have no place, and the same by SciPy; row 7 is empty."""
    rng = np.random.default_rng(5)
    rows, cols = (rng.integers(0, n, 500).astype(np.int32) for n in SHAPE)
    values = rng.standard_normal(500)
    row_of, col_of = (rng.permutation(n + 3).astype(np.int32)[:n] for n in SHAPE)
    row_of[row_of >= SHAPE[0]], col_of[col_of >= SHAPE[1]] = -1, -1
    row_of[row_of == 7] = -1
    on = (row_of[rows] >= 0) & (col_of[cols] >= 0)
    placed = values[on], (row_of[rows[on]], col_of[cols[on]])
    found = Triplets(rows, cols, values).assembled(row_of, col_of, SHAPE, dtype)
    return found, scipy.sparse.coo_array(placed, shape=SHAPE).toarray()


@DTYPES
def test_assembled(dtype: Any) -> None:
    """Equal places added up, empty rows, and what has no place."""
    found, expected = made(dtype)
    assert found.values.dtype == dtype
    assert (len(found), found.width, len(found.values)) == (*SHAPE, np.count_nonzero(expected))
    assert_allclose(found.first(SHAPE[0], slice(0, SHAPE[1])), expected, atol=1e-6 if dtype == np.float32 else 1e-14)
    assert_allclose(found.first(11, slice(5, 9)), expected[:11, 5:9], atol=1e-6)
    none, nowhere = np.zeros(0, dtype=np.int32), np.full(5, -1, dtype=np.int32)
    assert len(Triplets(none, none, np.zeros(0)).assembled(nowhere, nowhere, (3, 2), dtype).values) == 0


@DTYPES
def test_products(dtype: Any) -> None:
    """By a vector, by a matrix into a part of another, row by row; and rows in another order."""
    found, expected = made(dtype)
    accuracy: dict[str, float] = {"rtol": 0.0, "atol": 1e-5 if dtype == np.float32 else 1e-13}
    rng = np.random.default_rng(6)
    v, W, out = rng.standard_normal(20), rng.standard_normal((4, 6)), rng.standard_normal((12, 10)).astype(dtype)
    assert_allclose(found.times(v), expected @ v, **accuracy)
    wanted = out.copy()
    wanted[:, 2:8] += expected[:12, 5:9] @ W
    found.add_times(slice(5, 9), W, out[:, 2:8])
    assert_allclose(out, wanted, **accuracy)
    with pytest.raises(ValueError, match="times"):
        found.add_times(slice(5, 9), W.T, out[:, 2:8])
    order = rng.permutation(30)[:13]
    some = found.rows(order)
    assert_allclose(some.times(v), expected[order] @ v, **accuracy)
    assert_array_equal(some.row, np.repeat(np.arange(13), np.count_nonzero(expected[order], axis=1)))
    one, other = rng.integers(0, 30, (2, 40))
    assert_allclose(found.products(one, other), np.sum(expected[one] * expected[other], axis=1), **accuracy)


def test_placed() -> None:
    """Triplets without a place, or of nothing, are left out; the others stay in order."""
    row_of, col_of = np.array([2, -1, 0]), np.array([-1, 1, 0])
    rows, cols = np.array([0, 1, 2, 2, 0, 2]), np.array([1, 1, 0, 2, 2, 1])
    found = Triplets.placed(rows, cols, np.array([1.0, 2.0, 3.0, 4.0, 0.0, np.nan]), row_of, col_of)
    assert_array_equal(found.rows, [2, 0, 0])
    assert_array_equal(found.cols, [1, 0, 1])
    assert_array_equal(found.values, [1.0, 4.0, np.nan])


@DTYPES
@pytest.mark.parametrize("n", [1, 2, 60, SMALL, SMALL + 1])
def test_factored(n: int, dtype: Any) -> None:
    """As LAPACK's: of the transposed matrix, with its interchanges; where rows stay as they are, to the last digit."""
    A = np.random.default_rng(n).standard_normal((n, n))
    A[: n // 2 : 3] = -np.eye(n)[: n // 2 : 3]
    A = A.astype(dtype)
    lu, interchanged = scipy.linalg.lu_factor(A.T.copy(), check_finite=False)
    found = _factored(A.copy())
    assert_array_equal(found["interchanged"], interchanged)
    assert_allclose(found["lu"], lu.T, rtol=0, atol=(1e-3 if dtype == np.float32 else 1e-11) * np.abs(lu).max())

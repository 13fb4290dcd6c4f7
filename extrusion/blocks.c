/* See `blocks.h`. Compiled for double, then for float, in place of REAL; WIDE: `extrusion/compiled.py`. */
#include <math.h>
#include <string.h>

#ifndef EXTRUSION_ONCE
#define EXTRUSION_ONCE

enum
{
  most_ranks = 256, /* before and after, together */
  lanes = 16        /* partial sums of a product */
};

int64_t placed(int64_t count, const int64_t* row, const int64_t* column, const double* value, const int64_t* row_of,
               const int64_t* column_of, int32_t* rows, int32_t* columns, double* values)
{
  int64_t n = 0;
  for (int64_t i = 0; i < count; ++i)
  {
    const int64_t r = row_of[row[i]], c = column_of[column[i]];
    rows[n] = r;
    columns[n] = c;
    values[n] = value[i];
    n += r >= 0 && c >= 0 && value[i] != 0;
  }
  return n;
}

WIDE static void add_times(int64_t n, double factor, const double* a, double* b)
{
  for (int64_t i = 0; i < n; ++i)
    b[i] += factor * a[i];
}

#endif

WIDE static void rows_REAL(int64_t n, int64_t m, const REAL* x, const REAL* A, int64_t a, REAL* restrict y)
{
  int64_t i = 0;
  for (; i + 8 <= n; i += 8)
  {
    const REAL *r = A + a * i, *s = x + i;
    for (int64_t j = 0; j < m; ++j)
      y[j] += ((s[0] * r[j] + s[1] * r[a + j]) + (s[2] * r[2 * a + j] + s[3] * r[3 * a + j]))
              + ((s[4] * r[4 * a + j] + s[5] * r[5 * a + j]) + (s[6] * r[6 * a + j] + s[7] * r[7 * a + j]));
  }
  for (; i < n; ++i)
    for (int64_t j = 0; j < m; ++j)
      y[j] += x[i] * A[a * i + j];
}

void add_REAL(int64_t count, const block* blocks, const REAL* vector, REAL* out)
{
  for (const block* of = blocks; of < blocks + count; ++of)
  {
    const REAL* x = vector + of->first;
    int64_t i = 0;
    while (i < of->rows && x[i] == 0)
      ++i;
    if (i == of->rows)
      continue;
    REAL t[most_ranks], *y = out + of->to;
    memset(t, 0, sizeof t);
    rows_REAL(of->rows, of->stop - of->start, x, (const REAL*)of->D, of->d, y + of->start);
    rows_REAL(of->rows, of->before + of->after, x, (const REAL*)of->U, of->u, t);
    rows_REAL(of->before, of->start, t, (const REAL*)of->V, of->v, y);
    rows_REAL(of->after, of->width - of->stop, t + of->before, (const REAL*)of->W, of->w, y + of->stop);
  }
}

int64_t csr_REAL(int64_t count, const int32_t* row, const int32_t* column, const double* value, const int32_t* row_of,
                 const int32_t* column_of, int64_t rows, int64_t width, int32_t* start, int32_t* columns, REAL* values,
                 int32_t* scratch)
{
  int32_t *order = scratch, *next = order + count, *at = next + rows, n = 0, last = 0;
  memset(start, 0, (rows + 1) * sizeof *start);
  for (int64_t i = 0; i < count; ++i)
    if (row_of[row[i]] >= 0 && column_of[column[i]] >= 0)
      ++start[row_of[row[i]] + 1];
  for (int64_t r = 0; r < rows; ++r)
    next[r] = start[r + 1] += start[r];
  for (int64_t i = count; i-- > 0;)
    if (row_of[row[i]] >= 0 && column_of[column[i]] >= 0)
      order[--next[row_of[row[i]]]] = i;
  memset(at, 0xff, width * sizeof *at);
  for (int64_t r = 0; r < rows; ++r)
  {
    const int32_t end = start[r + 1];
    start[r] = n;
    for (; last < end; ++last)
    {
      const int32_t c = column_of[column[order[last]]];
      if (at[c] < start[r])
      {
        at[c] = n;
        columns[n] = c;
        values[n++] = value[order[last]];
      }
      else
        values[at[c]] += value[order[last]];
    }
  }
  start[rows] = n;
  return n;
}

WIDE static REAL product_REAL(int64_t n, const REAL* a, const REAL* b)
{
  REAL sum[lanes] = {0}, all = 0;
  int64_t i = 0;
  for (; i + lanes <= n; i += lanes)
    for (int j = 0; j < lanes; ++j)
      sum[j] += a[i + j] * b[i + j];
  for (; i < n; ++i)
    all += a[i] * b[i];
  for (int j = 0; j < lanes; ++j)
    all += sum[j];
  return all;
}

void csr_times_REAL(int64_t rows, const int32_t* start, const int32_t* columns, const REAL* values, const REAL* vector,
                    REAL* out)
{
  for (int64_t r = 0; r < rows; ++r)
  {
    REAL sum = 0;
    for (int64_t i = start[r]; i < start[r + 1]; ++i)
      sum += values[i] * vector[columns[i]];
    out[r] = sum;
  }
}

WIDE void csr_matrix_REAL(int64_t rows, const int32_t* start, const int32_t* columns, const REAL* values, int64_t from,
                          int64_t to, const REAL* matrix, int64_t n, REAL* out, int64_t stride)
{
  for (int64_t r = 0; r < rows; ++r)
    for (int64_t i = start[r]; i < start[r + 1]; ++i)
      if (columns[i] >= from && columns[i] < to)
      {
        const REAL value = values[i], *row = matrix + n * (columns[i] - from);
        for (int64_t j = 0; j < n; ++j)
          out[stride * r + j] += value * row[j];
      }
}

void csr_products_REAL(int64_t count, const int64_t* one, const int64_t* other, const int32_t* start,
                       const int32_t* columns, const REAL* values, REAL* scratch, double* out)
{
  for (int64_t p = 0; p < count; ++p)
  {
    const int64_t a = one[p], b = other[p];
    for (int64_t i = start[a]; i < start[a + 1]; ++i)
      scratch[columns[i]] = values[i];
    out[p] = 0;
    for (int64_t i = start[b]; i < start[b + 1]; ++i)
      out[p] += (double)values[i] * scratch[columns[i]];
    for (int64_t i = start[a]; i < start[a + 1]; ++i)
      scratch[columns[i]] = 0;
  }
}

WIDE void factor_REAL(int64_t n, REAL* A, int32_t* interchanged)
{
  for (int64_t k = 0; k < n; ++k)
  {
    REAL* pivot_row = A + n * k;
    int64_t pivot = k;
    for (int64_t j = k + 1; j < n; ++j)
      if (fabs((double)pivot_row[j]) > fabs((double)pivot_row[pivot]))
        pivot = j;
    interchanged[k] = pivot;
    if (pivot != k)
      for (int64_t i = 0; i < n; ++i)
      {
        const REAL one = A[n * i + k];
        A[n * i + k] = A[n * i + pivot];
        A[n * i + pivot] = one;
      }
    for (int64_t j = k + 1; j < n; ++j)
      pivot_row[j] /= pivot_row[k];
    for (int64_t i = k + 1; i < n; ++i)
    {
      const REAL factor = A[n * i + k];
      if (factor != 0)
        for (int64_t j = k + 1; j < n; ++j)
          A[n * i + j] -= factor * pivot_row[j];
    }
  }
}

/* In place: what was factored is the transposed matrix. */
static void solve_REAL(const tangent* of, REAL* x)
{
  const REAL* lu = (const REAL*)of->lu;
  const int64_t n = of->kept;
  for (int64_t i = 0; i < n; ++i)
    x[i] = (x[i] - product_REAL(i, lu + n * i, x)) / lu[n * i + i];
  for (int64_t i = n; i-- > 0;)
    x[i] -= product_REAL(n - i - 1, lu + n * i + i + 1, x + i + 1);
  for (int64_t i = n; i-- > 0;)
  {
    const int64_t other = of->interchanged[i];
    const REAL one = x[i];
    x[i] = x[other];
    x[other] = one;
  }
}

/* Forces and multipliers whose image is nearly F, and their image. */
static void correct_REAL(const tangent* of, const double* F, double* x, double* image, REAL* scratch)
{
  const int64_t rows = of->rows, n = of->forces, kept = of->kept;
  const REAL *slope = (const REAL*)of->slope, *values = (const REAL*)of->values;
  REAL *g = scratch, *w = g + rows, *v = w + rows, *u = v + rows;
  for (int64_t i = 0; i < rows; ++i)
    g[i] = F[i];
  for (int64_t i = 0; i < of->n_followers; ++i)
    g[of->follower[i]] -= slope[i] * g[of->leader[i]];
  memset(u, 0, of->width * sizeof *u);
  add_REAL(of->n_others, of->others, g, u);
  csr_times_REAL(kept, of->start, of->columns, values, u, w);
  for (int64_t i = 0; i < kept; ++i)
    w[i] = i < n ? w[i] - g[i] : g[i] - w[i];
  solve_REAL(of, w);
  for (int64_t i = 0; i < kept; ++i)
    v[i] = -w[i];
  add_REAL(of->n_own, of->own, v, u);
  for (int64_t i = n; i < kept; ++i)
    u[of->displacements + i - n] = w[i];
  for (int64_t i = kept; i < rows; ++i)
    w[i] = -g[i];
  for (int64_t i = 0; i < of->n_followers; ++i)
    w[of->follower[i]] += slope[i] * w[of->leader[i]];
  csr_times_REAL(rows, of->start, of->columns, values, u, v);
  for (int64_t i = 0; i < rows; ++i)
  {
    x[i] = w[i];
    image[i] = i < n || i >= kept ? v[i] - w[i] : v[i];
  }
}

int64_t gcr_REAL(const tangent* of, int64_t most, double tolerance, double* F, double* x, double* spaces,
                 REAL* scratch)
{
  const int64_t n = of->rows;
  double *Z = spaces, *Q = Z + most * n, along[most], square[most];
  int64_t k = 0;
  while (k < most)
  {
    double *z = Z + k * n, *q = Q + k * n;
    correct_REAL(of, F, z, q, scratch);
    for (int64_t j = 0; j < k; ++j)
      along[j] = product_double(n, Q + j * n, q) / square[j];
    for (int64_t j = 0; j < k; ++j)
    {
      add_times(n, -along[j], Z + j * n, z);
      add_times(n, -along[j], Q + j * n, q);
    }
    square[k] = product_double(n, q, q);
    const double step = product_double(n, q, F) / square[k];
    add_times(n, step, z, x);
    add_times(n, -step, q, F);
    ++k;
    if (sqrt(product_double(n, F, F)) <= tolerance)
      break;
  }
  return k;
}

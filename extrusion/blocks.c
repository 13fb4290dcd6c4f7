/* Rows of a matrix by a vector, block by block, and sparse matrices from triplets: see `extrusion/compliance.py`. */
#include <string.h>

enum
{
  most = 256 /* ranks before and after, together */
};

#define ADD(real)                                                                                                      \
  static void rows_##real(int64_t n, int64_t m, const real* x, const real* A, int64_t a, real* restrict y)             \
  {                                                                                                                    \
    int64_t i = 0;                                                                                                     \
    for (; i + 8 <= n; i += 8)                                                                                         \
    {                                                                                                                  \
      const real *r = A + a * i, *s = x + i;                                                                           \
      for (int64_t j = 0; j < m; ++j)                                                                                  \
        y[j] += ((s[0] * r[j] + s[1] * r[a + j]) + (s[2] * r[2 * a + j] + s[3] * r[3 * a + j]))                        \
                + ((s[4] * r[4 * a + j] + s[5] * r[5 * a + j]) + (s[6] * r[6 * a + j] + s[7] * r[7 * a + j]));         \
    }                                                                                                                  \
    for (; i < n; ++i)                                                                                                 \
      for (int64_t j = 0; j < m; ++j)                                                                                  \
        y[j] += x[i] * A[a * i + j];                                                                                   \
  }                                                                                                                    \
                                                                                                                       \
  void add_##real(int64_t count, const block* blocks, const real* vector, real* out)                                   \
  {                                                                                                                    \
    for (const block* of = blocks; of < blocks + count; ++of)                                                          \
    {                                                                                                                  \
      const real* x = vector + of->first;                                                                              \
      int64_t i = 0;                                                                                                   \
      while (i < of->rows && x[i] == 0)                                                                                \
        ++i;                                                                                                           \
      if (i == of->rows)                                                                                               \
        continue;                                                                                                      \
      real t[most], *y = out + of->to;                                                                                 \
      memset(t, 0, sizeof t);                                                                                          \
      rows_##real(of->rows, of->stop - of->start, x, (const real*)of->D, of->d, y + of->start);                        \
      rows_##real(of->rows, of->before + of->after, x, (const real*)of->U, of->u, t);                                  \
      rows_##real(of->before, of->start, t, (const real*)of->V, of->v, y);                                             \
      rows_##real(of->after, of->width - of->stop, t + of->before, (const real*)of->W, of->w, y + of->stop);           \
    }                                                                                                                  \
  }

ADD(double)
ADD(float)

#define CSR(real)                                                                                                      \
  int64_t csr_##real(int64_t count, const int32_t* row, const int32_t* column, const double* value, int64_t rows,      \
                     int64_t width, int32_t* start, int32_t* columns, real* values, int32_t* scratch)                  \
  {                                                                                                                    \
    int32_t *order = scratch, *next = order + count, *at = next + rows, n = 0, last = 0;                               \
    memset(start, 0, (rows + 1) * sizeof *start);                                                                      \
    for (int64_t i = 0; i < count; ++i)                                                                                \
      if (row[i] >= 0 && column[i] >= 0)                                                                               \
        ++start[row[i] + 1];                                                                                           \
    for (int64_t r = 0; r < rows; ++r)                                                                                 \
      next[r] = start[r + 1] += start[r];                                                                              \
    for (int64_t i = count; i-- > 0;)                                                                                  \
      if (row[i] >= 0 && column[i] >= 0)                                                                               \
        order[--next[row[i]]] = i;                                                                                     \
    memset(at, 0xff, width * sizeof *at);                                                                              \
    for (int64_t r = 0; r < rows; ++r)                                                                                 \
    {                                                                                                                  \
      const int32_t end = start[r + 1];                                                                                \
      start[r] = n;                                                                                                    \
      for (; last < end; ++last)                                                                                       \
      {                                                                                                                \
        const int32_t c = column[order[last]];                                                                         \
        if (at[c] < start[r])                                                                                          \
        {                                                                                                              \
          at[c] = n;                                                                                                   \
          columns[n] = c;                                                                                              \
          values[n++] = value[order[last]];                                                                            \
        }                                                                                                              \
        else                                                                                                           \
          values[at[c]] += value[order[last]];                                                                         \
      }                                                                                                                \
    }                                                                                                                  \
    start[rows] = n;                                                                                                   \
    return n;                                                                                                          \
  }

CSR(double)
CSR(float)

/* Rows of a matrix by a vector, block by block: see `extrusion/compliance.py`. */
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

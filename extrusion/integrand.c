/* See `integrand.h`. */
#include <string.h>

void trial_stress(const integrand* of, const double* z, const double* k, double* own, double* trial)
{
  const int64_t L = of->L, q = of->q;
  for (int64_t i = 0; i < of->n; ++i)
    for (int64_t j = q * i; j < q * (i + 1); ++j)
    {
      double sum = 0;
      if (of->S)
        for (int64_t l = 0; l < L; ++l)
          sum += of->S[L * j + l] * z[of->cols[L * i + l]];
      own[j] = sum;
      trial[j] = sum + k[of->facet[i]] * of->gap[j];
    }
}

void add_forces(const integrand* of, const double* along_gap, const double* along_stress, double* R)
{
  const int64_t L = of->L, q = of->q;
  for (int64_t i = 0; i < of->n; ++i)
    for (int64_t j = q * i; j < q * (i + 1); ++j)
    {
      if (along_gap[j] != 0)
        for (int64_t l = 0; l < L; ++l)
          R[of->cols[L * i + l]] += along_gap[j] * of->G[L * j + l];
      if (along_stress && along_stress[j] != 0)
        for (int64_t l = 0; l < L; ++l)
          R[of->cols[L * i + l]] += along_stress[j] * of->S[L * j + l];
    }
}

static void add(int64_t n, double factor, const double* a, double* b)
{
  if (factor != 0)
    for (int64_t i = 0; i < n; ++i)
      b[i] += factor * a[i];
}

/* J += factor left (x) right, for some entries of left. */
WIDE static void add_product(int64_t T, const int64_t* tested, int64_t L, double factor, const double* left,
                             const double* right, double* J)
{
  for (int64_t t = 0; t < T; ++t)
  {
    const double a = factor * left[tested ? tested[t] : t];
    if (a != 0)
      for (int64_t l = 0; l < L; ++l)
        J[L * t + l] += a * right[l];
  }
}

void stress_tangent(const integrand* of, const double* z, const double* k, const double* own, const double* sigma,
                    const double* by_trial, double theta, int64_t count, const int64_t* which, int64_t T,
                    const int64_t* tested, int64_t* rows, int64_t* columns, double* values)
{
  const int64_t L = of->L, q = of->q;
  double by[L], mixed[L]; /* derivatives of the stress along a row */
  memset(values, 0, count * T * L * sizeof *values);
  for (int64_t nth = 0; nth < count; ++nth)
  {
    const int64_t i = which[nth], facet = of->facet[i], *cols = of->cols + L * i;
    const int64_t* of_facet = tested ? tested + T * facet : 0;
    double* J = values + T * L * nth;
    for (int64_t t = 0; t < T; ++t)
      for (int64_t l = 0; l < L; ++l)
      {
        rows[T * L * nth + L * t + l] = cols[of_facet ? of_facet[t] : t];
        columns[T * L * nth + L * t + l] = cols[l];
      }
    for (int64_t j = q * i; j < q * (i + 1); ++j)
    {
      const double w = of->weight[j], d = by_trial[j], *G = of->G + L * j, *S = of->S ? of->S + L * j : 0;
      const double own_share = S && theta != 0 ? theta / k[facet] : 0, rest = own_share * (sigma[j] - own[j]);
      const double *dxi = of->dxi ? of->dxi + L * j : 0, *dweight = of->dxi ? of->dweight + L * j : 0;
      int moves = 0;
      if (dxi)
        for (int64_t l = 0; l < L && !moves; ++l)
          moves = dxi[l] != 0 || dweight[l] != 0;
      double own_xi = 0;
      if (moves && of->S_xi)
        for (int64_t l = 0; l < L; ++l)
          own_xi += of->S_xi[L * j + l] * z[cols[l]];
      const double trial_xi = moves ? own_xi + k[facet] * of->gap_xi[j] : 0;

      memset(by, 0, sizeof by);
      add(L, w * d * k[facet], G, by);
      if (S)
        add(L, w * d, S, by);
      if (moves)
      {
        add(L, w * d * trial_xi, dxi, by);
        add(L, sigma[j], dweight, by);
      }
      add_product(T, of_facet, L, 1, G, by, J);
      if (own_share != 0)
      {
        memset(by, 0, sizeof by);
        add(L, w * own_share * d * k[facet], G, by);
        add(L, w * own_share * (d - 1), S, by);
        if (moves)
        {
          add(L, w * own_share * (d * trial_xi - own_xi), dxi, by);
          add(L, rest, dweight, by);
        }
        add_product(T, of_facet, L, 1, S, by, J);
      }
      if (moves)
      {
        memset(mixed, 0, sizeof mixed);
        add(L, w * sigma[j], of->G_xi + L * j, mixed);
        if (of->S_xi && own_share != 0)
          add(L, w * rest, of->S_xi + L * j, mixed);
        add_product(T, of_facet, L, 1, mixed, dxi, J);
      }
      if (sigma[j] != 0)
        for (int64_t p = 0; p < of->pairs; ++p)
          add_product(T, of_facet, L, w * sigma[j], of->left[p] + L * j, of->right[p] + L * j, J);
    }
  }
}

/* Contact points of two curves in a plane, and the stress of the slave behind them: see `extrusion/gap.py`. */
#include <math.h>
#include <string.h>

enum
{
  none = -1,
  turning = -2
};

static const double two_pi = 6.283185307179586476925286766559;

/* Lagrange functions of a facet with nodes start, end(, middle), or their first or second derivative. */
static void shape(int64_t k, int derivative, double x, double* N)
{
  if (k == 2)
  {
    N[0] = derivative == 0 ? 1 - x : derivative == 1 ? -1 : 0;
    N[1] = derivative == 0 ? x : derivative == 1 ? 1 : 0;
  }
  else if (derivative == 0)
  {
    N[0] = 1 + x * (-3 + 2 * x);
    N[1] = x * (-1 + 2 * x);
    N[2] = x * (4 - 4 * x);
  }
  else if (derivative == 1)
  {
    N[0] = -3 + 4 * x;
    N[1] = -1 + 4 * x;
    N[2] = 4 - 8 * x;
  }
  else
  {
    N[0] = 4;
    N[1] = 4;
    N[2] = -8;
  }
}

/* Where a component of a facet with these nodes (k, 2) passes a target: the root nearest the middle. */
static double root(int64_t k, const double* x, double target)
{
  if (k == 2)
    return (target - x[0]) / (x[2] - x[0]);
  double a = 2 * x[0] + 2 * x[2] - 4 * x[4], b = -3 * x[0] - x[2] + 4 * x[4], c = x[0] - target;
  double square = b * b - 4 * a * c;
  double q = -0.5 * (b + copysign(sqrt(square > 0 ? square : 0), b));
  double one = c / q, other = q / a;
  return fabs(one - 0.5) <= fabs(other - 0.5) ? one : other;
}

/* Where a facet turns back along the base line, or 1 if it does not. */
static double turn(int64_t k, const double* x)
{
  if (k == 2)
    return 1;
  double a = 2 * x[0] + 2 * x[2] - 4 * x[4], b = -3 * x[0] - x[2] + 4 * x[4];
  double at = a == 0 ? 1 : -b / (2 * a);
  return at > 1e-9 && at < 1 - 1e-9 ? at : 1;
}

static void place(const surface* of, int64_t facet, const double* z, double* x)
{
  const int64_t* nodes = of->nodes + of->k * facet;
  for (int64_t i = 0; i < of->k; ++i)
    for (int j = 0; j < 2; ++j)
      x[2 * i + j] = of->X[2 * (of->k * facet + i) + j] + z[2 * nodes[i] + j];
}

static void sum(int64_t k, const double* N, const double* x, double* out)
{
  out[0] = out[1] = 0;
  for (int64_t i = 0; i < k; ++i)
    for (int j = 0; j < 2; ++j)
      out[j] += N[i] * x[2 * i + j];
}

/* How many of n increasing values are below v, or also at v. */
static int64_t below(const double* values, int64_t n, double v, int or_at)
{
  int64_t low = 0, high = n;
  while (low < high)
  {
    int64_t middle = (low + high) / 2;
    if (or_at ? values[middle] <= v : values[middle] < v)
      low = middle + 1;
    else
      high = middle;
  }
  return low;
}

int64_t ray_points(const surface* slave, const surface* die, const double* z, int axis, double sign, int q,
                   const double* s, const double* omega, int axisymmetric, double* vertex, points* out)
{
  const int c = axis, p = 1 - axis;
  const int64_t k = slave->k, K = slave->K, kd = die->k, m = die->m, L = 2 * (K + kd);
  double x[6], xd[6], largest = 0;
  if (!out)
  {
    for (int64_t i = 0; i < m; ++i)
    {
      place(die, i, z, xd);
      vertex[i] = xd[p];
      vertex[i + 1] = xd[2 + p];
    }
    for (int64_t i = 0; i < m; ++i)
      if (!(vertex[i + 1] > vertex[i]))
        return -1;
  }
  for (int64_t i = 0; i <= m; ++i)
    largest = fmax(largest, fabs(vertex[i]));
  const double resting = 1e-12 * largest; /* a vertex this close to a facet's end is there, and cuts no sliver off */

  int64_t n = 0;
  for (int64_t facet = 0; facet < slave->m; ++facet)
  {
    place(slave, facet, z, x);
    for (int64_t i = 0; i < 2 * k; ++i)
      if (!isfinite(x[i]))
        return -1;
    const double start = slave->X[2 * k * facet], t = slave->X[2 * k * facet + 2] - start;
    const double length = slave->length[facet];
    const int64_t* local = slave->local + k * facet;
    const double turns = turn(k, x + p); /* a facet crushed at the billet's edge: then its parts one after the other */
    double xi0 = 0, N0[3], speed0 = 1;   /* the piece's beginning, and what moves it: */
    int64_t v0 = none;                   /* a vertex, or the facet's own turning */
    for (int part = 0; part < (turns < 1 ? 2 : 1); ++part)
    {
      double ends[2] = {x[p], x[2 + p]}, end = part || turns == 1 ? 1 : turns;
      if (turns < 1)
      {
        double N[3], at[2];
        shape(k, 0, turns, N);
        sum(k, N, x, at);
        ends[1 - part] = at[p];
      }
      const int forward = ends[0] <= ends[1]; /* what has turned over passes the vertices backwards */
      const int64_t low = below(vertex, m + 1, fmin(ends[0], ends[1]) + resting, 1);
      const int64_t high = below(vertex, m + 1, fmax(ends[0], ends[1]) - resting, 0);
      const int64_t pieces = (high > low ? high - low : 0) + 1;
      if (!out)
      {
        n += pieces;
        continue;
      }
      for (int64_t nth = 0; nth < pieces; ++nth, ++n)
      {
        const int64_t opposite = (forward ? low : high) - 1 + (forward ? nth : -nth);
        const int after = opposite >= m, outside = after || opposite < 0;
        const int64_t e = opposite < 0 ? 0 : after ? m - 1 : opposite;
        place(die, e, z, xd);
        double xi1 = end, N1[3] = {0}, speed1 = 1, at[2];
        int64_t v1 = none;
        if (nth + 1 < pieces)
        {
          v1 = forward ? opposite + 1 : opposite;
          xi1 = root(k, x + p, vertex[v1]);
          if (turns < 1 && (xi1 > turns) != part) /* the root as far on the other side */
            xi1 = 2 * turns - xi1;
          shape(k, 0, xi1, N1);
          double dN[3];
          shape(k, 1, xi1, dN);
          sum(k, dN, x, at);
          speed1 = at[p];
        }
        else if (turns < 1 && !part)
        {
          v1 = turning;
          shape(k, 1, turns, N1);
          double ddN[3];
          shape(k, 2, turns, ddN);
          sum(k, ddN, x, at);
          speed1 = at[p];
        }
        out->facet[n] = facet;
        out->die[n] = e;
        int64_t* cols = out->cols + L * n;
        for (int64_t i = 0; i < K + kd; ++i)
        {
          const int64_t node = i < K ? slave->cells[K * facet + i] : die->nodes[kd * e + i - K];
          cols[2 * i] = 2 * node;
          cols[2 * i + 1] = 2 * node + 1;
        }
        const double width = xi1 - xi0;
        const double* Xd = die->X + 2 * kd * e;
        const double reference = (Xd[2 + c] - Xd[c]) / (Xd[2 + p] - Xd[p]);
        for (int i = 0; i < q; ++i)
        {
          const int64_t at_point = q * n + i, row = L * at_point;
          double N[3], dN[3], M[3], dM[3], ddM[3], xs[2], dxs[2], y[2], dy[2], ddy[2];
          const double xi = xi0 + width * s[i];
          shape(k, 0, xi, N);
          shape(k, 1, xi, dN);
          sum(k, N, x, xs);
          sum(k, dN, x, dxs);
          const double on = outside ? after : root(kd, xd + p, xs[p]);
          shape(kd, 0, on, M);
          shape(kd, 1, on, dM);
          shape(kd, 2, on, ddM);
          sum(kd, M, xd, y);
          sum(kd, dM, xd, dy);
          sum(kd, ddM, xd, ddy);
          const double slope = outside ? reference : dy[c] / dy[p];
          const double jacobian = axisymmetric ? two_pi * (start + xi * t) * length : length;
          out->xi[at_point] = xi;
          out->weight[at_point] = width * omega[i] * jacobian;
          out->slope[at_point] = slope;
          out->past[at_point] = outside;
          out->gap[at_point] = sign * (y[c] + (outside ? slope * (xs[p] - y[p]) : 0) - xs[c]);
          /* second variation at fixed xi; right is half of kappa a more, so that l (x) r = a (x) b + b (x) a */
          out->gap_xi[at_point] = sign * (slope * dxs[p] - dxs[c]);
          const double kappa = outside ? 0 : (ddy[c] - slope * ddy[p]) / (dy[p] * dy[p]);
          double* rows[6] = {out->G, out->G_xi, out->left, out->right, out->dxi, out->dweight};
          for (int j = 0; j < 6; ++j)
          {
            rows[j] += row;
            memset(rows[j], 0, L * sizeof(double));
          }
          for (int64_t j = 0; j < k + kd; ++j)
          {
            const int64_t col = 2 * (j < k ? local[j] : K + j - k);
            const double weight = j < k ? -N[j] : M[j - k], turning = j < k || outside ? 0 : dM[j - k] / dy[p];
            rows[0][col + c] = sign * weight;
            rows[0][col + p] = -slope * sign * weight;
            rows[1][col + c] = sign * (j < k ? -dN[j] : dxs[p] * turning);
            rows[1][col + p] = -slope * rows[1][col + c] - sign * dxs[p] * kappa * weight;
            rows[2][col + p] = -weight;
            rows[3][col + c] = sign * turning;
            rows[3][col + p] = -0.5 * sign * kappa * weight - slope * rows[3][col + c];
          }
          /* the split points move, with them the points and weights that they carry */
          for (int last = 0; last < 2; ++last)
          {
            const int64_t v = last ? v1 : v0;
            if (v == none)
              continue;
            const double share = last ? s[i] : 1 - s[i], wider = (last ? 1 : -1) * omega[i] * jacobian;
            const double *shapes = last ? N1 : N0, speed = last ? speed1 : speed0;
            for (int64_t j = 0; j < k + (v >= 0); ++j)
            {
              const int64_t col = 2 * (j < k ? local[j] : K + (v > e)) + p;
              const double cut = (j < k ? -shapes[j] : 1) / speed;
              rows[4][col] += share * cut;
              rows[5][col] += wider * cut + (axisymmetric ? two_pi * width * omega[i] * t * length * share * cut : 0);
            }
          }
        }
        xi0 = xi1;
        v0 = v1;
        speed0 = speed1;
        memcpy(N0, N1, sizeof N0);
      }
    }
  }
  return n;
}

void stress_rows(const surface* slave, int64_t n, int q, const int64_t* facet, const double* xi, const double* direction,
                 int64_t stride_n, int64_t stride_q, double lmbda, double mu, int axisymmetric, int derivative,
                 int64_t width, int64_t pressures, double* rows)
{
  const int64_t k = slave->k, K = slave->K;
  for (int64_t i = 0; i < n; ++i)
  {
    const int64_t f = facet[i];
    const double *N = slave->normal + 2 * f, *g = slave->gradients + 2 * K * (k - 1) * f;
    const double start = slave->X[2 * k * f], t = slave->X[2 * k * f + 2] - start;
    for (int j = 0; j < q; ++j)
    {
      const double *d = direction + stride_n * i + stride_q * j, x = xi[q * i + j];
      const double d_N = d[0] * N[0] + d[1] * N[1];
      double* row = rows + width * (q * i + j);
      for (int64_t l = 0; l < K; ++l)
      {
        /* the gradient's first and, for order 2, second power of xi */
        double gradient[2];
        for (int a = 0; a < 2; ++a)
        {
          const double first = g[2 * l + a], second = k == 3 ? g[2 * (K + l) + a] : 0;
          gradient[a] = derivative ? second : first + x * second;
        }
        const double along_d = gradient[0] * d[0] + gradient[1] * d[1], along_N = gradient[0] * N[0] + gradient[1] * N[1];
        for (int a = 0; a < 2; ++a)
          row[2 * l + a]
              = mu * (along_d * N[a] + along_N * d[a]) + (pressures < 0 ? lmbda * d_N * gradient[a] : 0);
      }
      if (pressures >= 0)
        for (int a = 0; a < 2; ++a)
          row[pressures + slave->ends[2 * f + a]] = -mu * d_N * (derivative ? 2 * a - 1 : a ? x : 1 - x);
      else if (axisymmetric)
      {
        const double r = start + x * t;
        double phi[3], phi_xi[3];
        shape(k, 0, x, phi);
        shape(k, 1, x, phi_xi);
        for (int64_t a = 0; a < k; ++a)
          row[2 * slave->local[k * f + a]] += lmbda * d_N / r * (derivative ? phi_xi[a] - phi[a] * t / r : phi[a]);
      }
    }
  }
}

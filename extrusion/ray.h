/* Curves, their contact points, and what `extrusion/ray.c` does with them. Arrays are contiguous, the last index runs
 * fastest. Components: c along the ray, p along its base line. A point's rows stand over the nodes of the slave's cell,
 * then those of the die's facet, two components each. */

typedef struct
{
  int64_t m, k, K;         /* facets, nodes of each, nodes of the cell behind each */
  const double* X;         /* (m, k, 2) */
  const int64_t* nodes;    /* (m, k) */
  const int64_t* cells;    /* (m, K) */
  const int64_t* local;    /* (m, k): the facet's nodes among the cell's */
  const double* normal;    /* (m, 2) */
  const double* length;    /* (m) */
  const double* gradients; /* (m, k - 1, K, 2), by powers of xi; none without a cell */
  const int64_t* ends;     /* (m, 2): the facet's ends among the cell's vertices */
} surface;

typedef struct
{
  int64_t *facet, *die, *cols;                      /* (n), (n), (n, L) */
  double *xi, *weight, *gap, *slope, *gap_xi;       /* (n, q) */
  int8_t* past;                                     /* (n, q) */
  double *G, *G_xi, *left, *right, *dxi, *dweight;  /* (n, q, L) */
} points;

/* Pieces of slave facets between the vertices of the die, with q points each: counted (out = NULL), then filled in.
 *
 * vertex: (die->m + 1), filled in when counting. Their number, or -1 where the deformed die is no graph over p. */
int64_t ray_points(const surface* slave, const surface* die, const double* z, int axis, double sign, int q,
                   const double* s, const double* omega, int axisymmetric, double* vertex, points* out);

/* Rows of direction . sigma(u) N at points of slave facets, or their derivative by xi at a fixed direction.
 *
 * direction: (n, q, 2), with strides of n and q. rows: (n, q, width), zero beforehand, those over the displacements
 * first, and those over the three pressures of the mixed form from `pressures` on (-1: the displacement form). */
void stress_rows(const surface* slave, int64_t n, int q, const int64_t* facet, const double* xi, const double* direction,
                 int64_t stride_n, int64_t stride_q, double lmbda, double mu, int axisymmetric, int derivative,
                 int64_t width, int64_t pressures, double* rows);

/* What is summed over the contact points of slave facets: see `extrusion/integrand.py`. Arrays are contiguous, the last
 * index runs fastest. */

typedef struct
{
  int64_t n, q, L;            /* pieces, points of each, local columns of each */
  const int64_t *facet, *cols; /* (n): of the slave; (n, L): where the columns stand in z */
  const double *weight, *gap; /* (n, q) */
  const double *G, *S;        /* (n, q, L): derivative of the gap; rows of the slave's own stress, or none */

  /* What moves with the pieces' ends, or none: derivatives by xi, the place along the facet, and of xi and weights. */
  const double *gap_xi, *G_xi, *S_xi, *dxi, *dweight;
  int64_t pairs; /* of rows whose products add up to the second derivative of the gap at fixed xi */
  const double *left[8], *right[8];
} integrand;

/* own = S z, and trial = own + k gap: (n, q). k: by facets. */
void trial_stress(const integrand* of, const double* z, const double* k, double* own, double* trial);

/* R += sum over points of along_gap G + along_stress S. Both (n, q); the second, or none. */
void add_forces(const integrand* of, const double* along_gap, const double* along_stress, double* R);

/* Derivative of weight (G sigma + theta / k S (sigma - own)) by z, of some pieces, as triplets.
 *
 * which: (count) pieces. sigma, and by its trial value: (n, q). tested: (facets, T) local columns that have a row; none
 * for all L of them. rows, columns, values: (count, T, L). */
void stress_tangent(const integrand* of, const double* z, const double* k, const double* own, const double* sigma,
                    const double* by_trial, double theta, int64_t count, const int64_t* which, int64_t T,
                    const int64_t* tested, int64_t* rows, int64_t* columns, double* values);

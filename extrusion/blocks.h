/* What the surface's linear algebra is made of: see `extrusion/compliance.py` and `extrusion/condensed.py`. Functions
 * whose names end in float or double are one text, compiled in both precisions, which their void pointers then have. */

typedef struct
{
  int64_t rows, first;            /* how many, and which entry of the vector is the first one's */
  int64_t to, start, stop, width; /* first column in the result; columns that are stored as they are; all columns */
  int64_t before, after;          /* ranks of the columns before and after these */
  const void *D, *U, *V, *W;      /* (rows, stop - start), (rows, before + after), (before, start), (after, rest) */
  int64_t d, u, v, w;             /* from row to row of each */
} block;

/* out += sum over blocks of vector . rows. */
void add_double(int64_t count, const block* blocks, const double* vector, double* out);
void add_float(int64_t count, const block* blocks, const float* vector, float* out);

/* Triplets with a place in a matrix: their row and column there, of those that have both and are not 0. How many. */
int64_t placed(int64_t count, const int64_t* row, const int64_t* column, const double* value, const int64_t* row_of,
               const int64_t* column_of, int32_t* rows, int32_t* columns, double* values);

/* Compressed rows from triplets, by where rows and columns stand: those with a negative row or column are left out,
 * equal places are added up, and the columns of a row are in the order in which they come. The number of entries.
 *
 * start: (rows + 1). columns, values: (count). scratch: (count + rows + width). */
int64_t csr_double(int64_t count, const int32_t* row, const int32_t* column, const double* value,
                   const int32_t* row_of, const int32_t* column_of, int64_t rows, int64_t width, int32_t* start,
                   int32_t* columns, double* values, int32_t* scratch);
int64_t csr_float(int64_t count, const int32_t* row, const int32_t* column, const double* value, const int32_t* row_of,
                  const int32_t* column_of, int64_t rows, int64_t width, int32_t* start, int32_t* columns,
                  float* values, int32_t* scratch);

/* Compressed rows by a vector. */
void csr_times_double(int64_t rows, const int32_t* start, const int32_t* columns, const double* values,
                      const double* vector, double* out);

/* out += their columns from .. to by a matrix of n columns. stride: from row to row of out. */
void csr_matrix_double(int64_t rows, const int32_t* start, const int32_t* columns, const double* values, int64_t from,
                       int64_t to, const double* matrix, int64_t n, double* out, int64_t stride);

/* Products of pairs of rows. scratch: (width) zeros. */
void csr_products_double(int64_t count, const int64_t* one, const int64_t* other, const int32_t* start,
                         const int32_t* columns, const double* values, double* scratch, double* out);

void csr_times_float(int64_t rows, const int32_t* start, const int32_t* columns, const float* values,
                     const float* vector, float* out);
void csr_matrix_float(int64_t rows, const int32_t* start, const int32_t* columns, const float* values, int64_t from,
                      int64_t to, const float* matrix, int64_t n, float* out, int64_t stride);
void csr_products_float(int64_t count, const int64_t* one, const int64_t* other, const int32_t* start,
                        const int32_t* columns, const float* values, float* scratch, double* out);

/* In place, a matrix by rows, as LAPACK's getrf leaves the transposed one. */
void factor_double(int64_t n, double* A, int32_t* interchanged);
void factor_float(int64_t n, float* A, int32_t* interchanged);

/* The tangent on the surface and what solves it nearly (`_Tangent`): rows are those of kept forces, of multipliers, and
 * of other forces; columns are displacements that are read, then multipliers. */
typedef struct
{
  int64_t rows, forces, kept, width, displacements; /* kept: forces kept, and multipliers */
  const int32_t *start, *columns;                   /* D, by rows */
  const void* values;
  int64_t n_own, n_others; /* blocks of C with E, over the kept forces, and of C, over the others */
  const block *own, *others;
  const void* lu; /* (kept, kept), from `factor` */
  const int32_t* interchanged;
  int64_t n_followers; /* rows of other forces, the kept ones they go with, and in what proportion */
  const int64_t *follower, *leader;
  const void* slope;
} tangent;

/* GCR: add to x what takes F away, until what is left of it in F is no more than the tolerance. How many corrections.
 *
 * spaces: (2 most, rows). scratch: (3 rows + width). */
int64_t gcr_double(const tangent* of, int64_t most, double tolerance, double* F, double* x, double* spaces,
                   double* scratch);
int64_t gcr_float(const tangent* of, int64_t most, double tolerance, double* F, double* x, double* spaces,
                  float* scratch);

/* Rows of a matrix by a vector, and sparse matrices from triplets: see `extrusion/compliance.py`. */

typedef struct
{
  int64_t rows, first;            /* how many, and which entry of the vector is the first one's */
  int64_t to, start, stop, width; /* first column in the result; columns that are stored as they are; all columns */
  int64_t before, after;          /* ranks of the columns before and after these */
  const void *D, *U, *V, *W;      /* (rows, stop - start), (rows, before + after), (before, start), (after, rest) */
  int64_t d, u, v, w;             /* from row to row of each */
} block;

/* out += sum over blocks of vector . rows, in double and in single precision. */
void add_double(int64_t count, const block* blocks, const double* vector, double* out);
void add_float(int64_t count, const block* blocks, const float* vector, float* out);

/* Compressed rows from triplets: those with a negative row or column are left out, equal places are added up, and the
 * columns of a row are in the order in which they come. The number of entries.
 *
 * start: (rows + 1). columns, values: (count). scratch: (count + rows + width). */
int64_t csr_double(int64_t count, const int32_t* row, const int32_t* column, const double* value, int64_t rows,
                   int64_t width, int32_t* start, int32_t* columns, double* values, int32_t* scratch);
int64_t csr_float(int64_t count, const int32_t* row, const int32_t* column, const double* value, int64_t rows,
                  int64_t width, int32_t* start, int32_t* columns, float* values, int32_t* scratch);

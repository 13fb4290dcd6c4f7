/* Rows of a matrix by a vector: see `extrusion/compliance.py`. */

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

// The kernels of the distance fields: bake_hard, bake_gaussian and bake_matern at the cells of a grid, query_hard,
// query_gaussian and query_matern at points, choose and settle between the exact distance and a kernel's.
#include "field_bake.cuh"
#include "field_query.cuh"

// What follows from lists of nearest neighbours: the undirected graph, and normals of the local planes.
#pragma once
#include <cstddef>
#include <cstdint>

namespace perception::graph {

// neighbors [count, k]: indices of points, -1 for none; a point may stand in its own list. edges [<= count * k, 2]
// out: each pair of distinct points once, smaller index first, ordered by the point in whose list it was found.
// Returns the number of edges.
std::size_t undirected(const std::int32_t *neighbors, std::size_t count, std::size_t k, std::int32_t *edges);

// normals [count, 3] out: for each list of neighbours the unit direction in which the points [*, 3] spread least
// (eigenvector of the covariance's smallest eigenvalue, by Jacobi rotations in double; sign arbitrary), zero when fewer
// than three distinct points or points on a line leave it open.
void plane_normals(const float *points, const std::int32_t *neighbors, std::size_t count, std::size_t k, int threads,
                   float *normals);

}  // namespace perception::graph

// Graph-based segmentation (Felzenszwalb and Huttenlocher, IJCV 2004).
#pragma once
#include <cstddef>
#include <cstdint>

namespace perception::graph {

// Segments an undirected graph of `nodes` nodes. edges [E, 2], weights [E] (any order, no NaN), labels [nodes] out:
// segment of each node, numbered 0, 1, ... in the order of first appearance. Returns the number of segments.
//
// Two components join over an edge when its weight is at most the internal threshold of both, which for a component
// is the weight that last joined it plus k / size. Then every component under `min_size` joins a neighbour, again in
// sorted order. Equal weights are taken in the order of their (smaller, larger) node: the order of edges is irrelevant.
std::size_t segment(const std::int32_t *edges, const float *weights, std::size_t num_edges, std::size_t nodes, float k,
                    std::size_t min_size, std::int32_t *labels);

}  // namespace perception::graph

// Python's door to the graph kernels: shapes are checked here, the interpreter lock is released, then work is done.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cmath>
#include <stdexcept>

#include "../common/arguments.h"
#include "felzenszwalb.h"
#include "kdtree.h"
#include "neighborhood.h"

namespace nb = nanobind;
using perception::require_aligned;
using perception::graph::KdTree;

namespace {

template <class T, class... Shape>
using Array = nb::ndarray<T, Shape..., nb::c_contig, nb::device::cpu>;
using Points = Array<const float, nb::shape<-1, 3>>;

KdTree *make_tree(Points points, int threads) {
  require_aligned("points", points);
  const float *data = points.data();
  const std::size_t count = points.shape(0);
  if (count == 0 || count > 0x7ffffff0) throw nb::value_error("points: between 1 and 2^31 points are needed");
  if (!std::all_of(data, data + 3 * count, [](float v) { return std::isfinite(v); })) {
    throw nb::value_error("points: all coordinates must be finite");
  }
  nb::gil_scoped_release release;
  return new KdTree(data, count, threads);
}

void knn(const KdTree &tree, Points queries, Array<std::int32_t, nb::shape<-1, -1>> indices,
         Array<float, nb::shape<-1, -1>> squared, float max_distance, int threads) {
  require_aligned("queries", queries, "indices", indices, "squared", squared);
  const std::size_t count = queries.shape(0), k = indices.shape(1);
  if (indices.shape(0) != count || squared.shape(0) != count || squared.shape(1) != k || k < 1 || k > 1024) {
    throw nb::value_error("indices and squared must be [Q, k] for queries [Q, 3], 1 <= k <= 1024");
  }
  if (!(max_distance >= 0)) throw nb::value_error("max_distance must not be negative");
  nb::gil_scoped_release release;
  tree.knn(queries.data(), count, static_cast<int>(k), max_distance, threads, indices.data(), squared.data());
}

std::size_t segment(Array<const std::int32_t, nb::shape<-1, 2>> edges, Array<const float, nb::shape<-1>> weights,
                    float k, std::size_t min_size, Array<std::int32_t, nb::shape<-1>> labels) {
  require_aligned("edges", edges, "weights", weights, "labels", labels);
  const std::size_t count = edges.shape(0), nodes = labels.shape(0);
  if (weights.shape(0) != count) throw nb::value_error("weights must be [E] for edges [E, 2]");
  const std::int32_t *e = edges.data();
  const float *w = weights.data();
  if (!std::all_of(e, e + 2 * count, [nodes](std::int32_t v) { return v >= 0 && std::size_t(v) < nodes; })) {
    throw nb::value_error("edges: a node lies outside the labels");
  }
  if (std::any_of(w, w + count, [](float v) { return std::isnan(v); })) throw nb::value_error("weights: NaN");
  nb::gil_scoped_release release;
  return perception::graph::segment(e, w, count, nodes, k, min_size, labels.data());
}

using Lists = Array<const std::int32_t, nb::shape<-1, -1>>;

bool within(const Lists &lists, std::size_t points) {
  const std::int32_t *data = lists.data();
  return std::all_of(data, data + lists.size(), [points](std::int32_t v) { return v < 0 || std::size_t(v) < points; });
}

std::size_t undirected(Lists neighbors, Array<std::int32_t, nb::shape<-1, 2>> edges) {
  require_aligned("neighbors", neighbors, "edges", edges);
  const std::size_t count = neighbors.shape(0), k = neighbors.shape(1);
  if (edges.shape(0) < count * k) throw nb::value_error("edges must have room for N * k pairs");
  if (!within(neighbors, count)) throw nb::value_error("neighbors: an index lies outside the points");
  if (k == 0) return 0;  // an empty array may have any number of rows
  nb::gil_scoped_release release;
  return perception::graph::undirected(neighbors.data(), count, k, edges.data());
}

void plane_normals(Points points, Lists neighbors, Array<float, nb::shape<-1, 3>> normals, int threads) {
  require_aligned("points", points, "neighbors", neighbors, "normals", normals);
  if (normals.shape(0) != neighbors.shape(0)) throw nb::value_error("normals must be [Q, 3] for neighbors [Q, k]");
  if (!within(neighbors, points.shape(0))) throw nb::value_error("neighbors: an index lies outside the points");
  nb::gil_scoped_release release;
  perception::graph::plane_normals(points.data(), neighbors.data(), neighbors.shape(0), neighbors.shape(1), threads,
                                   normals.data());
}

}  // namespace

void bind_graph(nb::module_ &m) {
  nb::class_<KdTree>(m, "KdTree", "Exact nearest neighbours in 3D; see perception.export.neighbors.")
      .def(nb::new_(&make_tree), nb::arg("points").noconvert(), nb::arg("threads") = 1)
      .def("knn", &knn, nb::arg("queries").noconvert(), nb::arg("indices").noconvert(), nb::arg("squared").noconvert(),
           nb::arg("max_distance"), nb::arg("threads") = 1)
      .def("__len__", &KdTree::size);
  m.def("felzenszwalb", &segment, nb::arg("edges").noconvert(), nb::arg("weights").noconvert(), nb::arg("k"),
        nb::arg("min_size"), nb::arg("labels").noconvert(),
        "Felzenszwalb-Huttenlocher on a graph; fills labels [nodes] int32 and returns the number of segments.");
  m.def("undirected", &undirected, nb::arg("neighbors").noconvert(), nb::arg("edges").noconvert(),
        "Pairs of neighbour lists [N, k], each once; fills edges and returns how many there are.");
  m.def("plane_normals", &plane_normals, nb::arg("points").noconvert(), nb::arg("neighbors").noconvert(),
        nb::arg("normals").noconvert(), nb::arg("threads") = 1,
        "Normals [Q, 3] of the planes through neighbour lists [Q, k] of points [N, 3]; zero where there is none.");
}

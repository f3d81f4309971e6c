// Python's door to the graph kernels: shapes are checked here, the interpreter lock is released, then work is done.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>

#include "../common/arguments.h"
#include "felzenszwalb.h"
#include "kdtree.h"
#include "merge.h"
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

using Starts = Array<const std::int64_t, nb::shape<-1>>;
using Indices = Array<const std::int32_t, nb::shape<-1>>;
using Values = Array<const float, nb::shape<-1>>;

// Rows of a sparse matrix: each is a range of the entries, with columns that rise and lie below `columns`.
void require_rows(const char *name, const Starts &starts, const Indices &index, std::size_t rows, std::size_t columns) {
  const std::int64_t *s = starts.data();
  const std::int32_t *c = index.data();
  bool good = starts.shape(0) == rows + 1 && s[0] == 0 && std::is_sorted(s, s + rows + 1) &&
              std::size_t(s[rows]) == index.shape(0);
  for (std::size_t r = 0; good && r < rows; ++r) {
    for (std::int64_t e = s[r]; good && e < s[r + 1]; ++e) {
      good = c[e] >= 0 && std::size_t(c[e]) < columns && (e == s[r] || c[e] > c[e - 1]);
    }
  }
  if (!good) throw std::invalid_argument(std::string(name) + ": expected sparse rows with ascending columns in range");
}

template <class Array>
bool all_finite(const Array &array) {
  return std::all_of(array.data(), array.data() + array.size(), [](auto v) { return std::isfinite(v); });
}

std::size_t merge_segments(Starts mask_starts, Indices masks, Values pixels, Starts blank_starts, Indices blank_views,
                           Values blank, Indices view, std::size_t views, Starts near_starts, Indices near,
                           Array<const double, nb::shape<-1, -1>> z, Array<const double, nb::shape<-1>> sizes,
                           double least_share, double one_sided, double prior, double lowest,
                           std::size_t many, double sure, Array<std::int32_t, nb::shape<-1, 2>> children,
                           Array<double, nb::shape<-1>> affinity) {
  require_aligned("mask_starts", mask_starts, "masks", masks, "pixels", pixels, "blank_starts", blank_starts,
                  "blank_views", blank_views, "blank", blank, "view", view, "near_starts", near_starts, "near", near,
                  "z", z, "sizes", sizes, "children", children, "affinity", affinity);
  const std::size_t count = sizes.shape(0), all_masks = view.shape(0);
  if (count == 0 || count > 0x3ffffff0) throw nb::value_error("sizes: between 1 and 2^30 segments are needed");
  require_rows("masks", mask_starts, masks, count, all_masks);
  require_rows("blank", blank_starts, blank_views, count, views);
  require_rows("near", near_starts, near, count, count);
  if (pixels.shape(0) != masks.shape(0) || blank.shape(0) != blank_views.shape(0) || z.shape(0) != count) {
    throw nb::value_error("pixels, blank and z must fit masks, blank_views and sizes");
  }
  const std::int32_t *v = view.data();
  if (!std::is_sorted(v, v + all_masks) || (all_masks && (v[0] < 0 || std::size_t(v[all_masks - 1]) >= views))) {
    throw nb::value_error("view: expected the view of each mask, ascending");
  }
  if (!all_finite(pixels) || !all_finite(blank) || !all_finite(z) || !all_finite(sizes)) {
    throw nb::value_error("pixels, blank, z and sizes must be finite");
  }
  if (!std::all_of(sizes.data(), sizes.data() + count, [](double s) { return s > 0; })) {
    throw nb::value_error("sizes must be positive");
  }
  if (!(lowest > 0) || !(prior > 0) || !(least_share >= 0) || !(one_sided >= 0)) {
    throw nb::value_error("lowest and prior must be positive, least_share and one_sided not negative");
  }
  if (children.shape(0) < count - 1 || affinity.shape(0) < count - 1) {
    throw nb::value_error("children and affinity must have room for a merge less than there are segments");
  }
  const perception::graph::Segments input{
      count, all_masks, views, z.shape(1), {mask_starts.data(), masks.data(), pixels.data()},
      {blank_starts.data(), blank_views.data(), blank.data()}, view.data(), near_starts.data(), near.data(), z.data(),
      sizes.data(), least_share, one_sided, prior, lowest, many, sure};
  nb::gil_scoped_release release;
  return perception::graph::merge_segments(input, children.data(), affinity.data(), [] {
    nb::gil_scoped_acquire acquire;
    if (PyErr_CheckSignals() != 0) throw nb::python_error();
  });
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
  m.def("merge_segments", &merge_segments, nb::arg("mask_starts").noconvert(), nb::arg("masks").noconvert(),
        nb::arg("pixels").noconvert(), nb::arg("blank_starts").noconvert(), nb::arg("blank_views").noconvert(),
        nb::arg("blank").noconvert(), nb::arg("view").noconvert(), nb::arg("views"), nb::arg("near_starts").noconvert(),
        nb::arg("near").noconvert(), nb::arg("z").noconvert(), nb::arg("sizes").noconvert(), nb::arg("least_share"),
        nb::arg("one_sided"), nb::arg("prior"), nb::arg("lowest"), nb::arg("many"), nb::arg("sure"),
        nb::arg("children").noconvert(),
        nb::arg("affinity").noconvert(),
        "Merge tree of segments by their masks; see perception.masks.consensus. Fills children and affinity and "
        "returns the number of merges.");
}

// The compiled core: no torch, no I/O. Each component binds itself in a file of its own.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "common/levels.h"

namespace nb = nanobind;

void bind_rasterizer(nb::module_ &m);
void bind_training(nb::module_ &m);
void bind_graph(nb::module_ &m);
void bind_stereo(nb::module_ &m);
void bind_normal(nb::module_ &m);

NB_MODULE(_core, m) {
  m.doc() = "Compiled kernels of perception.";
  m.def("simd_levels", &perception::level_names, "SIMD levels that this processor has, best first.");
  bind_rasterizer(m);
  bind_training(m);
  bind_graph(m);
  bind_stereo(m);
  bind_normal(m);
}

// The compiled core: no torch, no I/O. Each concept binds itself in its own file.
#include <nanobind/nanobind.h>

namespace nb = nanobind;

void bind_rasterizer(nb::module_ &m);
void bind_training(nb::module_ &m);
void bind_graph(nb::module_ &m);

NB_MODULE(_core, m) {
  m.doc() = "Compiled kernels of perception.";
#ifdef PERCEPTION_HAVE_rasterizer
  bind_rasterizer(m);
#endif
#ifdef PERCEPTION_HAVE_training
  bind_training(m);
#endif
#ifdef PERCEPTION_HAVE_graph
  bind_graph(m);
#endif
}

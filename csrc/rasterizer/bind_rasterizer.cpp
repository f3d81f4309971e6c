// Python bindings of the rasterizer: checks shapes, releases the GIL, calls. Arrays come from Python, outputs too.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include <optional>
#include <stdexcept>

#include "../common/arguments.h"
#include "frames.h"
#include "rasterizer.h"

namespace nb = nanobind;
using namespace nb::literals;

namespace {

using perception::Level;

template <class T>
using Array = nb::ndarray<T, nb::c_contig, nb::device::cpu>;
template <class T>
using Optional = std::optional<Array<T>>;

std::string shape_text(const std::vector<int64_t> &shape) {
  std::string s = "[";
  for (std::size_t i = 0; i < shape.size(); ++i) s += (i ? ", " : "") + std::to_string(shape[i]);
  return s + "]";
}

template <class A>
auto *checked(const char *name, A &array, const std::vector<int64_t> &expected) {
  std::vector<int64_t> found;
  for (std::size_t i = 0; i < array.ndim(); ++i) found.push_back(static_cast<int64_t>(array.shape(i)));
  if (found != expected)
    throw std::invalid_argument(std::string(name) + ": shape " + shape_text(found) + ", expected " +
                                shape_text(expected));
  perception::require_aligned(name, array);
  return array.data();
}

template <class A>
auto checked(const char *name, std::optional<A> &array, const std::vector<int64_t> &expected)
    -> decltype(array->data()) {
  return array ? checked(name, *array, expected) : nullptr;
}

nb::dict stage_seconds(const perception::Stats &stats) {
  const char *names[perception::kStages] = {"project", "sort", "bin", "blend", "blend_backward", "reduce"};
  nb::dict seconds;
  for (int i = 0; i < perception::kStages; ++i) seconds[names[i]] = stats.seconds[i];
  return seconds;
}

template <class T>
struct Handle {
  perception::FramesPtr<T> frames;
};

template <class T>
struct Arguments {
  Array<const T> means, quats, scales, opacities, colors;
  Optional<const T> features;
  Array<const T> viewmats, Ks;
  Optional<const T> background;
  int width, height, sh_degree;
  T near_plane, eps2d;
  int threads;
  bool depth, variance;
  int64_t max_records;

  perception::Inputs<T> inputs() {
    perception::Inputs<T> in{};
    if (means.ndim() != 2) throw std::invalid_argument("means: expected 2 dimensions [N, 3]");
    if (viewmats.ndim() != 3) throw std::invalid_argument("viewmats: expected 3 dimensions [C, 4, 4]");
    const int64_t n = in.n = static_cast<int64_t>(means.shape(0)),
                  c = in.cameras = static_cast<int64_t>(viewmats.shape(0));
    if (n >= INT32_MAX) throw std::invalid_argument("means: too many Gaussians");
    if (width < 1 || height < 1 || width > 1 << 20 || height > 1 << 20)
      throw std::invalid_argument("width, height: expected 1 to 1048576 pixels");
    if (!(eps2d >= T(0.01) && eps2d <= T(1e4))) throw std::invalid_argument("eps2d: expected 0.01 to 10000 px²");
    if (sh_degree > 3) throw std::invalid_argument("sh_degree: expected at most 3");
    in.means = checked("means", means, {n, 3}), in.quats = checked("quats", quats, {n, 4});
    in.scales = checked("scales", scales, {n, 3}), in.opacities = checked("opacities", opacities, {n});
    in.sh_degree = sh_degree;
    if (sh_degree < 0) {
      in.colors = checked("colors", colors, {n, 3});
    } else {
      in.sh_stride = colors.ndim() == 3 ? static_cast<int>(colors.shape(1)) : 0;
      if (in.sh_stride < (sh_degree + 1) * (sh_degree + 1))
        throw std::invalid_argument("colors: expected [N, K, 3] with K >= (sh_degree + 1)^2");
      in.colors = checked("colors", colors, {n, in.sh_stride, 3});
    }
    if (features) {
      if (features->ndim() != 2 || features->shape(1) > 1 << 16)
        throw std::invalid_argument("features: expected [N, D]");
      in.dims = static_cast<int>(features->shape(1));
      in.features = checked("features", features, {n, in.dims});
    }
    in.viewmats = checked("viewmats", viewmats, {c, 4, 4}), in.Ks = checked("Ks", Ks, {c, 3, 3});
    for (int64_t i = 0; i < c; ++i)
      if (!(in.Ks[9 * i] != 0 && in.Ks[9 * i + 4] != 0))
        throw std::invalid_argument("Ks[" + std::to_string(i) + "]: a focal length is 0");
    in.background = checked("background", background, {c, 3});
    in.width = width, in.height = height, in.near_plane = near_plane, in.eps2d = eps2d;
    return in;
  }
  perception::Options options(const perception::Inputs<T> &in) const {
    if (threads < 1 || threads > 1024) throw std::invalid_argument("threads: expected 1 to 1024");
    if (max_records < 0) throw std::invalid_argument("max_records: expected 0 or more");
    return {threads, depth, variance && in.dims > 0, max_records};
  }
};

template <class T>
struct Images {
  Array<T> colors, alphas;
  Optional<T> depths, features, variance;
  void fill(const perception::Inputs<T> &in, const perception::Options &opt, perception::Outputs<T> &out) {
    const int64_t c = in.cameras, h = in.height, w = in.width;
    out.colors = checked("out colors", colors, {c, h, w, 3}), out.alphas = checked("out alphas", alphas, {c, h, w});
    out.depths = checked("out depths", depths, {c, h, w});
    out.features = checked("out features", features, {c, h, w, in.dims});
    out.variance = checked("out feature_variance", variance, {c, h, w, in.dims});
    if (opt.variance && !(out.features && out.variance))
      throw std::invalid_argument("features and feature_variance need outputs");
  }
};

void throw_if(const perception::NonFinite &bad) {
  if (bad.argument)
    throw std::invalid_argument(std::string(bad.argument) + "[" + std::to_string(bad.index) + "] is not finite");
}

template <class T>
std::unique_ptr<Handle<T>> forward(Arguments<T> &a, Images<T> images, Array<uint8_t> visible, Optional<T> radii,
                                   const std::string &simd) {
  const perception::Inputs<T> in = a.inputs();
  const perception::Options opt = a.options(in);
  const Level level = perception::parse_level(simd);
  perception::Outputs<T> out{};
  images.fill(in, opt, out);
  if (in.dims && !out.features) throw std::invalid_argument("features need an output");
  out.visible = checked("out visible", visible, {in.cameras, in.n});
  out.radii = checked("out radii", radii, {in.cameras, in.n});
  perception::NonFinite bad;
  auto handle = std::make_unique<Handle<T>>();
  {
    nb::gil_scoped_release release;
    handle->frames = perception::rasterize_forward(in, opt, level, out, bad);
  }
  throw_if(bad);
  return handle;
}

template <class T>
void label(Arguments<T> &a, Array<const int32_t> labels, double least, Array<int32_t> images, Array<uint8_t> visible,
           const std::string &simd) {
  const perception::Inputs<T> in = a.inputs();
  const perception::Options opt = a.options(in);
  const Level level = perception::parse_level(simd);
  if (in.cameras != 1) throw std::invalid_argument("viewmats: expected one camera");
  if (labels.ndim() != 2 || labels.shape(0) > perception::kMaxLabellings)
    throw std::invalid_argument("labels: expected [L, N] with at most 8 labellings");
  const int64_t count = static_cast<int64_t>(labels.shape(0));
  perception::Labels found{};
  found.count = static_cast<int>(count), found.least = least;
  found.of = checked("labels", labels, {count, in.n});
  found.images = checked("out images", images, {count, in.height, in.width});
  uint8_t *seen = checked("out visible", visible, {in.n});
  int32_t largest = -1;
  for (int64_t i = 0; i < count * in.n; ++i) largest = std::max(largest, found.of[i]);
  if (largest >= 1 << 24) throw std::invalid_argument("labels: expected less than 16777216");
  found.most = largest + 1;
  perception::NonFinite bad;
  {
    nb::gil_scoped_release release;
    bad = perception::rasterize_labels(in, opt, level, found, seen);
  }
  throw_if(bad);
}

template <class T>
void backward(Arguments<T> &a, Handle<T> &handle, Images<T> images, Optional<const T> g_colors,
              Optional<const T> g_alphas, Optional<const T> g_depths, Optional<const T> g_features,
              Optional<const T> g_variance, Optional<T> means, Optional<T> quats, Optional<T> scales,
              Optional<T> opacities, Optional<T> colors, Optional<T> features, Optional<T> viewmats,
              Optional<T> mean2d, bool stored) {
  const perception::Inputs<T> in = a.inputs();
  const perception::Options opt = a.options(in);
  const perception::Frames<T> *frames = handle.frames.get();
  if (!frames || static_cast<int64_t>(frames->cameras.size()) != in.cameras || frames->n != in.n ||
      frames->width != in.width || frames->height != in.height)
    throw std::invalid_argument("frames: not of inputs with as many Gaussians, cameras and pixels");
  const int64_t n = in.n, c = in.cameras, h = in.height, w = in.width, d = in.dims;
  perception::Outputs<T> out{};
  images.fill(in, opt, out);
  if (stored && c != 1) throw std::invalid_argument("stored: expected one camera");
  perception::Cotangents<T> grad{};
  grad.colors = checked("colors' gradient", g_colors, {c, h, w, 3});
  grad.alphas = checked("alphas' gradient", g_alphas, {c, h, w});
  grad.depths = checked("depths' gradient", g_depths, {c, h, w});
  if (opt.depth && grad.depths && !out.depths) throw std::invalid_argument("depths: missing, their gradient is given");
  grad.features = checked("features' gradient", g_features, {c, h, w, d});
  grad.variance = checked("feature_variance's gradient", g_variance, {c, h, w, d});
  perception::Gradients<T> result{};
  result.means = checked("out means", means, {n, 3}), result.quats = checked("out quats", quats, {n, 4});
  result.scales = checked("out scales", scales, {n, 3}), result.opacities = checked("out opacities", opacities, {n});
  const std::vector<int64_t> color_shape =
      in.sh_degree < 0 ? std::vector<int64_t>{n, 3} : std::vector<int64_t>{n, in.sh_stride, 3};
  result.colors = checked("out colors", colors, color_shape);
  result.features = checked("out features", features, {n, d});
  result.viewmats = checked("out viewmats", viewmats, {c, 4, 4});
  result.mean2d = checked("out mean2d", mean2d, {c, n, 2});
  result.stored = stored;
  if (in.dims && !out.features && !(result.features_alone() && !opt.variance))
    throw std::invalid_argument("features: missing, gradients need them");
  nb::gil_scoped_release release;
  perception::rasterize_backward(in, opt, *handle.frames, out, grad, result);
}

template <class T>
void bind(nb::module_ &m, const char *suffix) {
  auto name = [suffix](const char *base) { return std::string(base) + suffix; };
  nb::class_<Handle<T>>(m, name("RasterizerFrames").c_str(), "What a backward call needs of its forward call.")
      .def_prop_ro("evaluated", [](const Handle<T> &h) { return h.frames->stats.evaluated; })
      .def_prop_ro("contributing", [](const Handle<T> &h) { return h.frames->stats.contributing; })
      .def_prop_ro("seconds", [](const Handle<T> &h) { return stage_seconds(h.frames->stats); });
  nb::class_<Arguments<T>>(m, name("RasterizerInputs").c_str())
      .def(
          "__init__",
          [](Arguments<T> *self, Array<const T> means, Array<const T> quats, Array<const T> scales,
             Array<const T> opacities, Array<const T> colors, Optional<const T> features, Array<const T> viewmats,
             Array<const T> Ks, Optional<const T> background, int width, int height, int sh_degree, double near_plane,
             double eps2d, int threads, bool depth, bool variance, int64_t max_records) {
            new (self) Arguments<T>{means,
                                    quats,
                                    scales,
                                    opacities,
                                    colors,
                                    features,
                                    viewmats,
                                    Ks,
                                    background,
                                    width,
                                    height,
                                    sh_degree,
                                    static_cast<T>(near_plane),
                                    static_cast<T>(eps2d),
                                    threads,
                                    depth,
                                    variance,
                                    max_records};
          },
          "means"_a.noconvert(), "quats"_a.noconvert(), "scales"_a.noconvert(), "opacities"_a.noconvert(),
          "colors"_a.noconvert(), "features"_a.noconvert().none(), "viewmats"_a.noconvert(), "Ks"_a.noconvert(),
          "background"_a.noconvert().none(), "width"_a, "height"_a, "sh_degree"_a, "near_plane"_a, "eps2d"_a,
          "threads"_a, "depth"_a, "variance"_a, "max_records"_a);
  m.def(
      name("rasterize_forward").c_str(),
      [](Arguments<T> &inputs, Array<T> colors, Array<T> alphas, Optional<T> depths, Optional<T> features,
         Optional<T> variance, Array<uint8_t> visible, Optional<T> radii, const std::string &simd) {
        return forward<T>(inputs, {colors, alphas, depths, features, variance}, visible, radii, simd);
      },
      "inputs"_a, "colors"_a.noconvert(), "alphas"_a.noconvert(), "depths"_a.noconvert().none(),
      "features"_a.noconvert().none(), "variance"_a.noconvert().none(), "visible"_a.noconvert(),
      "radii"_a.noconvert().none(), "simd"_a);
  m.def(name("rasterize_labels").c_str(), &label<T>, "inputs"_a, "labels"_a.noconvert(), "least"_a,
        "images"_a.noconvert(), "visible"_a.noconvert(), "simd"_a);
  m.def(
      name("rasterize_backward").c_str(),
      [](Arguments<T> &inputs, Handle<T> &frames, Array<T> colors, Array<T> alphas, Optional<T> depths,
         Optional<T> features, Optional<T> variance, Optional<const T> g_colors, Optional<const T> g_alphas,
         Optional<const T> g_depths, Optional<const T> g_features, Optional<const T> g_variance, Optional<T> d_means,
         Optional<T> d_quats, Optional<T> d_scales, Optional<T> d_opacities, Optional<T> d_colors,
         Optional<T> d_features, Optional<T> d_viewmats, Optional<T> d_mean2d, bool stored) {
        backward<T>(inputs, frames, {colors, alphas, depths, features, variance}, g_colors, g_alphas, g_depths,
                    g_features, g_variance, d_means, d_quats, d_scales, d_opacities, d_colors, d_features, d_viewmats,
                    d_mean2d, stored);
      },
      "inputs"_a, "frames"_a, "colors"_a.noconvert(), "alphas"_a.noconvert(), "depths"_a.noconvert().none(),
      "features"_a.noconvert().none(), "variance"_a.noconvert().none(), "g_colors"_a.noconvert().none(),
      "g_alphas"_a.noconvert().none(), "g_depths"_a.noconvert().none(), "g_features"_a.noconvert().none(),
      "g_variance"_a.noconvert().none(), "d_means"_a.noconvert().none(), "d_quats"_a.noconvert().none(),
      "d_scales"_a.noconvert().none(), "d_opacities"_a.noconvert().none(), "d_colors"_a.noconvert().none(),
      "d_features"_a.noconvert().none(), "d_viewmats"_a.noconvert().none(), "d_mean2d"_a.noconvert().none(),
      "stored"_a = false);
}

}  // namespace

void bind_rasterizer(nb::module_ &m) {
  nb::set_leak_warnings(false);  // a graph still alive at exit legitimately holds its frames
  bind<float>(m, "_f32");
  bind<double>(m, "_f64");
  m.def("rasterizer_release_memory", &perception::release_memory, "Frees the buffers kept between calls.");
}

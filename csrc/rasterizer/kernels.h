// What is compiled once per SIMD level. float has every level; double, the oracle of the float build, has the baseline
// only, where no intrinsics are.
#pragma once
#include <type_traits>

#include "../common/parallel.h"
#include "records.h"
#include "scratch.h"

namespace perception {

// The slice of feature channels one pass blends. alone: a backward pass gives the gradients of these channels only.
struct Slice {
  int begin, count;
  bool alone = false;
};

// One camera of one call: an argument of every kernel.
template <class T>
struct Pass {
  const Inputs<T> &in;
  const Options &opt;
  int camera;
  const Frame<T> &frame;    // the camera's splats and tiles
  const Outputs<T> &out;    // written by the forward pass, read by the backward pass
  Cotangents<T> grad = {};  // of the backward pass
};

// Width of the kernel that a slice goes through.
template <class T>
constexpr int slice_width(Slice slice) {
  return slice.count == 0 ? 0 : slice.count <= 8 && sizeof(T) == 4 ? 8 : 16;
}

// Numbers of a gradient record.
template <class T>
constexpr int record_size(Slice slice) {
  return (slice.alone ? 0 : kGeometry) + slice_width<T>(slice);
}

// Calls body(NF, VAR) with the shape of the kernel for a slice as compile-time constants. double has one shape with
// features and one without.
template <class T, class Body>
inline __attribute__((always_inline)) void with_shape(Slice slice, bool variance, Body &&body) {
  using std::integral_constant;
  if (slice.count == 0) return body(integral_constant<int, 0>(), std::false_type());
  if constexpr (sizeof(T) == 8) return body(integral_constant<int, 16>(), std::true_type());
  if (slice.count <= 8)
    variance ? body(integral_constant<int, 8>(), std::true_type())
             : body(integral_constant<int, 8>(), std::false_type());
  else
    variance ? body(integral_constant<int, 16>(), std::true_type())
             : body(integral_constant<int, 16>(), std::false_type());
}

// project: Gaussians [begin, end) into frame.splats[begin...], with the keys of their depths, radii where not null.
//   Returns how many are in view; `bad` becomes the index of a Gaussian that is not finite, or of the first of a block
//   whose colours or features are not (looked at where `check`).
// forward: blends one slice of the channels of all tiles.
// backward: the records of one slice, of the tiles in a range; scratch.slots say where they go.
// backward_features: the same where only the features' gradients are wanted (slice.alone).
// add_records: adds them, `size` numbers each, to one sum a splat.
// label_pixels: the images of labels, of one camera.
// reduce: from one slice's records (see record_size) to gradients of the Gaussians and the camera.
#define PERCEPTION_RASTERIZER_KERNELS                                                                              \
  template <class T>                                                                                               \
  uint32_t project(const Inputs<T> &, const Frame<T> &, int64_t begin, int64_t end, bool check, DepthKey<T> *keys, \
                   T *radii, int64_t &bad);                                                                        \
  template <class T>                                                                                               \
  void forward(const Pass<T> &, Slice, Scratch<T> &);                                                              \
  template <class T>                                                                                               \
  void backward(const Pass<T> &, Slice, TileRange, Scratch<T> &);                                                  \
  template <class T>                                                                                               \
  void backward_features(const Pass<T> &, Slice, TileRange, Scratch<T> &);                                         \
  template <class T>                                                                                               \
  void label_pixels(const Inputs<T> &, const Options &, const Frame<T> &, const Labels &, Scratch<T> &,            \
                    uint8_t *visible);                                                                             \
  template <class T>                                                                                               \
  void add_records(const Options &, const Frame<T> &, int size, Scratch<T> &);                                     \
  template <class T>                                                                                               \
  void reduce(const Pass<T> &, Slice, Scratch<T> &, const Gradients<T> &);

PERCEPTION_DECLARE_LEVELS(PERCEPTION_RASTERIZER_KERNELS)

}  // namespace perception

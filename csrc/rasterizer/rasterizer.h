// The CPU rasterizer's interface, in plain arrays: no torch, no Python. Everything is templated on float and double;
// the double build is the oracle of the float build.
#pragma once
#include <chrono>
#include <cstdint>
#include <memory>
#include <string>

#include "../common/levels.h"
#include "buffer.h"
#include "projection_math.h"

namespace perception {

// All arrays row-major and contiguous.
template <class T>
struct Inputs {
  int64_t n, cameras;
  const T *means;            // [N,3] world
  const T *quats;            // [N,4] wxyz, any norm
  const T *scales;           // [N,3]
  const T *opacities;        // [N]
  const T *colors;           // [N,3], or [N,K,3] when sh_degree >= 0
  int sh_degree, sh_stride;  // -1: colours; K
  const T *features;         // [N,D] or null
  int dims;                  // D
  const T *viewmats;         // [C,4,4] camera_from_world
  const T *Ks;               // [C,3,3]
  const T *background;       // [C,3] or null
  int width, height;
  T near_plane;
  T eps2d;  // px², > 0

  int color_width() const { return sh_degree < 0 ? 3 : 3 * sh_stride; }
};

template <class T>
struct Outputs {
  T *colors;         // [C,H,W,3]
  T *alphas;         // [C,H,W]
  T *depths;         // [C,H,W] or null
  T *features;       // [C,H,W,D] or null
  T *variance;       // [C,H,W,D] or null
  uint8_t *visible;  // [C,N], zero on entry
  T *radii;          // [C,N] px, three standard deviations along the long axis; zero on entry, or null
};

// dL/d(output); null means zero.
template <class T>
struct Cotangents {
  const T *colors, *alphas, *depths, *features, *variance;
};

// dL/d(input), added to what is there; null where not wanted.
// stored: for one camera, those of a step of training. They are written instead of added, for visible Gaussians only, and
// those of scales and opacities are with respect to the stored parameters, logarithms and logits.
template <class T>
struct Gradients {
  T *means, *quats, *scales, *opacities, *colors, *features, *viewmats;
  T *mean2d, *absgrad;  // [C,N,2] px; absgrad: see absolute_gradient in reduce.cpp
  bool stored;

  bool features_alone() const {
    return features && !(means || quats || scales || opacities || colors || viewmats || mean2d || absgrad);
  }
};

// A Gaussian as one camera sees it. exponent in base 2: log2(alpha) = log_opacity + a (dx + k dy)² + d dy².
template <class T>
struct alignas(64) Splat {
  T x, y;  // px
  T a, k, d, log_opacity;
  T r, g, b, z;
  T reach;                  // log_opacity - log2(1/255) + slack: how far the exponent may fall
  T slope;                  // dy/dx of the line on which the exponent is largest for a given dx
  int32_t id;               // index of the Gaussian
  uint16_t x0, y0, x1, y1;  // 64-pixel tiles touched, inclusive
};

// One camera's splats and, for every 64x64-pixel tile, the indices of its splats from front to back.
template <class T>
struct Frame {
  Camera<T> camera;
  int tiles_x = 0, tiles_y = 0;
  uint32_t count = 0;       // visible splats
  Buffer<Splat<T>> splats;  // in order of the Gaussians' index
  Buffer<uint32_t> list;
  Buffer<uint32_t> offsets;     // [tiles + 1]
  Buffer<uint32_t> tile_order;  // tiles by falling list length
};

enum Stage { kProject, kSort, kBin, kBlend, kBlendBackward, kReduce, kStages };

// What a call did. A pair is one splat at one pixel: evaluated where a register of pixels was blended (lanes outside
// the ellipse or already opaque among them), contributing where it added colour.
struct Stats {
  uint64_t evaluated = 0, contributing = 0;
  double seconds[kStages] = {};  // wall clock by stage

  // Runs one stage and adds its time.
  template <class Body>
  void timed(Stage stage, Body &&body) {
    const auto start = std::chrono::steady_clock::now();
    body();
    seconds[stage] += std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
  }
};

struct Options {
  int threads;
  bool depth;               // blend the depth channel
  bool variance;            // blend the variance channels
  int64_t max_records = 0;  // gradient records held at once; 0: 4 a splat, at least 2^20
};

constexpr int kMaxLabellings = 8;

// Labellings of the Gaussians, and for each the image of the label with the largest weight in every pixel.
struct Labels {
  const int32_t *of;  // [L,N] -1 for none
  int count, most;    // L; every label is below `most`
  double least;       // weight that a label must exceed
  int32_t *images;    // [L,H,W] -1 where none does
};

// Where the first non-finite value was found.
struct NonFinite {
  const char *argument = nullptr;
  int64_t index = -1;
};

template <class T>
struct Scratch;
template <class T>
struct ScratchDelete {
  void operator()(Scratch<T> *) const;
};
template <class T>
using ScratchPtr = std::unique_ptr<Scratch<T>, ScratchDelete<T>>;

// What a forward call keeps for its backward call: one frame a camera. Returned to a pool when destroyed.
template <class T>
struct Frames;
template <class T>
struct FramesDelete {
  void operator()(Frames<T> *) const;
};
template <class T>
using FramesPtr = std::unique_ptr<Frames<T>, FramesDelete<T>>;

template <class T>
FramesPtr<T> rasterize_forward(const Inputs<T> &, const Options &, Level, const Outputs<T> &, NonFinite &);
template <class T>
void rasterize_backward(const Inputs<T> &, const Options &, Frames<T> &, const Outputs<T> &, const Cotangents<T> &,
                        const Gradients<T> &);

// One camera's images of labels. visible: [N], zero on entry.
template <class T>
NonFinite rasterize_labels(const Inputs<T> &, const Options &, Level, const Labels &, uint8_t *visible);

// Memory beyond the arrays passed in, all of it kept and reused: a splat takes 64 bytes and 4 for every 64x64-pixel
// tile its box touches, of which there may be kMaxListed; a backward pass adds max_records records of 4 (16 + features)
// bytes; every thread the splats of its current tile, some 400 bytes each.
constexpr uint64_t kMaxListed = uint64_t{1} << 29;

// Frees what the pools keep between calls.
void release_memory();

}  // namespace perception

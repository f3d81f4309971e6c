// All stages for one SIMD level (PERCEPTION_LEVEL); compiled once per level.
#include <chrono>

#include "bin_stage.h"
#include "blend_forward.h"
#include "project_stage.h"
#include "reduce_stage.h"
#include "sort_stage.h"

namespace perception {
namespace PERCEPTION_LEVEL {

// Runs one stage and adds its time.
template <class Body>
void timed(Stats &stats, Stage stage, Body &&body) {
  const auto start = std::chrono::steady_clock::now();
  body();
  stats.seconds[stage] += std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
}

template <class T>
NonFinite prepare(const Inputs<T> &in, int camera, const Options &opt, Frame<T> &f, Scratch<T> &scratch,
                  const Outputs<T> &out, Stats &stats) {
  f.camera = make_camera(in.viewmats + 16 * camera, in.Ks + 9 * camera, in.width, in.height, in.near_plane, in.eps2d);
  f.tiles_x = (in.width + 63) / 64, f.tiles_y = (in.height + 63) / 64;
  f.count = 0;
  NonFinite bad;
  timed(stats, kProject,
        [&] { bad = project_all(in, opt, f, scratch, camera == 0, out.radii ? out.radii + in.n * camera : nullptr); });
  if (bad.argument) return bad;
  timed(stats, kSort, [&] { sort_by_depth(opt, f.count, scratch); });
  timed(stats, kBin, [&] { bin_splats(opt, f, scratch); });
  return {};
}

// Calls body with the kernel's shape as compile-time constants; any feature width goes through in slices of 16.
template <int NF_, bool VAR_, bool DEPTH_>
struct Shape {
  static constexpr int NF = NF_;
  static constexpr bool VAR = VAR_, DEPTH = DEPTH_;
};

template <class Body>
void for_each_slice(int dims, const Options &opt, Body &&body) {
  auto with_depth = [&](Slice slice, auto width, auto variance) {
    if (opt.depth)
      body(slice, Shape<width(), variance(), true>());
    else
      body(slice, Shape<width(), variance(), false>());
  };
  auto with_variance = [&](Slice slice, auto width) {
    opt.variance ? with_depth(slice, width, std::true_type()) : with_depth(slice, width, std::false_type());
  };
  if (dims == 0) return with_depth(Slice{0, 0}, std::integral_constant<int, 0>(), std::false_type());
  for (int begin = 0; begin < dims; begin += 16) {
    const Slice slice{begin, dims - begin < 16 ? dims - begin : 16};
    if (slice.count <= 8)
      with_variance(slice, std::integral_constant<int, 8>());
    else
      with_variance(slice, std::integral_constant<int, 16>());
  }
}

template <class T>
void forward(const Inputs<T> &in, int camera, const Options &opt, const Frame<T> &f, Scratch<T> &scratch,
             const Outputs<T> &out, Stats &stats) {
  for (Worker<T> &w : scratch.workers) w.evaluated = w.contributing = 0;
  for_each_slice(in.dims, opt, [&](Slice slice, auto shape) {
    using S = decltype(shape);
    timed(stats, kBlend, [&] {
      parallel_for(opt.threads, f.tiles_x * f.tiles_y, [&](std::size_t i, int worker) {
        forward_supertile<T, S::NF, S::VAR, S::DEPTH>(in, camera, f, f.tile_order[i], slice, scratch.workers[worker],
                                                      out);
      });
    });
    if (slice.begin > 0) return;  // the other slices blend the same pairs again
    for (const Worker<T> &w : scratch.workers) stats.evaluated += w.evaluated, stats.contributing += w.contributing;
  });
}

template <class T>
void backward(const Inputs<T> &in, int camera, const Options &opt, const Frame<T> &f, Scratch<T> &scratch,
              const Outputs<T> &out, const Cotangents<T> &grad, const Gradients<T> &result, Stats &stats) {
  const int tiles = f.tiles_x * f.tiles_y;
  const uint64_t limit = opt.max_records > 0 ? opt.max_records : std::max<uint64_t>(1 << 20, 4 * uint64_t{f.count});
  for_each_slice(in.dims, opt, [&](Slice slice, auto shape) {
    using S = decltype(shape);
    constexpr int kSize = kGeometry + S::NF;
    const bool parts = next_range(f, 0, limit).end < tiles;  // the records of the whole picture are too many
    if (parts) {
      std::memset(scratch.sum_touched.reserve(f.count), 0, f.count);
      scratch.sums.reserve(static_cast<std::size_t>(f.count) * kSize);
    }
    for (TileRange range{0, 0}; range.end < tiles;) {
      range = next_range(f, range.end, limit);
      timed(stats, kBlendBackward, [&] {
        const uint64_t slots = assign_slots(f, range, scratch);
        std::memset(scratch.touched.reserve(slots), 0, slots);
        scratch.records.reserve(slots * kSize);
        parallel_for(opt.threads, tiles, [&](std::size_t i, int worker) {
          const int tile = f.tile_order[i];
          if (tile < range.begin || tile >= range.end) return;
          backward_supertile<T, S::NF, S::VAR, S::DEPTH>(in, camera, f, tile, slice, scratch, scratch.workers[worker],
                                                         out, grad);
        });
      });
      if (parts) timed(stats, kReduce, [&] { add_records(opt, f, kSize, scratch); });
    }
    if (parts) take_sums(f, scratch);
    timed(stats, kReduce, [&] { reduce_gradients(in, opt, f, camera, slice, S::NF, scratch, result); });
  });
}

extern const Kernels<float> float_kernels;
extern const Kernels<double> double_kernels;
const Kernels<float> float_kernels = {prepare<float>, forward<float>, backward<float>};
const Kernels<double> double_kernels = {prepare<double>, forward<double>, backward<double>};

}  // namespace PERCEPTION_LEVEL
}  // namespace perception

// Runs the stages camera by camera, on memory from a pool.
#include "rasterizer.h"

#include <sys/mman.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <mutex>
#include <type_traits>

#include "bin.h"
#include "constants.h"
#include "frames.h"
#include "kernels.h"
#include "records.h"
#include "sort.h"

namespace perception {

void *renew(void *old, std::size_t bytes) {
  std::free(old);
  // Splats and records are visited in the order of depth and of tiles: on pages of 4 KiB most visits miss the TLB.
  constexpr std::size_t kHugePage = std::size_t{1} << 21;
  const std::size_t unit = bytes >= kHugePage ? kHugePage : 64, size = (bytes + unit - 1) & ~(unit - 1);
  void *p = nullptr;
  if (posix_memalign(&p, unit, size) != 0) throw std::bad_alloc();
#ifdef MADV_HUGEPAGE
  if (unit == kHugePage) madvise(p, size, MADV_HUGEPAGE);  // a wish: where it is not granted all works as before
#endif
  return p;
}

namespace {

template <class T>
struct Kernels {
  decltype(&baseline::project<T>) project;
  decltype(&baseline::forward<T>) forward;
  decltype(&baseline::label_pixels<T>) label_pixels;
  decltype(&baseline::backward<T>) backward, backward_features;
  decltype(&baseline::add_records<T>) add_records;
  decltype(&baseline::reduce<T>) reduce;
};

template <class T>
Kernels<T> kernels(Level level) {
  if constexpr (std::is_same_v<T, double>)
    return {baseline::project<T>, baseline::forward<T>, baseline::label_pixels<T>, baseline::backward<T>,
            baseline::backward_features<T>, baseline::add_records<T>, baseline::reduce<T>};
  else
    return {PERCEPTION_AT_LEVEL(level, project<T>), PERCEPTION_AT_LEVEL(level, forward<T>),
            PERCEPTION_AT_LEVEL(level, label_pixels<T>),
            PERCEPTION_AT_LEVEL(level, backward<T>), PERCEPTION_AT_LEVEL(level, backward_features<T>),
            PERCEPTION_AT_LEVEL(level, add_records<T>), PERCEPTION_AT_LEVEL(level, reduce<T>)};
}

// Objects whose buffers are worth keeping between calls. Never destroyed, so it is safe at exit.
template <class Object>
class ObjectPool {
 public:
  static ObjectPool &get() {
    static ObjectPool *pool = new ObjectPool;
    return *pool;
  }
  std::unique_ptr<Object> take() {
    std::lock_guard<std::mutex> lock(mutex_);
    if (idle_.empty()) return std::make_unique<Object>();
    std::unique_ptr<Object> o = std::move(idle_.back());
    idle_.pop_back();
    return o;
  }
  void give(std::unique_ptr<Object> o) {
    std::lock_guard<std::mutex> lock(mutex_);
    if (idle_.size() < kKeep) idle_.push_back(std::move(o));
  }
  void clear() {
    std::lock_guard<std::mutex> lock(mutex_);
    idle_.clear();
  }

 private:
  static constexpr std::size_t kKeep = 4;
  std::mutex mutex_;
  std::vector<std::unique_ptr<Object>> idle_;
};

template <class T>
NonFinite check_cameras(const Inputs<T> &in) {
  struct Argument {
    const char *name;
    const T *data;
    int width;
  } arguments[] = {
      {"viewmats", in.viewmats, 16}, {"Ks", in.Ks, 9}, {"background", in.background, in.background ? 3 : 0}};
  for (const Argument &a : arguments)
    for (int64_t i = 0; i < in.cameras * a.width; ++i)
      if (!std::isfinite(a.data[i])) return {a.name, i / a.width};
  return {};
}

template <class T>
ScratchPtr<T> take_scratch(int threads) {
  ScratchPtr<T> s(ObjectPool<Scratch<T>>::get().take().release());
  if (s->workers.size() < static_cast<std::size_t>(threads)) s->workers.resize(threads);
  return s;
}

// The first offender at or after Gaussian `from`.
template <class T>
NonFinite find_non_finite(const Inputs<T> &in, int64_t from) {
  struct Argument {
    const char *name;
    const T *data;
    int width;
  } arguments[] = {{"means", in.means, 3},
                   {"quats", in.quats, 4},
                   {"scales", in.scales, 3},
                   {"opacities", in.opacities, 1},
                   {"colors", in.colors, in.color_width()},
                   {"features", in.features, in.features ? in.dims : 0}};
  for (int64_t i = from; i < in.n; ++i)
    for (const Argument &a : arguments)
      for (int c = 0; c < a.width; ++c)
        if (!std::isfinite(a.data[a.width * i + c])) return {a.name, i};
  return {};
}

// Contiguous ranges, one a thread, then closed up: the result does not depend on the number of threads.
template <class T>
NonFinite project_all(const Kernels<T> &kernels, const Inputs<T> &in, const Options &opt, Frame<T> &f,
                      Scratch<T> &scratch, bool check, T *radii) {
  f.splats.reserve(in.n);
  DepthKey<T> *keys = scratch.keys[0].reserve(in.n);
  const int64_t blocks = (in.n + kBlock - 1) / kBlock;
  const int parts = static_cast<int>(blocks < opt.threads ? (blocks ? blocks : 1) : opt.threads);
  uint32_t *counts = scratch.histograms.reserve(parts);
  std::vector<int64_t> bad(parts, -1);
  auto begin = [&](int64_t part) { return part == parts ? in.n : blocks * part / parts * kBlock; };
  parallel_for(opt.threads, parts, [&](std::size_t part, int) {
    counts[part] = kernels.project(in, f, begin(part), begin(part + 1), check, keys, radii, bad[part]);
  });
  for (int64_t i : bad)
    if (i >= 0) return find_non_finite(in, i);
  f.count = counts[0];
  for (int part = 1; part < parts; ++part) {
    std::memmove(f.splats.data() + f.count, f.splats.data() + begin(part), counts[part] * sizeof(Splat<T>));
    std::memmove(keys + f.count, keys + begin(part), counts[part] * sizeof(*keys));
    f.count += counts[part];
  }
  return {};
}

// Projects, sorts and bins camera `camera` into frame.
template <class T>
NonFinite prepare(const Kernels<T> &kernels, const Inputs<T> &in, int camera, const Options &opt, Frame<T> &f,
                  Scratch<T> &scratch, const Outputs<T> &out, Stats &stats) {
  f.camera = make_camera(in.viewmats + 16 * camera, in.Ks + 9 * camera, in.width, in.height, in.near_plane, in.eps2d);
  f.tiles_x = (in.width + 63) / 64, f.tiles_y = (in.height + 63) / 64;
  T *radii = out.radii ? out.radii + in.n * camera : nullptr;
  NonFinite bad;
  stats.timed(kProject, [&] { bad = project_all(kernels, in, opt, f, scratch, camera == 0, radii); });
  if (bad.argument) return bad;
  stats.timed(kSort, [&] { sort_by_depth(opt, f.count, scratch); });
  stats.timed(kBin, [&] { bin_splats(opt, f, scratch); });
  return {};
}

// Any feature width goes through in slices of 16.
template <class Body>
void for_each_slice(int dims, Body &&body) {
  if (dims == 0) return body(Slice{0, 0, false});
  for (int begin = 0; begin < dims; begin += 16) body(Slice{begin, std::min(16, dims - begin), false});
}

template <class T>
void blend(const Kernels<T> &kernels, const Pass<T> &pass, Scratch<T> &scratch, Stats &stats) {
  for (Worker<T> &w : scratch.workers) w.evaluated = w.contributing = 0;
  for_each_slice(pass.in.dims, [&](Slice slice) {
    stats.timed(kBlend, [&] { kernels.forward(pass, slice, scratch); });
    if (slice.begin > 0) return;  // the other slices blend the same pairs again
    for (const Worker<T> &w : scratch.workers) stats.evaluated += w.evaluated, stats.contributing += w.contributing;
  });
}

// The backward pass of one slice up to its records. Where those of the whole picture are more than may be held at once
// it takes the picture in parts and leaves the sums over them, one record a splat.
template <class T>
void gather_records(const Kernels<T> &kernels, const Pass<T> &pass, Slice slice, Scratch<T> &scratch, Stats &stats) {
  const Frame<T> &f = pass.frame;
  const Options &opt = pass.opt;
  const int tiles = f.tiles_x * f.tiles_y, size = record_size<T>(slice);
  const uint64_t limit = opt.max_records > 0 ? opt.max_records : std::max<uint64_t>(1 << 20, 4 * uint64_t{f.count});
  const bool parts = next_range(f, 0, limit).end < tiles;
  if (parts) {
    std::memset(scratch.sum_touched.reserve(f.count), 0, f.count);
    scratch.sums.reserve(static_cast<std::size_t>(f.count) * size);
  }
  for (TileRange range{0, 0}; range.end < tiles;) {
    range = next_range(f, range.end, limit);
    stats.timed(kBlendBackward, [&] {
      const uint64_t slots = assign_slots(opt, f, range, scratch);
      std::memset(scratch.touched.reserve(slots), 0, slots);
      scratch.records.reserve(slots * size);
      (slice.alone ? kernels.backward_features : kernels.backward)(pass, slice, range, scratch);
    });
    if (parts) stats.timed(kReduce, [&] { kernels.add_records(opt, f, size, scratch); });
  }
  if (parts) take_sums(f, scratch);
}

}  // namespace

template <class T>
void ScratchDelete<T>::operator()(Scratch<T> *s) const {
  ObjectPool<Scratch<T>>::get().give(std::unique_ptr<Scratch<T>>(s));
}

template <class T>
void FramesDelete<T>::operator()(Frames<T> *f) const {
  for (auto &camera : f->cameras) ObjectPool<Frame<T>>::get().give(std::move(camera));
  delete f;
}

template <class T>
FramesPtr<T> rasterize_forward(const Inputs<T> &in, const Options &opt, Level level, const Outputs<T> &out,
                               NonFinite &bad) {
  bad = check_cameras(in);
  if (bad.argument) return nullptr;
  const Kernels<T> k = kernels<T>(level);
  const ScratchPtr<T> scratch = take_scratch<T>(opt.threads);
  FramesPtr<T> frames(new Frames<T>{{}, level, in.n, in.width, in.height, {}});
  for (int camera = 0; camera < in.cameras; ++camera) {
    frames->cameras.push_back(ObjectPool<Frame<T>>::get().take());
    Frame<T> &f = *frames->cameras.back();
    bad = prepare(k, in, camera, opt, f, *scratch, out, frames->stats);
    if (bad.argument) return nullptr;
    blend(k, {in, opt, camera, f, out}, *scratch, frames->stats);
  }
  return frames;
}

template <class T>
NonFinite rasterize_labels(const Inputs<T> &in, const Options &opt, Level level, const Labels &labels,
                           uint8_t *visible) {
  NonFinite bad = check_cameras(in);
  if (bad.argument) return bad;
  const Kernels<T> k = kernels<T>(level);
  const ScratchPtr<T> scratch = take_scratch<T>(opt.threads);
  FramesPtr<T> frames(new Frames<T>{{}, level, in.n, in.width, in.height, {}});
  frames->cameras.push_back(ObjectPool<Frame<T>>::get().take());
  Frame<T> &f = *frames->cameras[0];
  bad = prepare(k, in, 0, opt, f, *scratch, Outputs<T>{}, frames->stats);
  if (!bad.argument) k.label_pixels(in, opt, f, labels, *scratch, visible);
  return bad;
}

template <class T>
void rasterize_backward(const Inputs<T> &in, const Options &opt, Frames<T> &frames, const Outputs<T> &out,
                        const Cotangents<T> &grad, const Gradients<T> &result) {
  const Kernels<T> k = kernels<T>(frames.level);
  const ScratchPtr<T> scratch = take_scratch<T>(opt.threads);
  for (int camera = 0; camera < in.cameras; ++camera)
    for_each_slice(in.dims, [&](Slice slice) {
      const Pass<T> pass{in, opt, camera, *frames.cameras[camera], out, grad};
      slice.alone = result.features_alone() && slice.count > 0;
      gather_records(k, pass, slice, *scratch, frames.stats);
      frames.stats.timed(kReduce, [&] { k.reduce(pass, slice, *scratch, result); });
    });
}

void release_memory() {
  ObjectPool<Scratch<float>>::get().clear();
  ObjectPool<Scratch<double>>::get().clear();
  ObjectPool<Frame<float>>::get().clear();
  ObjectPool<Frame<double>>::get().clear();
}

#define INSTANTIATE(T)                                                                                                 \
  template struct ScratchDelete<T>;                                                                                    \
  template struct FramesDelete<T>;                                                                                     \
  template FramesPtr<T> rasterize_forward(const Inputs<T> &, const Options &, Level, const Outputs<T> &, NonFinite &); \
  template NonFinite rasterize_labels(const Inputs<T> &, const Options &, Level, const Labels &, uint8_t *);             \
  template void rasterize_backward(const Inputs<T> &, const Options &, Frames<T> &, const Outputs<T> &,                \
                                   const Cotangents<T> &, const Gradients<T> &);
INSTANTIATE(float)
INSTANTIATE(double)

}  // namespace perception

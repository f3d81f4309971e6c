// Runs the stages camera by camera, on memory from a pool.
#include "rasterizer.h"

#include <cmath>
#include <mutex>
#include <type_traits>

#include "frames.h"
#include "scratch.h"

namespace perception {

PERCEPTION_DECLARE_LEVELS(extern const Kernels<float> float_kernels; extern const Kernels<double> double_kernels)

void *aligned_allocate(std::size_t bytes) {
  void *p = nullptr;
  if (posix_memalign(&p, 64, (bytes + 63) & ~std::size_t{63}) != 0) throw std::bad_alloc();
  return p;
}

namespace {

template <class T>
const Kernels<T> &kernels(Level level) {
  if constexpr (std::is_same_v<T, float>)
    return PERCEPTION_AT_LEVEL(level, float_kernels);
  else
    return PERCEPTION_AT_LEVEL(level, double_kernels);
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
  const Kernels<T> &k = kernels<T>(level);
  const ScratchPtr<T> scratch = take_scratch<T>(opt.threads);
  FramesPtr<T> frames(new Frames<T>{{}, level, in.n, in.width, in.height, {}});
  for (int camera = 0; camera < in.cameras; ++camera) {
    frames->cameras.push_back(ObjectPool<Frame<T>>::get().take());
    Frame<T> &f = *frames->cameras.back();
    bad = k.prepare(in, camera, opt, f, *scratch, out, frames->stats);
    if (bad.argument) return nullptr;
    k.forward(in, camera, opt, f, *scratch, out, frames->stats);
  }
  return frames;
}

template <class T>
void rasterize_backward(const Inputs<T> &in, const Options &opt, Frames<T> &frames, const Outputs<T> &out,
                        const Cotangents<T> &grad, const Gradients<T> &result) {
  const ScratchPtr<T> scratch = take_scratch<T>(opt.threads);
  for (int camera = 0; camera < in.cameras; ++camera)
    kernels<T>(frames.level)
        .backward(in, camera, opt, *frames.cameras[camera], *scratch, out, grad, result, frames.stats);
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
  template void rasterize_backward(const Inputs<T> &, const Options &, Frames<T> &, const Outputs<T> &,                \
                                   const Cotangents<T> &, const Gradients<T> &);
INSTANTIATE(float)
INSTANTIATE(double)

}  // namespace perception

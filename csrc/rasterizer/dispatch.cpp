// Which SIMD level this processor has, and that level's kernels.
#include <initializer_list>

#include "rasterizer.h"

namespace perception {

#define DECLARE_LEVEL(level)                   \
  namespace level {                            \
  extern const Kernels<float> float_kernels;   \
  extern const Kernels<double> double_kernels; \
  }
DECLARE_LEVEL(baseline)
#ifdef __x86_64__
DECLARE_LEVEL(avx2)
DECLARE_LEVEL(avx512)
#endif

bool level_supported(Level level) {
  if (level == Level::baseline) return true;
#ifdef __x86_64__
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") && __builtin_cpu_supports("bmi") &&
                    __builtin_cpu_supports("bmi2") && __builtin_cpu_supports("popcnt");
  if (level == Level::avx2) return avx2;
  return avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
         __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl");
#else
  return false;
#endif
}

Level best_level() {
  for (Level level : {Level::avx512, Level::avx2})
    if (level_supported(level)) return level;
  return Level::baseline;
}

template <>
const Kernels<float> &kernels(Level level) {
#ifdef __x86_64__
  if (level == Level::avx512) return avx512::float_kernels;
  if (level == Level::avx2) return avx2::float_kernels;
#endif
  (void)level;
  return baseline::float_kernels;
}

template <>
const Kernels<double> &kernels(Level level) {
#ifdef __x86_64__
  if (level == Level::avx512) return avx512::double_kernels;
  if (level == Level::avx2) return avx2::double_kernels;
#endif
  (void)level;
  return baseline::double_kernels;
}

}  // namespace perception

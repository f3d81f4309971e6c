#include "levels.h"

#include <stdexcept>

namespace perception {
namespace {

constexpr struct {
  Level level;
  const char *name;
} kLevels[] = {{Level::avx512, "avx512"}, {Level::avx2, "avx2"}, {Level::baseline, "baseline"}};  // best first

}  // namespace

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

std::vector<std::string> level_names() {
  std::vector<std::string> names;
  for (const auto &l : kLevels)
    if (level_supported(l.level)) names.push_back(l.name);
  return names;
}

Level parse_level(const std::string &name) {
  for (const auto &l : kLevels) {
    if (name == "auto" && level_supported(l.level)) return l.level;
    if (name != l.name) continue;
    if (!level_supported(l.level)) throw std::invalid_argument("simd: this processor has no " + name);
    return l.level;
  }
  throw std::invalid_argument("simd: '" + name + "', expected auto, avx512, avx2 or baseline");
}

}  // namespace perception

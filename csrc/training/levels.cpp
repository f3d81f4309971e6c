#include "levels.h"

#include <stdexcept>
#include <type_traits>

namespace perception::training {

namespace base {
const Kernels<float> *table_float();
const Kernels<double> *table_double();
}  // namespace base
#ifdef PERCEPTION_X86
namespace avx2 {
const Kernels<float> *table_float();
const Kernels<double> *table_double();
}  // namespace avx2
namespace avx512 {
const Kernels<float> *table_float();
const Kernels<double> *table_double();
}  // namespace avx512
#endif

std::vector<std::string> supported_levels() {
  std::vector<std::string> levels = {"base"};
#ifdef PERCEPTION_X86
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) {
    levels.push_back("avx2");
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512bw"))
      levels.push_back("avx512");
  }
#endif
  return levels;
}

template <class T>
const Kernels<T> &kernels(const std::string &level) {
  static const std::vector<std::string> supported = supported_levels();
  const std::string &name = level == "auto" ? supported.back() : level;
  for (const std::string &candidate : supported) {
    if (candidate != name) continue;
#define PERCEPTION_TABLE(space) \
  if constexpr (std::is_same_v<T, float>) return *space::table_float(); else return *space::table_double();
#ifdef PERCEPTION_X86
    if (name == "avx512") { PERCEPTION_TABLE(avx512) }
    if (name == "avx2") { PERCEPTION_TABLE(avx2) }
#endif
    PERCEPTION_TABLE(base)
#undef PERCEPTION_TABLE
  }
  throw std::invalid_argument("level '" + level + "' is not supported by this processor; use \"auto\"");
}

template const Kernels<float> &kernels<float>(const std::string &);
template const Kernels<double> &kernels<double>(const std::string &);

}  // namespace perception::training

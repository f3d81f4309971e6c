#include <type_traits>

#include "../common/levels.h"
#include "kernels/table.h"
#include "training.h"

namespace perception::training {

PERCEPTION_DECLARE_LEVELS(extern const Kernels<float> float_kernels; extern const Kernels<double> double_kernels)

template <class T>
const Kernels<T> &kernels(Level level) {
  if constexpr (std::is_same_v<T, float>)
    return PERCEPTION_AT_LEVEL(level, float_kernels);
  else
    return baseline::double_kernels;  // the oracle of the float kernels, at one level
}

template const Kernels<float> &kernels(Level);
template const Kernels<double> &kernels(Level);

}  // namespace perception::training

// Compiled once per instruction set, see CMakeLists.txt.
#include "table.h"

#include "adam.h"
#include "exponential.h"
#include "instance.h"
#include "photometric.h"
#include "vector.h"

namespace perception::training::PERCEPTION_LEVEL {

template <class T>
constexpr Kernels<T> kTable = {photometric_tile<T>, absolute_row<T>,  accumulate<T>,    spread<T>, exponentials<T>,
                               logistics<T>,        sum_row<T, false>, sum_row<T, true>, adam<T>};

extern const Kernels<float> float_kernels;
const Kernels<float> float_kernels = kTable<float>;
#ifdef PERCEPTION_LEVEL_baseline
extern const Kernels<double> double_kernels;
const Kernels<double> double_kernels = kTable<double>;
#endif

}  // namespace perception::training::PERCEPTION_LEVEL

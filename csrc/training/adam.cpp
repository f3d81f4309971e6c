#include <cmath>

#include "../common/parallel.h"
#include "kernels/table.h"
#include "training.h"

namespace perception::training {

template <class T>
int64_t adam(const AdamArguments<T> &a, const Execution &execution) {
  const auto &table = kernels<T>(execution.level);
  const double correction1 = 1 - std::pow(a.beta1, double(a.step)), correction2 = 1 - std::pow(a.beta2, double(a.step));
  std::vector<T> rate(a.width);
  bool uniform = true;
  for (int64_t k = 0; k < a.width; ++k) {
    rate[k] = T(a.rate[k] / correction1);
    uniform = uniform && a.rate[k] == a.rate[0];
  }
  const AdamRows<T> rows{a.param,
                         a.first,
                         a.second,
                         a.grad,
                         a.visible,
                         rate.data(),
                         a.width,
                         T(a.beta1),
                         T(a.beta2),
                         T(a.eps),
                         T(1 / std::sqrt(correction2)),
                         uniform};
  const Pieces pieces(a.rows, std::max<int64_t>(256, 32768 / std::max<int64_t>(1, a.width)), 64);
  std::vector<int64_t> skipped(pieces.count);
  parallel_for(resolve_threads(execution.threads), pieces.count,
               [&](std::size_t i, int) { skipped[i] = table.adam(rows, pieces.begin(i), pieces.end(i)); });
  int64_t total = 0;
  for (int64_t of_piece : skipped) total += of_piece;
  return total;
}

template int64_t adam(const AdamArguments<float> &, const Execution &);
template int64_t adam(const AdamArguments<double> &, const Execution &);

}  // namespace perception::training

#include <cmath>

#include "../common/parallel.h"
#include "kernels/table.h"
#include "training.h"

namespace perception::training {

template <class T>
double sum(const T *values, int64_t n, bool squared, const Execution &execution) {
  const auto &table = kernels<T>(execution.level);
  const auto run = squared ? table.sum_squares : table.sum;
  const Pieces pieces(n, 65536);
  std::vector<double> partial(pieces.count);
  parallel_for(resolve_threads(execution.threads), pieces.count, [&](std::size_t i, int) {
    partial[i] = run(values + pieces.begin(i), pieces.end(i) - pieces.begin(i));
  });
  double total = 0;
  for (double part : partial) total += part;
  return total;
}

template <class T>
void scale(const T *values, int64_t n, double factor, T *out, const Execution &execution) {
  const Pieces pieces(n, 65536);
  const T f = T(factor);
  parallel_for(resolve_threads(execution.threads), pieces.count, [&](std::size_t piece, int) {
    const T *from = values + pieces.begin(piece);
    T *to = out + pieces.begin(piece);
    const int64_t m = pieces.end(piece) - pieces.begin(piece);
    for (int64_t i = 0; i < m; ++i) to[i] = f * from[i];
  });
}

template <class T>
void activate(const T *values, int64_t n, bool logistic, T *out, const Execution &execution) {
  const auto &table = kernels<T>(execution.level);
  const auto run = logistic ? table.logistics : table.exponentials;
  parallel_pieces(resolve_threads(execution.threads), Pieces(n, 32768),
                  [&](int64_t begin, int64_t end) { run(values + begin, end - begin, out + begin); });
}

void add_statistics(const StatisticsArguments &a, int threads) {
  parallel_pieces(resolve_threads(threads), Pieces(a.rows), [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      const float x = a.mean2d[2 * i], y = a.mean2d[2 * i + 1], here = a.visible[i] ? 1.f : 0.f;
      a.gradient[i] += here != 0 ? a.scale * std::sqrt(x * x + y * y) : 0.f;
      a.seen[i] += here;
    }
  });
}

template void scale(const float *, int64_t, double, float *, const Execution &);
template void scale(const double *, int64_t, double, double *, const Execution &);
template void activate(const float *, int64_t, bool, float *, const Execution &);
template void activate(const double *, int64_t, bool, double *, const Execution &);
template double sum(const float *, int64_t, bool, const Execution &);
template double sum(const double *, int64_t, bool, const Execution &);

}  // namespace perception::training

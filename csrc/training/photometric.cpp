#include <cmath>
#include <limits>
#include <memory>
#include <stdexcept>

#include "../common/parallel.h"
#include "kernels/table.h"
#include "training.h"

namespace perception::training {
namespace {

constexpr double kSigma = 1.5;

template <class T>
Photo<T> prepare(const PhotometricArguments<T> &a, double total_weight) {
  Photo<T> photo{a.render, a.target, a.target8, a.weight, a.gradient, a.height, a.width, a.channels, {}, T(0), T(0)};
  double window[kTaps], sum = 0;
  for (int k = 0; k < kTaps; ++k) sum += window[k] = std::exp(-0.5 * (k - kRadius) * (k - kRadius) / (kSigma * kSigma));
  for (int k = 0; k < kTaps; ++k) photo.window[k] = T(window[k] / sum);
  const double per_element = total_weight > 0 ? 1 / (total_weight * a.channels) : 0;
  photo.l1_scale = T((1 - a.beta) * per_element);
  photo.ssim_scale = T(-a.beta * per_element);
  return photo;
}

// Columns are cut so that a tile's rows fit the scratch, rows so that every thread has work; tiles are independent.
template <class T>
void run_tiles(const Photo<T> &photo, const Execution &execution, int strips, double *l1, double *ssim) {
  const auto &table = kernels<T>(execution.level);
  const int threads = resolve_threads(execution.threads);
  const int bands = std::max(1, std::min({threads, photo.height / 16, 64}));
  const int64_t tiles = int64_t(strips) * bands;
  std::vector<std::unique_ptr<T[]>> scratch(std::min<int64_t>(tiles, threads));
  for (auto &memory : scratch) memory.reset(new T[kPhotometricScratch]);
  auto cut = [](int64_t n, int64_t parts, int64_t i) { return static_cast<int>(n * i / parts); };
  parallel_for(threads, tiles, [&](std::size_t i, int worker) {
    const int64_t strip = i % strips, band = i / strips;
    const Tile tile{cut(photo.height, bands, band),  cut(photo.height, bands, band + 1),
                    cut(photo.width, strips, strip), cut(photo.width, strips, strip + 1),
                    l1 + strip * photo.height,       ssim + strip * photo.height};
    table.photometric_tile(photo, tile, scratch[worker].get());
  });
}

double ordered_sum(const std::vector<double> &values) {
  double total = 0;
  for (double value : values) total += value;
  return total;
}

}  // namespace

template <class T>
PhotometricResult photometric(const PhotometricArguments<T> &a, const Execution &execution) {
  if (a.height < 1 || a.width < 1 || a.channels < 1 || a.channels > kMaxChannels)
    throw std::invalid_argument("render: expected [H >= 1, W >= 1, 1 <= C <= 16]");
  const auto &table = kernels<T>(execution.level);
  const double total_weight =
      a.weight ? sum(a.weight, int64_t(a.height) * a.width, false, execution) : double(a.height) * a.width;
  const Photo<T> photo = prepare(a, total_weight);
  const double per_element = total_weight > 0 ? 1 / (total_weight * a.channels) : 0;
  if (a.beta == 0) {
    std::vector<double> l1(a.height);
    const Pieces rows(a.height, 16, 64);
    parallel_for(resolve_threads(execution.threads), rows.count, [&](std::size_t i, int) {
      for (int64_t r = rows.begin(i); r < rows.end(i); ++r) l1[r] = table.absolute_row(photo, static_cast<int>(r));
    });
    const double mean = ordered_sum(l1) * per_element;
    return {mean, mean, std::numeric_limits<double>::quiet_NaN()};
  }
  const int widest = kTileElements / a.channels - 4 * kRadius;
  const int strips = (a.width + widest - 1) / widest;
  std::vector<double> l1(int64_t(strips) * a.height), ssim(l1.size());
  run_tiles(photo, execution, strips, l1.data(), ssim.data());
  const double mean_l1 = ordered_sum(l1) * per_element, mean_ssim = ordered_sum(ssim) * per_element;
  const double dissimilarity = total_weight > 0 ? 1 - mean_ssim : 0;
  return {(1 - a.beta) * mean_l1 + a.beta * dissimilarity, mean_l1, mean_ssim};
}

template PhotometricResult photometric(const PhotometricArguments<float> &, const Execution &);
template PhotometricResult photometric(const PhotometricArguments<double> &, const Execution &);

}  // namespace perception::training

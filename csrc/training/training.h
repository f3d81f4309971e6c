// Losses with their gradients, and Adam. Every function gives the same bits for any number of threads.
// threads 0: as common/parallel.h says. Invalid arguments throw std::invalid_argument.
#pragma once
#include <cstdint>
#include <vector>

#include "../common/levels.h"

namespace perception::training {

struct Execution {
  int threads;
  Level level;
};

template <class T>
struct PhotometricArguments {
  const T *render;         // [height, width, channels]
  const T *target;         // same shape; null where target8 is not
  const uint8_t *target8;  // same shape, unit 1/255
  const T *weight;         // [height, width] >= 0 or null
  T *gradient;             // out [height, width, channels]: d loss / d render
  int height, width, channels;
  double beta;
};

struct PhotometricResult {
  double loss, l1, ssim;  // ssim is NaN when beta == 0: it is not computed
};

template <class T>
PhotometricResult photometric(const PhotometricArguments<T> &, const Execution &);

// Labels in use, ascending, and for every pixel the index of its label (-1 for label 0).
struct Assignment {
  std::vector<int32_t> ids;
  std::vector<int64_t> counts, first;  // pixels per label; first pixel of each label
};
Assignment assign(const int32_t *labels, int64_t pixels, int32_t *slots);

// A feature map F, and the index of each pixel's label, or -1.
template <class T>
struct LabelledFeatures {
  const T *features;     // [pixels, width]
  const int32_t *slots;  // [pixels]
  int64_t pixels, width;
};

// For each of `labels` labels the number of its pixels and the first of them (in), the mean of F over them and the sum
// of |F - mean|^2 (out).
struct Prototypes {
  int64_t labels;
  const int64_t *counts, *first;  // [labels]
  double *means, *scatter;        // [labels, width], [labels]
};
template <class T>
void prototypes(const LabelledFeatures<T> &, const Prototypes &, const Execution &);

// out [pixels, width] = pull[slot] (F - mean[slot]) + push[slot]; 0 for slot -1.
template <class T>
void spread(const LabelledFeatures<T> &, const double *means, const double *pull, const double *push, T *out,
            const Execution &);

// Mean over pairs i < j of relu(margin - |p_i - p_j|^2) of points [rows, width]; its gradient is written. No pair: 0.
double separation(const double *points, int64_t rows, int64_t width, double margin, double *gradient);

// Adds one view to the statistics of `rows` Gaussians, where visible: gradient += scale |mean2d|, seen += 1.
// mean2d [rows, 2], all others [rows].
struct StatisticsArguments {
  const float *mean2d;
  const uint8_t *visible;
  float *gradient, *seen;
  int64_t rows;
  float scale;
};
void add_statistics(const StatisticsArguments &, int threads);

template <class T>
double sum(const T *values, int64_t n, bool squared, const Execution &);

// out = factor values; out may be values.
template <class T>
void scale(const T *values, int64_t n, double factor, T *out, const Execution &);

// out = exp(values), or 1 / (1 + exp(-values)), where values beyond +-80 count as those.
template <class T>
void activate(const T *values, int64_t n, bool logistic, T *out, const Execution &);

template <class T>
struct AdamArguments {
  T *param, *first, *second;  // [rows, width], in place
  const T *grad;              // [rows, width]
  const uint8_t *visible;     // [rows] or null
  const double *rate;         // [width]
  int64_t rows, width, step;  // step counts from 1
  double beta1, beta2, eps;
};

// Returns the number of rows skipped for a gradient that is not finite.
template <class T>
int64_t adam(const AdamArguments<T> &, const Execution &);

}  // namespace perception::training

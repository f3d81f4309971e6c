#include "neighborhood.h"

#include <algorithm>
#include <cmath>

#include "../common/parallel.h"

namespace perception::graph {
namespace {

struct Symmetric {
  double m[3][3];
};

// Cyclic Jacobi on a 3x3 symmetric matrix: eigenvalues on the diagonal, eigenvectors in the columns of v.
void diagonalize(Symmetric &s, double v[3][3]) {
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) v[i][j] = i == j;
  }
  const double scale = s.m[0][0] + s.m[1][1] + s.m[2][2];
  for (int sweep = 0; sweep < 12; ++sweep) {
    if (std::abs(s.m[0][1]) + std::abs(s.m[0][2]) + std::abs(s.m[1][2]) <= 1e-15 * scale) return;
    for (int p = 0; p < 2; ++p) {
      for (int q = p + 1; q < 3; ++q) {
        if (s.m[p][q] == 0) continue;
        const double theta = (s.m[q][q] - s.m[p][p]) / (2 * s.m[p][q]);
        const double t = (theta < 0 ? -1 : 1) / (std::abs(theta) + std::sqrt(theta * theta + 1));
        const double c = 1 / std::sqrt(t * t + 1), n = t * c;
        for (int i = 0; i < 3; ++i) {  // A <- A J, then A <- J' A
          const double a = s.m[i][p], b = s.m[i][q];
          s.m[i][p] = c * a - n * b;
          s.m[i][q] = n * a + c * b;
        }
        for (int i = 0; i < 3; ++i) {
          const double a = s.m[p][i], b = s.m[q][i];
          s.m[p][i] = c * a - n * b;
          s.m[q][i] = n * a + c * b;
          const double x = v[i][p], y = v[i][q];
          v[i][p] = c * x - n * y;
          v[i][q] = n * x + c * y;
        }
      }
    }
  }
}

void plane_normal(const float *points, const std::int32_t *list, std::size_t k, float out[3]) {
  out[0] = out[1] = out[2] = 0.f;
  double mean[3] = {};
  std::size_t used = 0;
  for (std::size_t j = 0; j < k; ++j) {
    if (list[j] < 0) continue;
    for (int a = 0; a < 3; ++a) mean[a] += points[3 * static_cast<std::size_t>(list[j]) + a];
    ++used;
  }
  if (used < 3) return;
  for (double &x : mean) x /= static_cast<double>(used);
  Symmetric s{};
  for (std::size_t j = 0; j < k; ++j) {
    if (list[j] < 0) continue;
    double d[3];
    for (int a = 0; a < 3; ++a) d[a] = points[3 * static_cast<std::size_t>(list[j]) + a] - mean[a];
    for (int a = 0; a < 3; ++a) {
      for (int b = 0; b < 3; ++b) s.m[a][b] += d[a] * d[b];
    }
  }
  double v[3][3];
  diagonalize(s, v);
  int order[3] = {0, 1, 2};
  std::sort(order, order + 3, [&s](int a, int b) { return s.m[a][a] < s.m[b][b]; });
  if (s.m[order[1]][order[1]] <= 1e-10 * s.m[order[2]][order[2]]) return;  // a point or a line has no plane
  for (int a = 0; a < 3; ++a) out[a] = static_cast<float>(v[a][order[0]]);
}

}  // namespace

std::size_t undirected(const std::int32_t *neighbors, std::size_t count, std::size_t k, std::int32_t *edges) {
  std::size_t found = 0;
  for (std::size_t i = 0; i < count; ++i) {
    const auto a = static_cast<std::int32_t>(i);
    for (std::size_t j = 0; j < k; ++j) {
      const std::int32_t b = neighbors[i * k + j];
      if (b < 0 || b == a) continue;
      const std::int32_t *list = neighbors + static_cast<std::size_t>(b) * k;
      if (b < a && std::find(list, list + k, a) != list + k) continue;  // written already, from the list of b
      edges[2 * found] = std::min(a, b);
      edges[2 * found + 1] = std::max(a, b);
      ++found;
    }
  }
  return found;
}

void plane_normals(const float *points, const std::int32_t *neighbors, std::size_t count, std::size_t k, int threads,
                   float *normals) {
  parallel_pieces(threads, Pieces(count, 1024, 256), [&](std::size_t begin, std::size_t end) {
    for (std::size_t i = begin; i < end; ++i) plane_normal(points, neighbors + i * k, k, normals + 3 * i);
  });
}

}  // namespace perception::graph

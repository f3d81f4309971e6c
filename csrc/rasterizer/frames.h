#pragma once
#include <vector>

#include "rasterizer.h"

namespace perception {

template <class T>
struct Frames {
  std::vector<std::unique_ptr<Frame<T>>> cameras;
  Level level;
  int64_t n;  // Gaussians, and pixels of the images, as a backward call must have them too
  int width, height;
  Stats stats;  // over all cameras and all calls on these frames
};

}  // namespace perception

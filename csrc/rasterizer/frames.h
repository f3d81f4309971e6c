#pragma once
#include <vector>

#include "rasterizer.h"

namespace perception {

template <class T>
struct Frames {
  std::vector<std::unique_ptr<Frame<T>>> cameras;
  Level level;
  Stats stats;  // over all cameras and all calls on these frames
};

}  // namespace perception

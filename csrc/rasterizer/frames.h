#pragma once
#include <vector>

#include "rasterizer.h"

namespace perception {

template <class T>
struct Frames {
  std::vector<std::unique_ptr<Frame<T>>> cameras;
  Level level;
};

}  // namespace perception

// Which set of inner loops to use on this processor.
#pragma once
#include <string>
#include <vector>

#include "kernels/table.h"

namespace perception::training {

std::vector<std::string> supported_levels();  // narrowest first

// level: "auto" for the widest supported, or a name from supported_levels(). Throws std::invalid_argument.
template <class T>
const Kernels<T> &kernels(const std::string &level);

}  // namespace perception::training

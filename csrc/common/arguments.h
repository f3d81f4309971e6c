// Checks that every binding shares.
#pragma once
#include <nanobind/ndarray.h>

#include <cstdint>
#include <optional>
#include <stdexcept>
#include <string>

namespace perception {

// Numbers of 4 or 8 bytes must lie at multiples of their size: compiled loops rely on it, numpy's views may not.
template <class... Parameters>
void require_aligned(const char *name, const nanobind::ndarray<Parameters...> &array) {
  const std::size_t size = (array.dtype().bits + 7) / 8;
  if (array.size() && reinterpret_cast<std::uintptr_t>(array.data()) % size)
    throw std::invalid_argument(std::string(name) + ": its numbers are not aligned in memory; pass a copy");
}

template <class Array>
void require_aligned(const char *name, const std::optional<Array> &array) {
  if (array) require_aligned(name, *array);
}

// require_aligned("a", a, "b", b, ...)
template <class First, class... Rest>
void require_aligned(const char *name, const First &first, const char *next, const Rest &...rest) {
  require_aligned(name, first);
  require_aligned(next, rest...);
}

}  // namespace perception

// Memory that grows and never initialises or shrinks: reused from call to call.
#pragma once
#include <cstddef>
#include <cstdlib>
#include <new>
#include <utility>

namespace perception {

// Frees `old` and returns memory for bytes at a multiple of 64, its content undefined. Throws std::bad_alloc.
void *renew(void *old, std::size_t bytes);

template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(Buffer &&o) noexcept : data_(std::exchange(o.data_, nullptr)), capacity_(std::exchange(o.capacity_, 0)) {}
  Buffer &operator=(Buffer &&o) noexcept {
    std::swap(data_, o.data_);
    std::swap(capacity_, o.capacity_);
    return *this;
  }
  ~Buffer() { std::free(data_); }

  // At least n elements; what was there is lost when it grows.
  __attribute__((always_inline)) T *reserve(std::size_t n) {
    if (n > capacity_) {
      const std::size_t grown = n + n / 4 + 16;
      capacity_ = 0;
      data_ = static_cast<T *>(renew(std::exchange(data_, nullptr), grown * sizeof(T)));
      capacity_ = grown;
    }
    return data_;
  }
  T *data() const { return data_; }
  T &operator[](std::size_t i) const { return data_[i]; }
  std::size_t capacity() const { return capacity_; }

 private:
  T *data_ = nullptr;
  std::size_t capacity_ = 0;
};

}  // namespace perception

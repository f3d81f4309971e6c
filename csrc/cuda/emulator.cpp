// kernels.cu on the CPU, behind the functions of the CUDA driver that perception/rasterizer/cuda/launch.py calls: for
// tests. Calls are synchronous, and one process runs one at a time.
#include "kernels.cu"

#include <map>
#include <string>

namespace {

using Kernel = std::function<void(void **)>;

template <class... A, std::size_t... I>
void call(void (*kernel)(A...), void **arguments, std::index_sequence<I...>) {
  kernel(*static_cast<A *>(arguments[I])...);
}
template <class... A>
Kernel taking_pointers(void (*kernel)(A...)) {
  return [kernel](void **arguments) { call(kernel, arguments, std::index_sequence_for<A...>()); };
}

std::map<std::string, Kernel> kernels = {
    {"project_kernel", taking_pointers(perception::project_kernel)},
    {"count_kernel", taking_pointers(perception::count_kernel)},
    {"emit_kernel", taking_pointers(perception::emit_kernel)},
    {"forward_kernel", taking_pointers(perception::forward_kernel)},
    {"backward_kernel", taking_pointers(perception::backward_kernel)},
    {"reduce_kernel", taking_pointers(perception::reduce_kernel)},
    {"prototype_parts_kernel", taking_pointers(perception::prototype_parts_kernel)},
    {"prototype_kernel", taking_pointers(perception::prototype_kernel)},
    {"spread_kernel", taking_pointers(perception::spread_kernel)},
    {"separation_kernel", taking_pointers(perception::separation_kernel)},
    {"adam_kernel", taking_pointers(perception::adam_kernel)},
    {"ssim_kernel", taking_pointers(perception::ssim_kernel)},
    {"photometric_kernel", taking_pointers(perception::photometric_kernel)},
};
uint64_t lane_order = 0;
char module;
enum Result { kSuccess = 0, kInvalidImage = 200, kNotFound = 500, kLaunchFailed = 719 };

}  // namespace

extern "C" {
void emulator_lane_order(uint64_t order) { lane_order = order; }
void emulator_memory(uint64_t begin, uint64_t bytes) { emulation::give_memory(begin, begin + bytes); }
int emulator_struct_size(int which) {
  using namespace perception;
  const int sizes[] = {sizeof(Scene),  sizeof(Projection), sizeof(Strip),    sizeof(Lists),
                       sizeof(Images), sizeof(Cotangents), sizeof(Gradients),  sizeof(AdamRows),
                       sizeof(Photo),  sizeof(Masks),      sizeof(Pairs)};
  return sizes[which];
}

int cuGetErrorString(int code, const char **text) {
  *text = code == kLaunchFailed   ? emulation::error
          : code == kInvalidImage ? "device kernel image is invalid"
                                  : "not found";
  return kSuccess;
}
int cuModuleLoadData(void **out, const char *image) {
  *out = &module;
  return std::memcmp(image,
                     "\x7f"
                     "ELF",
                     4)
             ? kInvalidImage
             : kSuccess;
}
int cuModuleGetFunction(void **function, void *, const char *name) {
  const auto found = kernels.find(name);
  if (found == kernels.end()) return kNotFound;
  *function = &found->second;
  return kSuccess;
}
int cuLaunchKernel(void *function, unsigned grid, unsigned, unsigned, unsigned threads, unsigned, unsigned, unsigned,
                   void *, void **arguments, void **) {
  return emulation::run(grid, threads, lane_order, [&] { (*static_cast<Kernel *>(function))(arguments); })
             ? kSuccess
             : kLaunchFailed;
}
}

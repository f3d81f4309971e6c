// The one SIMD dispatcher. A component's kernels are one source, compiled once per level into the namespace of the
// level's name (CMake's add_level_objects defines PERCEPTION_LEVEL); which of them runs is decided here at run time.
//
// What a level's object file emits outside its own namespace could be merged by the linker with the same function of
// another level and then run on a processor without the instructions: headers that kernels include hold templates on
// plain data, always inlined, or lie in the level's namespace (csrc/build_inplace.sh checks the object files).
#pragma once
#include <string>
#include <vector>

namespace perception {

enum class Level { baseline, avx2, avx512 };

bool level_supported(Level);
std::vector<std::string> level_names();  // of this processor, best first

// "auto" is the best level. Throws std::invalid_argument for an unknown name and for a level the processor lacks.
Level parse_level(const std::string &name);

// PERCEPTION_DECLARE_LEVELS(declaration): the declaration in every level's namespace.
// PERCEPTION_AT_LEVEL(level, name): the `name` of that level's namespace.
#ifdef __x86_64__
#define PERCEPTION_DECLARE_LEVELS(...) \
  namespace baseline {                 \
  __VA_ARGS__;                         \
  }                                    \
  namespace avx2 {                     \
  __VA_ARGS__;                         \
  }                                    \
  namespace avx512 {                   \
  __VA_ARGS__;                         \
  }
#define PERCEPTION_AT_LEVEL(level, name) \
  ((level) == Level::avx512 ? avx512::name : (level) == Level::avx2 ? avx2::name : baseline::name)
#else
#define PERCEPTION_DECLARE_LEVELS(...) \
  namespace baseline {                 \
  __VA_ARGS__;                         \
  }
#define PERCEPTION_AT_LEVEL(level, name) (static_cast<void>(level), baseline::name)
#endif

}  // namespace perception

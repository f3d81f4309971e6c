// The rasterizer's kernels: project -> sort by depth -> count -> prefix sum -> emit -> stable sort by tile -> forward
// -> backward -> reduce. The sorts and the prefix sum are torch's. And those of a training step. No atomic operation on floating-point numbers: every
// sum has one order, so the bits of images and gradients do not depend on timing.
#include "backward.h"
#include "forward.h"
#include "instances.h"
#include "prepare.h"
#include "reduce.h"
#include "training.h"

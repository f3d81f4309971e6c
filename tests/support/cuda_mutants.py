"""Slips in the CUDA kernels that their tests must notice: removed barriers, wrong indices and bounds."""

from __future__ import annotations

import torch

from support.cuda_emulator import emulate, wide_scene, worst
from support.rasterizer import grads_and_images

BARRIERS = [
    ("    if (!__syncthreads_or(open)) break;  // also: the last batch has been read\n", ""),
    (
        """% kFeatures];
    __syncthreads();
    for (int first""",
        """% kFeatures];
    for (int first""",
    ),
    ("threadIdx.x];\n  __syncthreads();\n  WarpMemory", "threadIdx.x];\n  WarpMemory"),
    ("    if (!__syncthreads_or(open)) break;  // also: the last group's sums have been read\n", ""),
    ("shift[i % kFeatures];\n    __syncthreads();", "shift[i % kFeatures];"),
    ("      __syncwarp();\n      sum_pixels", "      sum_pixels"),
    ("p, memory, sums);\n      __syncwarp();", "p, memory, sums);"),
    ("memory.touched = touched;\n    __syncthreads();", "memory.touched = touched;"),
]
TRAINING_BARRIERS = [
    ("target_at(photo, at);\n    }\n    __syncthreads();", "target_at(photo, at);\n    }"),
    ("rows[3][i] = product;\n    }\n    __syncthreads();", "rows[3][i] = product;\n    }"),
    ("half /= 2) {\n    __syncthreads();", "half /= 2) {"),
    ("photo.slopes[j * plane + at];\n    }\n    __syncthreads();", "photo.slopes[j * plane + at];\n    }"),
    ("rows[j][i] = sum;\n      }\n    __syncthreads();", "rows[j][i] = sum;\n      }"),
    ("    __syncthreads();  // the sums have been read\n", ""),
]
SLIPS = [
    ("strip.ends[rank - 1] : 0, tiles, ids", "strip.ends[rank] : 0, tiles, ids"),
    ("k % box.width, y = box.y0 + k / box.width", "k / box.width, y = box.y0 + k % box.width"),
    ("__popc(hits & ((1u << lane) - 1))", "__popc(hits & ((2u << lane) - 1))"),
    ("first < box.count; first += kWarp", "first + kWarp <= box.count; first += kWarp"),
    ("(y - strip.first_row) * strip.tiles_x + x", "(y - strip.first_row) + x * strip.tiles_x"),
    ("p.warp / 2 * kGranuleHeight", "p.warp / 2 * kGranuleWidth"),
    ("p.lane % kGranuleWidth, y = y0 + p.lane / kGranuleWidth", "p.lane / 4, y = y0 + p.lane % 4"),
    ("const int mine = first + p.lane;", "const int mine = p.lane;"),
    ("open = b.next >= kMinTransmittance<T>;", "open = transmittance >= kMinTransmittance<T>;"),
    ("i < first + kPixels; ++i", "i < first + kPixels - 1; ++i"),
    ("first = p.lane / kGroup * kPixels", "first = p.lane % kParts * kPixels"),
    ("step = kGroup; step < kWarp; step *= 2", "step = kGroup; step < kWarp / 2; step *= 2"),
    ("i / kGranuleWidth);", "i % kGranuleWidth);"),
    ("lists.slots[at + i / kRecord] * kRecord", "(at + i / kRecord) * kRecord"),
    ("b.raw > kMaxAlpha<T> ? T(0)", "b.raw > 2 ? T(0)"),
    ("squares += sums[c + NF]", "squares += sums[c]"),
    ("first + lane, last, kWarp, part", "first + lane + 1, last, kWarp, part"),
    ("if (lane == owner) sum[c] = part[c];", "if (lane == 0) sum[c] = part[c];"),
    ("s.rgb[c] > 0 ? g_rgb[c]", "s.rgb[c] > 1 ? g_rgb[c]"),
    ("const Index at = i * scene.dims + c;", "const Index at = rank * scene.dims + c;"),
    ("add(out.camera, i, g_camera, 12, fresh)", "add(out.camera, rank, g_mean, 3, fresh)"),
]  # fmt: skip


def mutant_scene(dims=3):
    """Tiles with more than a batch of splats, Gaussians with many tiles, clamped alphas and colours."""
    inputs = wide_scene(n=400, width=100, height=70, dims=dims, sh_degree=1)
    inputs["Ks"] = torch.tensor([[[80.0, 0, 53.0], [0, 87.0, 30.0], [0, 0, 1]]], dtype=torch.float64)
    inputs["opacities"] *= 0.4
    inputs["opacities"][::7] = 1.0
    return inputs


def is_noticed(*edits):
    """Whether the emulator refuses them, or images or gradients differ from the CPU's."""
    inputs = mutant_scene()
    try:
        found = emulate(inputs, edits=edits)
    except RuntimeError as error:
        return "CUDA error 719" in str(error)
    return worst(found, grads_and_images(inputs)) > 1e-9

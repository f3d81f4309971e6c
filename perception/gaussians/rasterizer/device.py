"""The host side of csrc/cuda: the same two passes as the CPU's, on tensors of one device.

Sums are always made in the same order. `Settings.max_records` limits the memory: an image with more pairs of a Gaussian
and a tile of 16 × 16 pixels is computed in strips of tile rows. Their gradients are added, which rounds differently.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from perception.errors import InputError
from perception.gaussians.cuda.compile import MAX_FEATURES, KernelOptions
from perception.gaussians.cuda.launch import THREADS, Kernels, device_kernels
from perception.gaussians.rasterize import Forward, Settings

_POINTER = ctypes.c_void_p
KernelsFor = Callable[[KernelOptions, torch.device], Kernels]
_TILE, _SPLAT, _MOMENTS = 16, 12, 10  # as in device.h: pixels, numbers of a splat, of a record before its features
_NAMES = ("means", "quats", "scales", "opacities", "colors", "features", "viewmats", "Ks", "background")
_MAX_RECORDS = 1 << 24  # with eight feature channels 1.2 GB of records, and 0.4 GB of lists
_AT_ONCE = 64
_NO_LABEL = np.iinfo(np.int32).max
"""Labels whose weights are rendered at once, and a label beyond all others."""


def _structure(name: str, pointers: str, numbers: str = "", reals: str = "", real: Any = ctypes.c_float) -> Any:
    """A struct of device.h: pointers first, then ints, then reals."""
    kinds = [(pointers, _POINTER), (numbers, ctypes.c_int), (reals, real)]
    return type(name, (ctypes.Structure,), {"_fields_": [(n, kind) for names, kind in kinds for n in names.split()]})


_SCENE = (
    "means quats scales opacities colors features viewmat K background",
    "n sh_degree sh_stride dims width height",
    "near_plane eps2d",
)
_REALS = {torch.float32: ctypes.c_float, torch.float64: ctypes.c_double}
SCENES = {dtype: _structure("Scene", *_SCENE, real) for dtype, real in _REALS.items()}
PROJECTION = _structure("Projection", "splats boxes depths radii first_bad")
STRIP = _structure("Strip", "splats boxes front_to_back ends", "n first_row end_row tiles_x")
LISTS = _structure("Lists", "ids slots starts")
IMAGES = _structure("Images", "colors alphas depths features variance visible")
COTANGENTS = _structure("Cotangents", "colors alphas depths features variance")
GRADIENTS = _structure("Gradients", "means quats scales opacities colors features camera mean2d")


def _filled(structure: Any, *values: Tensor | int | float | None) -> Any:
    """A struct of the values in its order, or a pointer; a tensor gives its address."""
    return structure(*[value.data_ptr() if isinstance(value, Tensor) else value for value in values])


@dataclass
class _Strip:
    """Tile rows of one camera and the lists of their splats: Strip and Lists of device.h."""

    tiles: int
    range: Any
    lists: Any
    slots: Tensor
    kept: tuple[Tensor, ...]  # whose addresses the structs hold


@dataclass
class Frames:
    """What a forward call keeps for its backward call: the strips of each camera, from top to bottom."""

    views: list[list[_Strip]]
    visible: Tensor
    kernels_for: KernelsFor
    evaluated = contributing = 0  # pairs and seconds are not counted on a device
    seconds: ClassVar[dict[str, float]] = {}


class _Call:
    """The arguments of one call."""

    def __init__(
        self, inputs: tuple[Tensor | None, ...], background: Tensor | None, settings: Settings, kernels_for: KernelsFor
    ):
        assert inputs[0] is not None  # for the type checker
        self.inputs, self.background, self.settings, self._kernels_for = inputs, background, settings, kernels_for
        self.means, features = inputs[0], inputs[5]
        self.n, self.dims = len(self.means), 0 if features is None else features.shape[1]
        self.blocks = (self.n + THREADS - 1) // THREADS
        self.tiles_x, self.tiles_y = ((size + _TILE - 1) // _TILE for size in (settings.width, settings.height))
        self.slices = range(0, max(self.dims, 1), MAX_FEATURES)  # of the feature channels, by the first of each

    def kernels(self, begin: int) -> Kernels:
        """Those for the slice of the feature channels that starts at `begin`."""
        s, width = self.settings, min(self.dims - begin, MAX_FEATURES)
        double = self.means.dtype == torch.float64
        options = KernelOptions(width, s.variance and width > 0, s.depth and begin == 0, double)
        return self._kernels_for(options, self.means.device)

    def scene(self, camera: int, begin: int = 0) -> Any:
        means, quats, scales, opacities, colors, features, viewmats, ks = self.inputs
        assert colors is not None and viewmats is not None and ks is not None  # for the type checker
        s = self.settings
        return _filled(
            SCENES[self.means.dtype],
            means, quats, scales, opacities, colors, None if features is None else features[:, begin:],
            viewmats[camera], ks[camera], None if self.background is None else self.background[camera],
            self.n, s.sh_degree, colors.shape[1] if s.sh_degree >= 0 else 0, self.dims, s.width, s.height,
            s.near_plane, s.eps2d,
        )  # fmt: skip

    def project(self, camera: int, radii: Tensor) -> list[_Strip]:
        """Projects all Gaussians and lists those of every tile. InputError names a value that is not finite."""
        new = self.means.new_empty
        splats, boxes = new((self.n, _SPLAT)), new((self.n, 4), dtype=torch.int32)
        depths = self.means.new_full((self.n,), torch.inf)
        first_bad = self.means.new_full((1,), self.n, dtype=torch.int32)
        projection = _filled(PROJECTION, splats, boxes, depths, radii, first_bad)
        self.kernels(0).launch("project_kernel", self.blocks, self.scene(camera), projection)
        front_to_back = torch.sort(depths, stable=True).indices.to(torch.int32)
        return self._strips((splats, boxes, front_to_back), first_bad, 0, self.tiles_y)

    def _strips(self, view: tuple[Tensor, ...], first_bad: Tensor, first: int, end: int) -> list[_Strip]:
        """The lists of tile rows [first, end), in halves while they have too many pairs."""
        kernels, numbers = self.kernels(0), (self.n, first, end, self.tiles_x)
        counts = self.means.new_empty((self.n,), dtype=torch.int32)
        kernels.launch("count_kernel", self.blocks, _filled(STRIP, *view, None, *numbers), _filled(_POINTER, counts))
        ends = counts.cumsum(0)
        total, bad = torch.cat([ends[-1:], first_bad]).tolist() if self.n else (0, 0)  # waits for the device
        if bad < self.n:
            self._refuse(bad)
        if total > (self.settings.max_records or _MAX_RECORDS) and end - first > 1:
            middle = (first + end) // 2
            halves = (first, middle), (middle, end)
            return [strip for half in halves for strip in self._strips(view, first_bad, *half)]
        tiles = self.means.new_empty((total,), dtype=torch.int32)
        ids, strip = torch.empty_like(tiles), _filled(STRIP, *view, ends, *numbers)
        kernels.launch("emit_kernel", self.blocks, strip, _filled(_POINTER, tiles), _filled(_POINTER, ids))
        count = (end - first) * self.tiles_x
        if count < 1 << 15:
            tiles = tiles.to(torch.int16)  # half the passes of a radix sort
        tiles, slots = torch.sort(tiles, stable=True)
        starts = torch.searchsorted(tiles, torch.arange(count + 1, dtype=tiles.dtype, device=tiles.device))
        lists = (ids[slots], slots, starts)
        return [_Strip(count, strip, _filled(LISTS, *lists), slots, (*view, ends, *lists))]

    def _refuse(self, index: int) -> None:
        """InputError for Gaussian `index`, or for a camera with -1."""
        arguments = list(zip(_NAMES, (*self.inputs, self.background), strict=True))
        for name, tensor in arguments[6:] if index < 0 else arguments[:6]:
            if tensor is None:
                continue
            wrong = (~tensor.isfinite().view(len(tensor), tensor[0].numel()).all(1)).nonzero()[:, 0].tolist()
            if wrong and (index < 0 or wrong[0] == index):
                raise InputError(f"rasterize: {name}[{wrong[0]}] is not finite")


def _of(camera: int, begin: int, images: tuple[Tensor | None, ...]) -> list[Tensor | None]:
    """One camera's colours, alphas, depths (which belong to the first slice), features and variance."""
    mine = [None if image is None else image[camera] for image in images]
    return [*(mine[:3] if begin == 0 else [None] * 3), *(None if i is None else i[..., begin:] for i in mine[3:])]


def rasterize_forward(
    inputs: tuple[Tensor | None, ...],
    background: Tensor | None,
    settings: Settings,
    kernels_for: KernelsFor = device_kernels,
) -> Forward:
    """As `perception.gaussians.rasterize.rasterize_forward`, on the tensors' device."""
    call, out = _Call(inputs, background, settings, kernels_for), Forward.empty(inputs, settings)
    out.frames = Frames([call.project(c, radii) for c, radii in enumerate(out.radii)], out.visible, kernels_for)
    images = (out.colors, out.alphas, out.depths, out.features, out.feature_variance)
    for camera, strips in enumerate(out.frames.views):
        for begin in call.slices:
            kernels, scene = call.kernels(begin), call.scene(camera, begin)
            written = _filled(IMAGES, *_of(camera, begin, images), out.visible[camera] if begin == 0 else None)
            for strip in strips:
                kernels.launch("forward_kernel", strip.tiles, scene, strip.range, strip.lists, written)
    return out


def rasterize_backward(
    inputs: tuple[Tensor | None, ...],
    background: Tensor | None,
    settings: Settings,
    forward: Forward,
    cotangents: tuple[Tensor | None, ...],
    wanted: tuple[bool, ...],
    stored: list[Tensor | None] | None = None,
) -> list[Tensor | None]:
    """As `perception.gaussians.rasterize.rasterize_backward`, on the tensors' device; `stored` is written whole."""
    frames: Frames = forward.frames
    call, count = _Call(inputs, background, settings, frames.kernels_for), len(frames.views)
    mean2d = stored[7] if stored else None
    mean2d = call.means.new_zeros((count, call.n, 2)) if mean2d is None else mean2d.zero_()
    if stored:
        grads = [None if buffer is None else buffer.zero_() for buffer in stored[:7]]
    else:
        grads = [
            torch.zeros_like(t, memory_format=torch.contiguous_format) if t is not None and w else None
            for t, w in zip(inputs[:7], wanted, strict=True)
        ]
    features, viewmats = grads[5:]
    cameras = None if viewmats is None else call.means.new_zeros((count, call.n, 12))
    rendered = forward.features
    if rendered is None and call.dims:  # the forward pass had no features: these are zeros, wanted for their gradient
        rendered = call.means.new_zeros((*forward.alphas.shape, call.dims))
    images = (forward.colors, forward.alphas, forward.depths, rendered, forward.feature_variance)
    given = tuple(None if g is None else g.contiguous() for g in cotangents)
    for camera, strips in enumerate(frames.views):
        visible, of_camera = frames.visible[camera], None if cameras is None else cameras[camera]
        for begin in call.slices:
            kernels, scene = call.kernels(begin), call.scene(camera, begin)
            colors, _, *others = _of(camera, begin, images)
            read = _filled(IMAGES, colors, forward.alphas[camera], *others, visible)
            cotangent = _filled(COTANGENTS, *_of(camera, begin, given))
            of_features = None if features is None else features[:, begin:]
            added = _filled(GRADIENTS, *grads[:5], of_features, of_camera, mean2d[camera])
            width = _MOMENTS + min(call.dims - begin, MAX_FEATURES)
            for strip in strips:
                records = call.means.new_zeros((len(strip.slots), width))
                at = _filled(_POINTER, records)
                kernels.launch("backward_kernel", strip.tiles, scene, strip.range, strip.lists, read, cotangent, at)
                kernels.launch("reduce_kernel", call.blocks, scene, strip.range, _filled(_POINTER, visible), at, added)
    if cameras is not None and viewmats is not None:
        total = cameras.sum(1, dtype=torch.float64).to(cameras.dtype)
        viewmats[:, :3, :3] += total[:, :9].reshape(-1, 3, 3)
        viewmats[:, :3, 3] += total[:, 9:]
    if stored:  # with respect to logarithms and logits
        for gradient, value, slope in zip(grads[2:4], inputs[2:4], (lambda s: s, lambda o: o * (1 - o)), strict=True):
            if gradient is not None and value is not None:
                gradient.mul_(slope(value))
    return [*grads, None if [index for index, w in enumerate(wanted) if w] == [5] else mean2d]


def label_images(
    inputs: tuple[Tensor | None, ...], labels: np.ndarray, least: float, settings: Settings
) -> tuple[np.ndarray, np.ndarray]:
    """As `perception.gaussians.rasterize.label_images`: the weights of _AT_ONCE labels are rendered as features."""
    viewmats = inputs[6]
    assert viewmats is not None  # for the type checker
    settings = replace(settings, variance=False, depth=False)
    visible = rasterize_forward((*inputs[:5], None, *inputs[6:]), None, settings).visible[0].cpu().numpy().view(bool)
    images = []
    for row in labels:
        names = torch.from_numpy(np.unique(row[visible & (row >= 0)])).to(viewmats.device)
        of = torch.from_numpy(np.ascontiguousarray(row)).to(viewmats.device)
        best = viewmats.new_full((settings.height, settings.width), least)
        image = torch.full_like(best, -1, dtype=torch.int32)
        for some in names.split(_AT_ONCE) if len(names) else ():
            features = (of[:, None] == some).to(best.dtype)
            weights = rasterize_forward((*inputs[:5], features, *inputs[6:]), None, settings).features
            assert weights is not None  # for the type checker
            most = weights[0].amax(dim=2)
            first = torch.where(weights[0] == most[..., None], some, _NO_LABEL).amin(dim=2)  # of equal ones the smaller
            image, best = torch.where(most > best, first, image), torch.maximum(most, best)
        images.append(image.cpu().numpy())
    return np.stack(images), visible

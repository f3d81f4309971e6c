"""The host side of csrc/cuda: the same two passes as the CPU's, on tensors of one device.

Sums are always made in the same order. `Settings.max_records` limits the memory: an image with more pairs of a Gaussian
and a tile of 16 × 16 pixels is computed in strips of tile rows. Their gradients are added, which rounds differently.
"""

from __future__ import annotations

import ctypes
import functools
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from perception.errors import InputError
from perception.rasterizer.cuda.kernels import MAX_FEATURES, THREADS, KernelOptions, Kernels, device_kernels
from perception.rasterizer.types import Cotangents, Forward, Gradients, Inputs, Settings

_POINTER = ctypes.c_void_p
TILE, _SPLAT, _MOMENTS = 16, 12, 12  # as in device.h: pixels, numbers of a splat, of a record before its features
_GAUSSIANS = ("means", "quats", "scales", "opacities", "colors", "features")
_CAMERAS = ("viewmats", "Ks", "background")
_MAX_RECORDS = 1 << 24  # with eight feature channels 1.2 GB of records, and 0.4 GB of lists
_AT_ONCE = 64  # labels whose weights are rendered at once
_NO_LABEL = np.iinfo(np.int32).max  # beyond all labels


def structure(name: str, pointers: str, numbers: str = "", reals: str = "", real: Any = ctypes.c_float) -> Any:
    """A struct of the kernels: pointers first, then ints, then reals."""
    kinds = [(pointers, _POINTER), (numbers, ctypes.c_int), (reals, real)]
    return type(name, (ctypes.Structure,), {"_fields_": [(n, kind) for names, kind in kinds for n in names.split()]})


def structures(name: str, pointers: str, numbers: str, reals: str) -> dict[torch.dtype, Any]:
    """The struct for each type of the kernels' real numbers."""
    kinds = {torch.float32: ctypes.c_float, torch.float64: ctypes.c_double}
    return {dtype: structure(name, pointers, numbers, reals, real) for dtype, real in kinds.items()}


SCENES = structures(
    "Scene",
    "means quats scales opacities colors features viewmat K background",
    "n sh_degree sh_stride dims width height",
    "near_plane eps2d",
)
PROJECTION = structure("Projection", "splats boxes depths radii first_bad")
STRIP = structure("Strip", "splats boxes front_to_back ends", "n first_row end_row tiles_x")
LISTS = structure("Lists", "ids slots starts")
IMAGES = structure("Images", "colors alphas depths features variance visible")
COTANGENTS = structure("Cotangents", "colors alphas depths features variance")
GRADIENTS = structure(
    "Gradients", "means quats scales opacities colors features camera mean2d absgrad", "stored fresh fresh_features"
)


def filled(structure: Any, **values: Tensor | int | float | None) -> Any:
    """A struct of values by name; a tensor gives its address."""
    return structure(**{name: _address(v) if isinstance(v, Tensor) else v for name, v in values.items()})


def _pointer(tensor: Tensor) -> Any:
    return _POINTER(_address(tensor))


def _address(tensor: Tensor) -> int:
    return tensor.data_ptr()


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
    evaluated = contributing = 0  # pairs and seconds are not counted on a device
    seconds: ClassVar[dict[str, float]] = {}


class _Call:
    """The arguments of one call."""

    def __init__(self, inputs: Inputs, settings: Settings):
        self.inputs, self.settings = inputs, settings
        self.means, features = inputs.means, inputs.features
        self.n, self.dims = len(self.means), 0 if features is None else features.shape[1]
        self.blocks = (self.n + THREADS - 1) // THREADS
        self.tiles_x, self.tiles_y = ((size + TILE - 1) // TILE for size in (settings.width, settings.height))
        self.slices = range(0, max(self.dims, 1), MAX_FEATURES)  # of the feature channels, by the first of each
        self.scene = functools.cache(self._scene)

    def kernels(self, begin: int) -> Kernels:
        """Those for the slice of the feature channels that starts at `begin`."""
        s, width = self.settings, min(self.dims - begin, MAX_FEATURES)
        double = self.means.dtype == torch.float64
        options = KernelOptions(width, s.variance and width > 0, s.depth and begin == 0, double)
        return device_kernels(options, self.means.device)

    def _scene(self, camera: int, begin: int) -> Any:
        of, s = self.inputs, self.settings
        return filled(
            SCENES[self.means.dtype],
            **{name: getattr(of, name) for name in _GAUSSIANS if name != "features"},
            **{name: getattr(s, name) for name in ("sh_degree", "width", "height", "near_plane", "eps2d")},
            features=None if of.features is None else of.features[:, begin:],
            viewmat=of.viewmats[camera],
            K=of.Ks[camera],
            background=None if of.background is None else of.background[camera],
            n=self.n,
            sh_stride=of.colors.shape[1] if s.sh_degree >= 0 else 0,
            dims=self.dims,
        )

    def project(self, camera: int, radii: Tensor) -> list[_Strip]:
        """Projects all Gaussians and lists those of every tile. InputError names a value that is not finite."""
        new = self.means.new_empty
        splats, boxes = new((self.n, _SPLAT)), new((self.n, 4), dtype=torch.int32)
        depths = self.means.new_full((self.n,), torch.inf)
        first_bad = self.means.new_full((1,), self.n, dtype=torch.int32)
        projection = filled(PROJECTION, splats=splats, boxes=boxes, depths=depths, radii=radii, first_bad=first_bad)
        self.kernels(0).launch("project_kernel", self.blocks, self.scene(camera, 0), projection)
        front_to_back = torch.sort(depths, stable=True).indices.to(torch.int32)
        view = {"splats": splats, "boxes": boxes, "front_to_back": front_to_back}
        return self._strips(view, first_bad, 0, self.tiles_y)

    def _strips(self, view: dict[str, Tensor], first_bad: Tensor, first: int, end: int) -> list[_Strip]:
        """The lists of tile rows [first, end), in halves while they have too many pairs."""
        kernels, counts = self.kernels(0), self.means.new_empty((self.n,), dtype=torch.int32)
        strip = filled(STRIP, **view, n=self.n, first_row=first, end_row=end, tiles_x=self.tiles_x)
        kernels.launch("count_kernel", self.blocks, strip, _pointer(counts))
        ends = counts.cumsum(0)
        total, bad = torch.cat([ends[-1:], first_bad]).tolist() if self.n else (0, 0)  # waits for the device
        if bad < self.n:
            self._refuse(bad)
        if total > (self.settings.max_records or _MAX_RECORDS) and end - first > 1:
            middle = (first + end) // 2
            halves = (first, middle), (middle, end)
            return [strip for half in halves for strip in self._strips(view, first_bad, *half)]
        tiles = self.means.new_empty((total,), dtype=torch.int32)
        ids, strip.ends = torch.empty_like(tiles), _address(ends)
        kernels.launch("emit_kernel", self.blocks, strip, _pointer(tiles), _pointer(ids))
        count = (end - first) * self.tiles_x
        if count < 1 << 15:
            tiles = tiles.to(torch.int16)  # half the passes of a radix sort
        tiles, slots = torch.sort(tiles, stable=True)
        starts = torch.searchsorted(tiles, torch.arange(count + 1, dtype=tiles.dtype, device=tiles.device))
        lists = {"ids": ids[slots], "slots": slots, "starts": starts}
        kept = (*view.values(), ends, *lists.values())
        return [_Strip(count, strip, filled(LISTS, **lists), slots, kept)]

    def _refuse(self, index: int) -> None:
        """InputError for Gaussian `index`, or for a camera with -1."""
        for name in _CAMERAS if index < 0 else _GAUSSIANS:
            tensor = getattr(self.inputs, name)
            if tensor is None:
                continue
            wrong = (~tensor.isfinite().view(len(tensor), tensor[0].numel()).all(1)).nonzero()[:, 0].tolist()
            if wrong and (index < 0 or wrong[0] == index):
                raise InputError(f"rasterize: {name}[{wrong[0]}] is not finite")


def _images(structure: Any, of: Forward | Cotangents, camera: int, begin: int, **more: Tensor | None) -> Any:
    """The struct of one camera's images, or of their gradients. All but the features belong to the first slice."""

    def first(image: Tensor | None) -> Tensor | None:
        return None if image is None or begin else image[camera]

    def channels(image: Tensor | None) -> Tensor | None:
        return None if image is None else image[camera][..., begin:]

    own = {"colors": first(of.colors), "alphas": first(of.alphas), "depths": first(of.depths)}
    own |= {"features": channels(of.features), "variance": channels(of.feature_variance)}
    return filled(structure, **own | more)


def rasterize_forward(inputs: Inputs, settings: Settings) -> Forward:
    """As `rasterizer.cpu.rasterize_forward`, on the tensors' device."""
    call, out = _Call(inputs, settings), Forward.empty(inputs, settings)
    out.frames = Frames([call.project(c, radii) for c, radii in enumerate(out.radii)], out.visible)
    for camera, strips in enumerate(out.frames.views):
        for begin in call.slices:
            kernels, scene = call.kernels(begin), call.scene(camera, begin)
            written = _images(IMAGES, out, camera, begin, visible=out.visible[camera] if begin == 0 else None)
            for strip in strips:
                kernels.launch("forward_kernel", strip.tiles, scene, strip.range, strip.lists, written)
    return out


def rasterize_backward(
    inputs: Inputs,
    settings: Settings,
    forward: Forward,
    cotangents: Cotangents,
    gradients: Gradients,
    stored: bool = False,
) -> None:
    """As `rasterizer.cpu.rasterize_backward`, on the tensors' device."""
    frames: Frames = forward.frames
    call, count = _Call(inputs, settings), len(frames.views)
    outputs = {name: getattr(gradients, name) for name in Gradients.NAMES}
    fresh = stored and len(frames.views[0]) == 1  # a Gaussian has all its records in the one strip
    for name, gradient in outputs.items():
        if gradient is not None and stored and (not fresh or name == "viewmats"):
            gradient.zero_()
    features, viewmats = outputs.pop("features"), outputs.pop("viewmats")
    by_camera = {name: outputs.pop(name) for name in ("mean2d", "absgrad")}
    cameras = None if viewmats is None else call.means.new_zeros((count, call.n, 12))
    if forward.features is None and call.dims:  # rendered without features, which are zeros, wanted for their gradient
        forward = replace(forward, features=call.means.new_zeros((*forward.alphas.shape, call.dims)))
    for camera, strips in enumerate(frames.views):
        visible = frames.visible[camera]
        for begin in call.slices:
            kernels, scene = call.kernels(begin), call.scene(camera, begin)
            read = _images(IMAGES, forward, camera, begin, alphas=forward.alphas[camera], visible=visible)
            cotangent = _images(COTANGENTS, cotangents, camera, begin)
            added = filled(
                GRADIENTS,
                **outputs,
                features=None if features is None else features[:, begin:],
                camera=None if cameras is None else cameras[camera],
                **{name: None if of is None else of[camera] for name, of in by_camera.items()},
                stored=stored,
                fresh=fresh and begin == 0,
                fresh_features=fresh,
            )
            width = _MOMENTS + min(call.dims - begin, MAX_FEATURES)
            for strip in strips:
                records = call.means.new_zeros((len(strip.slots), width))
                at = _pointer(records)
                kernels.launch("backward_kernel", strip.tiles, scene, strip.range, strip.lists, read, cotangent, at)
                kernels.launch("reduce_kernel", call.blocks, scene, strip.range, _pointer(visible), at, added)
    if cameras is not None and viewmats is not None:
        total = cameras.sum(1, dtype=torch.float64).to(cameras.dtype)
        viewmats[:, :3, :3] += total[:, :9].reshape(-1, 3, 3)
        viewmats[:, :3, 3] += total[:, 9:]


def label_images(inputs: Inputs, labels: np.ndarray, least: float, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    """As `rasterizer.cpu.label_images`: the weights of _AT_ONCE labels are rendered as features."""
    viewmats = inputs.viewmats
    settings = replace(settings, variance=False, depth=False)
    plain = rasterize_forward(replace(inputs, features=None, background=None), settings)
    visible = plain.visible[0].cpu().numpy().view(bool)
    images = []
    for row in labels:
        names = torch.from_numpy(np.unique(row[visible & (row >= 0)]))
        # Whole slices: the kernels are compiled for each width of one, in seconds.
        names = torch.nn.functional.pad(names, (0, -len(names) % MAX_FEATURES), value=_NO_LABEL).to(viewmats.device)
        label_of = torch.from_numpy(np.ascontiguousarray(row)).to(viewmats.device)
        best = viewmats.new_full((settings.height, settings.width), least)
        image = torch.full_like(best, -1, dtype=torch.int32)
        for some in names.split(_AT_ONCE) if len(names) else ():
            features = (label_of[:, None] == some).to(best.dtype)
            weights = rasterize_forward(replace(inputs, features=features, background=None), settings).features
            assert weights is not None  # for the type checker
            most = weights[0].amax(dim=2)
            first = torch.where(weights[0] == most[..., None], some, _NO_LABEL).amin(dim=2)  # of equal ones the smaller
            image, best = torch.where(most > best, first, image), torch.maximum(most, best)
        images.append(image.cpu().numpy())
    return np.stack(images), visible

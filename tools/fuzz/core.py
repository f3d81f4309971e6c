"""The compiled module's arguments: every function is called with good ones, of which the fuzz bytes spoil a few."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy import sparse

from perception import _core

SHELL = 64
"""Bytes on either side of an output that must stay as they were."""
_MARK = 0xA5
Call = tuple[Callable[..., Any], dict[str, Any]]


class Dice:
    """Decisions read off the fuzz bytes; zeros once they are used up."""

    def __init__(self, data: bytes):
        self._data, self._at = data, 0

    def below(self, limit: int) -> int:
        """A number in [0, limit), limit up to 256."""
        self._at += 1
        return self._data[self._at - 1] % limit if self._at <= len(self._data) else 0

    def pick(self, options: Any) -> Any:
        """One of the options."""
        return options[self.below(len(options))]


def guarded(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Zeros inside a shell of marks; `intact` tells whether anything was written past its ends."""
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    memory = np.full(size + 2 * SHELL, _MARK, np.uint8)
    memory[SHELL : SHELL + size] = 0
    return memory[SHELL : SHELL + size].view(dtype).reshape(shape)


def intact(array: np.ndarray) -> bool:
    """False when the marks around a `guarded` array have changed; True for arrays of another making."""
    memory = array
    while isinstance(memory.base, np.ndarray):
        memory = memory.base
    if memory.dtype != np.uint8 or len(memory) < 2 * SHELL or array.nbytes + 2 * SHELL != memory.nbytes:
        return True
    return bool((memory[:SHELL] == _MARK).all() and (memory[-SHELL:] == _MARK).all())


def normal(dice: Dice, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """Numbers around zero from a few bytes."""
    return np.random.default_rng(dice.below(256)).normal(size=shape).astype(dtype)


# ------------------------------------------------------------------ good calls


def _scene(dice: Dice, dtype: Any, cameras: int, n: int, dims: int, size: tuple[int, int], degree: int) -> Any:
    suffix = "f64" if dtype == np.float64 else "f32"
    color = (n, 3) if degree < 0 else (n, (degree + 1) ** 2, 3)
    poses = np.tile(np.eye(4, dtype=dtype), (cameras, 1, 1))
    lenses = np.tile(np.array([[8, 0, 4], [0, 8, 3], [0, 0, 1]], dtype), (cameras, 1, 1))
    arguments = {
        "means": normal(dice, (n, 3), dtype) + np.array([0, 0, 4], dtype), "quats": normal(dice, (n, 4), dtype),
        "scales": np.abs(normal(dice, (n, 3), dtype)), "opacities": np.full(n, 0.5, dtype),
        "colors": normal(dice, color, dtype), "features": normal(dice, (n, dims), dtype) if dims else None,
        "viewmats": poses, "Ks": lenses, "background": np.zeros((cameras, 3), dtype),
        "width": size[0], "height": size[1], "sh_degree": degree, "near_plane": 0.01, "eps2d": 0.3,
        "threads": 1 + dice.below(2),
        "depth": True, "variance": bool(dims), "max_records": 0,
    }  # fmt: skip
    return getattr(_core, f"RasterizerInputs_{suffix}"), arguments


def _images(cameras: int, size: tuple[int, int], dims: int, dtype: Any) -> dict[str, Any]:
    image = (cameras, size[1], size[0])
    return {
        "colors": guarded((*image, 3), dtype), "alphas": guarded(image, dtype), "depths": guarded(image, dtype),
        "features": guarded((*image, dims), dtype) if dims else None,
        "feature_variance": guarded((*image, dims), dtype) if dims else None,
    }  # fmt: skip


def _forward(suffix: str, inputs: Any, visible: Any, radii: Any, simd: Any, **images: Any) -> Any:
    out = getattr(_core, f"RasterizerImages_{suffix}")(**images)
    return getattr(_core, f"rasterize_forward_{suffix}")(inputs, out, visible, radii, simd)


def _backward(suffix: str, inputs: Any, frames: Any, stored: Any, **arrays: Any) -> None:
    """Arrays of the images' gradients begin with g_, those of the inputs' with d_."""

    def made(struct: str, prefix: str) -> Any:
        named = {name.removeprefix(prefix): array for name, array in arrays.items() if name.startswith(prefix)}
        return getattr(_core, f"Rasterizer{struct}_{suffix}")(**named)

    rendered = {name: array for name, array in arrays.items() if name[:2] not in ("g_", "d_")}
    images = getattr(_core, f"RasterizerImages_{suffix}")(**rendered)
    run = getattr(_core, f"rasterize_backward_{suffix}")
    run(inputs, frames, images, made("Cotangents", "g_"), made("Gradients", "d_"), stored)


def _rasterize(dice: Dice, spoil: Callable[[dict[str, Any]], None]) -> list[Call]:
    """Inputs, forward and backward; each with its own spoiled arguments, backward maybe on another scene's frames."""
    dtype = dice.pick((np.float32, np.float64))
    suffix = "f64" if dtype == np.float64 else "f32"
    cameras, n, dims = dice.pick((1, 2, 0)), dice.pick((3, 0, 1, 9)), dice.pick((0, 2, 5, 17))
    size, degree = dice.pick(((8, 6), (1, 1), (70, 3), (1, 65))), dice.pick((-1, 0, 1, 3))
    make, arguments = _scene(dice, dtype, cameras, n, dims, size, degree)
    where = dice.below(4)
    if where == 0:
        spoil(arguments)
    inputs = _called(make, arguments)
    visible, radii = guarded((cameras, n), np.uint8), guarded((cameras, n), dtype)
    images = _images(cameras, size, dims, dtype)
    simd = dice.pick(("auto", "baseline", *_core.simd_levels()))
    forward = {"inputs": inputs, **images, "visible": visible, "radii": radii, "simd": simd}
    if where == 1:
        spoil(forward)
    frames = _called(partial(_forward, suffix), forward)
    if where == 2:  # other inputs than the frames were made of
        cameras, n = dice.pick((cameras, 1, 2)), dice.pick((n, 2, 5, 40))
        dims, size, degree = dice.pick((dims, 1, 6)), dice.pick((size, (5, 5), (130, 130))), dice.pick((degree, -1, 2))
        make, arguments = _scene(dice, dtype, cameras, n, dims, size, degree)
        inputs, images = _called(make, arguments), _images(cameras, size, dims, dtype)
    grads = {f"g_{name}": None if a is None else np.ones_like(a) for name, a in images.items()}
    wanted = {f"d_{name}": guarded(a.shape, dtype) for name, a in list(arguments.items())[:7]
              if isinstance(a, np.ndarray)}  # fmt: skip
    pulls = {f"d_{name}": guarded((cameras, n, 2), dtype) for name in ("mean2d", "absgrad")}
    wanted = {"d_features": None, **wanted, **pulls}
    if dice.below(3) == 0:
        wanted = {name: array if name == "d_features" else None for name, array in wanted.items()}
    backward = {"inputs": inputs, "frames": frames, **images, **grads, **wanted, "stored": bool(dice.below(2))}
    if where == 3:
        spoil(backward)
    _called(partial(_backward, suffix), backward)
    return []


def _photometric(dice: Dice) -> Call:
    dtype, shape = dice.pick((np.float32, np.float64)), dice.pick(((6, 8, 3), (1, 1, 1), (40, 3, 4), (2, 90, 16)))
    target = normal(dice, shape, dtype) if dice.below(2) else np.zeros(shape, np.uint8)
    weight = dice.pick((None, np.ones(shape[:2], dtype)))
    arguments = {"render": normal(dice, shape, dtype), "target": target, "weight": weight}
    return _core.training.photometric, {
        **arguments,
        "gradient": guarded(shape, dtype),
        "beta": dice.pick((0.2, 0.0, 1.0)),
    }


def _assign(dice: Dice) -> Call:
    labels = np.array([0, 1, 1, 5, 1 << 21, 0, 7], np.int32)[: 1 + dice.below(7)]
    slots = guarded(labels.shape, np.int32)
    return _core.training.assign, {"labels": labels, "slots": slots}


def _prototypes(dice: Dice) -> Call:
    dtype, width = dice.pick((np.float32, np.float64)), dice.pick((8, 1, 16, 3))
    return _core.training.prototypes, {
        "features": normal(dice, (5, width), dtype), "slots": np.array([0, 1, -1, 1, 0], np.int32),
        "counts": np.array([2, 2]), "first": np.array([0, 1]), "means": guarded((2, width), np.float64),
        "scatter": guarded((2,), np.float64),
    }  # fmt: skip


def _spread(dice: Dice) -> Call:
    dtype, width = dice.pick((np.float32, np.float64)), dice.pick((8, 1, 16, 3))
    return _core.training.spread, {
        "features": normal(dice, (5, width), dtype), "slots": np.array([0, 1, -1, 1, 0], np.int32),
        "means": np.zeros((2, width)), "pull": np.ones(2), "push": np.ones((2, width)),
        "out": guarded((5, width), dtype),
    }  # fmt: skip


def _separation(dice: Dice) -> Call:
    points = normal(dice, (4, dice.pick((3, 1, 8))), np.float64)
    return _core.training.separation, {"points": points, "margin": 1.0, "gradient": guarded(points.shape, np.float64)}


def _add_statistics(dice: Dice) -> Call:
    n = dice.pick((5, 1, 0))
    return _core.training.add_statistics, {
        "mean2d": normal(dice, (n, 2), np.float32), "visible": np.ones(n, np.uint8),
        "gradient": guarded((n,), np.float32), "seen": guarded((n,), np.float32), "scale": 2.0,
    }  # fmt: skip


def _sum(dice: Dice) -> Call:
    values = normal(dice, (dice.pick((9, 1, 0, 200)),), dice.pick((np.float32, np.float64)))
    return _core.training.sum, {"values": values, "squared": True}


def _scale(dice: Dice) -> Call:
    values = normal(dice, (dice.pick((9, 1, 0, 200)),), dice.pick((np.float32, np.float64)))
    return _core.training.scale, {"values": values, "factor": 2.0, "out": guarded(values.shape, values.dtype)}


def _adam(dice: Dice) -> Call:
    dtype, shape = dice.pick((np.float32, np.float64)), dice.pick(((5, 3), (1, 1), (2, 48), (0, 4)))
    return _core.training.adam, {
        "param": guarded(shape, dtype), "grad": normal(dice, shape, dtype), "first": guarded(shape, dtype),
        "second": guarded(shape, dtype), "visible": dice.pick((None, np.ones(shape[0], np.uint8))),
        "rate": np.full(shape[1], 0.1), "step": 1, "beta1": 0.9, "beta2": 0.999, "eps": 1e-8,
    }  # fmt: skip


def _tree(dice: Dice) -> Call:
    return _core.KdTree, {"points": normal(dice, (dice.pick((9, 1, 100)), 3), np.float32), "threads": 1}


def _knn(dice: Dice) -> Call:
    tree = _core.KdTree(normal(dice, (dice.pick((9, 1, 100)), 3), np.float32))
    q, k = dice.pick((5, 0, 40)), dice.pick((1, 3, 16))
    return tree.knn, {
        "queries": normal(dice, (q, 3), np.float32), "indices": guarded((q, k), np.int32),
        "squared": guarded((q, k), np.float32), "max_distance": dice.pick((1.0, float("inf"), 0.0)), "threads": 2,
    }  # fmt: skip


def _neighbors(dice: Dice, points: int) -> np.ndarray:
    return np.random.default_rng(dice.below(256)).integers(-1, points, (points, dice.pick((3, 1, 6)))).astype(np.int32)


def _felzenszwalb(dice: Dice) -> Call:
    edges = np.random.default_rng(dice.below(256)).integers(0, 6, (dice.pick((9, 0, 1)), 2)).astype(np.int32)
    weights = np.abs(normal(dice, (len(edges),), np.float32))
    return _core.felzenszwalb, {
        "edges": edges, "weights": weights, "k": 0.5, "min_size": dice.pick((2, 0, 100)),
        "labels": guarded((6,), np.int32),
    }  # fmt: skip


def _merge_segments(dice: Dice) -> Call:
    rng, count, views = np.random.default_rng(dice.below(256)), dice.pick((7, 1, 30)), dice.pick((3, 1))
    masks = dice.pick((8, 0))

    def rows(columns: int, filled: float) -> sparse.csr_matrix:
        return sparse.csr_matrix(rng.random((count, columns)) * (rng.random((count, columns)) < filled))

    pixels, blank, near = rows(masks, 0.5), rows(views, 0.5), rows(count, 0.3)
    return _core.merge_segments, {
        "mask_starts": pixels.indptr.astype(np.int64), "masks": pixels.indices,
        "pixels": pixels.data.astype(np.float32),
        "blank_starts": blank.indptr.astype(np.int64), "blank_views": blank.indices,
        "blank": blank.data.astype(np.float32), "view": np.sort(rng.integers(0, views, masks)).astype(np.int32),
        "views": views, "near_starts": near.indptr.astype(np.int64), "near": near.indices,
        "z": rng.normal(size=(count, dice.pick((3, 1)))), "sizes": np.ones(count), "least_share": 0.1,
        "one_sided": 0.5, "prior": 0.5, "lowest": 0.05, "many": dice.pick((100, 3)), "sure": 0.3,
        "children": guarded((count - 1, 2), np.int32), "affinity": guarded((count - 1,), np.float64),
    }  # fmt: skip


def _undirected(dice: Dice) -> Call:
    lists = _neighbors(dice, 6)
    return _core.undirected, {"neighbors": lists, "edges": guarded((lists.size, 2), np.int32)}


def _plane_normals(dice: Dice) -> Call:
    lists = _neighbors(dice, 6)
    points = normal(dice, (6, 3), np.float32)
    return _core.plane_normals, {
        "points": points,
        "neighbors": lists,
        "normals": guarded((6, 3), np.float32),
        "threads": 2,
    }


def _plane_sweep(dice: Dice) -> Call:
    shape, others = (dice.pick((5, 1, 41)), dice.pick((6, 1, 33))), dice.pick((2, 1))
    maps = np.random.default_rng(dice.below(256)).normal(0, dice.pick((0.1, 10.0)), (others, 2, 3, 3))
    return _core.plane_sweep, {
        "photo": np.arange(shape[0] * shape[1], dtype=np.uint8).reshape(shape),
        "others": [np.full((dice.pick((4, 1)), 3), 9, np.uint8)] * others, "homographies": np.eye(3) + maps,
        "prior": np.ones(shape, np.float32), "first": 2.0, "step": -0.05, "planes": 32,
        "depth": guarded(shape, np.float32),
    }  # fmt: skip


FUNCTIONS = [
    _photometric,
    _assign,
    _prototypes,
    _spread,
    _separation,
    _add_statistics,
    _sum,
    _scale,
    _adam,
    _tree,
    _knn,
]
FUNCTIONS += [_felzenszwalb, _merge_segments, _undirected, _plane_normals, _plane_sweep]
_LEVELLED = (_photometric, _prototypes, _spread, _sum, _adam, _plane_sweep)

# ------------------------------------------------------------------ spoiling

_NUMBERS = (0, -1, 1, 2, 3, 1024, 1025, 2**31 - 1, -(2**31), 2**31, 2**32, 2**63 - 1, -(2**63), 2**63, 2**64, 0.5)
_NUMBERS += (float("nan"), float("inf"), float("-inf"), 1e308, 1e-320, True, None, "auto", "x", b"", [], {}, object())
_VALUES = (float("nan"), float("inf"), float("-inf"), 0.0, -0.0, -1.0, 1e30, -1e30, 1e-40, 3.4e38, 1e-8, 1e4)
_WHOLE = (0, -1, 1, -2, 5, 6, 100, 2**31 - 1, -(2**31), 255)
_DTYPES = ("f4", "f8", "i4", "i8", "u1", "u4", "f2", "c8", "?", ">f4", ">i4", "O", "S3")


def spoiled(dice: Dice, value: Any) -> Any:
    """Another value in place of a good one."""
    if not isinstance(value, np.ndarray) or value.ndim == 0 or max(value.shape) > 1 << 20:
        return dice.pick(_NUMBERS)
    kind = dice.below(16)
    if kind < 4:
        return _other_values(dice, value)
    if kind < 9:
        return _other_shape(dice, value, kind)
    if kind == 9:
        try:
            return value.astype(dice.pick(_DTYPES))
        except (OverflowError, TypeError):  # Python's own numbers, that an earlier turn put there, need not fit
            return value
    if kind == 10:
        copy = value.copy()
        copy.setflags(write=False)
        return copy
    if kind == 11:  # not aligned to its own numbers
        memory = np.zeros(value.nbytes + 8, np.uint8)[1 : 1 + value.nbytes]
        return memory.view(value.dtype).reshape(value.shape)
    if kind == 12:  # strides
        wide = np.repeat(value, 2, axis=-1) if value.ndim else value
        return wide[..., ::2]
    if kind == 13:
        return value[::-1] if dice.below(2) else np.asfortranarray(value)
    if kind == 14:  # giant and free of charge: one number with strides of 0, or giant in one axis and empty in another
        if dice.below(2) or value.ndim < 2:
            return np.broadcast_to(np.zeros((), value.dtype), (1 << 40, *value.shape[1:]))
        return np.zeros((0, *(dice.pick((3, 1 << 31, 1 << 32, 1 << 40)) for _ in value.shape[1:])), value.dtype)
    return dice.pick((None, 0, "x", value.tolist(), [value], object()))


def _other_values(dice: Dice, value: np.ndarray) -> np.ndarray:
    out = guarded(value.shape, value.dtype)
    out[...] = value
    for _ in range(1 + dice.below(3)):
        if out.size:
            out.reshape(-1)[dice.below(min(out.size, 256))] = dice.pick(
                _VALUES if out.dtype.kind == "f" else _wide(out)
            )
    return out


def _wide(out: np.ndarray) -> tuple[int, ...]:
    limits = np.iinfo(out.dtype)
    return tuple(v for v in _WHOLE if limits.min <= v <= limits.max)


def _other_shape(dice: Dice, value: np.ndarray, kind: int) -> np.ndarray:
    shape = list(value.shape)
    if kind == 4 and shape:
        del shape[dice.below(len(shape))]
    elif kind == 5:
        shape.insert(dice.below(len(shape) + 1), dice.pick((1, 0, 2)))
    elif shape:
        axis = dice.below(len(shape))
        shape[axis] = max(0, dice.pick((shape[axis] + 1, shape[axis] - 1, 0, 1, 2 * shape[axis], 17)))
    return guarded(tuple(shape), value.dtype)


_OF_INPUTS = ("means", "quats", "scales", "opacities", "colors", "features", "viewmats", "Ks", "background", "width")
_OF_INPUTS += ("near_plane", "eps2d", "sh_degree", "threads", "max_records", "simd")


def _called(function: Callable[..., Any], arguments: dict[str, Any]) -> Any:
    """The call's result; AssertionError when it wrote past an output, or was refused without a name."""
    try:
        return function(**arguments)
    except ValueError as error:
        if not any(name.removeprefix("d_") in str(error) for name in (*arguments, *_OF_INPUTS)):
            raise AssertionError(f"names no argument: {error}") from error
        raise
    finally:
        for name, value in arguments.items():
            if isinstance(value, np.ndarray) and not intact(value):
                raise AssertionError(f"{getattr(function, '__name__', function)} wrote past {name}")


class CoreTarget:
    """As targets.Target, for functions instead of files."""

    words: tuple[str, ...] = ()
    decides = True
    memory = 512

    def __init__(self) -> None:
        """Starts all threads that there may be: they stay, and their stacks count where memory is limited."""
        size = (1024, 1024)
        make, arguments = _scene(Dice(b""), np.float32, 1, 3, 0, size, -1)
        inputs = make(**arguments | {"threads": 256})
        seen = {"visible": np.zeros((1, 3), np.uint8), "radii": np.zeros((1, 3), np.float32)}
        _forward("f32", inputs=inputs, **_images(1, size, 0, np.float32), **seen, simd="auto")

    def seeds(self) -> list[bytes]:
        """Every function with nothing spoiled."""
        return [bytes([n, 0, 0, 0, 0, 0]) for n in range(len(FUNCTIONS))] + [
            bytes([len(FUNCTIONS), 0, *shape, where, 1, 1, 1])
            for shape in ((0, 0, 0, 0, 0, 0), (1, 0, 0, 3, 2, 2))
            for where in (2, 3)
        ]

    def run(self, data: bytes) -> bool:
        """True when the call was carried out, False when it was refused with ValueError or TypeError."""
        dice = Dice(data)
        which, count = dice.below(len(FUNCTIONS) + 6), dice.below(4)

        def spoil(arguments: dict[str, Any]) -> None:
            for _ in range(count):
                name = dice.pick(list(arguments))
                arguments[name] = spoiled(dice, arguments[name])

        try:
            if which >= len(FUNCTIONS):
                _rasterize(dice, spoil)
            else:
                function, arguments = FUNCTIONS[which](dice)
                if FUNCTIONS[which] in _LEVELLED:
                    arguments |= {
                        "threads": 1 + dice.below(2),
                        "level": dice.pick(("auto", "baseline", *_core.simd_levels())),
                    }
                spoil(arguments)
                _called(function, arguments)
        except (ValueError, TypeError):
            return False
        return True

"""A device without a machine: its tensors hold CPU tensors, and torch refuses what it would refuse for a GPU's.

Mixing tensors of two devices and `.numpy()` on the device raise; results are those of the CPU.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

NAME = "pretend"
_COPIES = (torch.ops.aten._to_copy.default, torch.ops.aten.copy_.default)


class _OnDevice(torch.Tensor):
    """A tensor on the device; held: its numbers, on the CPU."""

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> Any:
        layout = {"strides": held.stride(), "storage_offset": held.storage_offset(), "dtype": held.dtype}
        return torch.Tensor._make_wrapper_subclass(cls, held.size(), **layout, device=torch.device(NAME, 0))

    def __init__(self, held: torch.Tensor) -> None:
        self.held = held

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(function, args, kwargs or {})

    def data_ptr(self) -> int:
        return self.held.data_ptr()

    def untyped_storage(self) -> Any:
        return self.held.untyped_storage()

    def tolist(self) -> Any:
        return self.held.tolist()

    def numpy(self, **_: Any) -> Any:
        raise TypeError("can't convert a tensor of the pretended device to numpy; use .cpu() first")


class _Mode(TorchDispatchMode):
    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _computed(function, args, kwargs or {})


def _computed(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    mine = {id(tensor.held): tensor for tensor in tensors if isinstance(tensor, _OnDevice)}
    # Indices may lie on the CPU, and numbers too.
    strangers = [t for t in tensors if not isinstance(t, _OnDevice) and t.dim() > 0 and t.dtype != torch.int64]
    if mine and strangers and function not in _COPIES:
        raise RuntimeError(f"{function}: expected all tensors to be on the same device, found {NAME} and cpu")
    asked = kwargs.get("device")
    there = bool(mine) if asked is None else torch.device(asked).type == NAME
    if asked is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    opened = tree_map(lambda leaf: leaf.held if isinstance(leaf, _OnDevice) else leaf, (args, kwargs))
    result = function(*opened[0], **opened[1])
    if function is torch.ops.aten.copy_.default:
        return args[0]

    def closed(leaf: Any) -> Any:
        if not isinstance(leaf, torch.Tensor):
            return leaf
        return mine[id(leaf)] if id(leaf) in mine else _OnDevice(leaf) if there else leaf

    return tree_map(closed, result)


@functools.cache
def _registered() -> None:
    registration = pytest.importorskip("torch.utils.backend_registration")
    if not hasattr(registration, "_setup_privateuseone_for_python_backend"):
        pytest.skip(f"torch {torch.__version__} cannot pretend a device")
    registration._setup_privateuseone_for_python_backend(NAME)


@contextmanager
def pretended_device() -> Iterator[torch.device]:
    """The device, within the block."""
    _registered()
    with _Mode():
        yield torch.device(NAME, 0)

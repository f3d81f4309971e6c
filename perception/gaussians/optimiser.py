"""Sparse Adam: a step updates only the rows (Gaussians) that a mask selects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from perception.gaussians.device import training_kernels

Rate = float | Tensor
BETAS, EPS = (0.9, 0.999), 1e-15


class SparseAdam:
    """Adam (Kingma & Ba 2015) on the rows a mask selects, for tensors that grow and shrink together.

    params: name -> [N, ...] contiguous float32 or float64 tensors on one device, the same N for all; updated in place.

    Semantics of the mask:
    - A selected row is updated as dense Adam would, also when its gradient is 0: its moments decay,
      and its momentum still moves it.
    - A row not selected is unchanged: its moments do not decay, and it does not move.
    - The bias correction uses the global step count, common to all rows, as in 3DGS. So a row with zero moments
      that is added late takes up to (1 − β1)/√(1 − β2) ≈ 3.2 times the rate at its first step.
    - A selected row whose gradient holds a NaN or an infinity is unchanged in that tensor, and counted as skipped.

    With every row selected and every gradient finite this equals torch.optim.Adam(eps=1e-15) up to rounding.
    """

    def __init__(self, params: Mapping[str, Tensor]) -> None:
        self.steps = 0
        self.params = dict(params)
        self._first, self._second = ({name: torch.zeros_like(t) for name, t in params.items()} for _ in range(2))
        self._tables = {"params": self.params, "first": self._first, "second": self._second}

    def step(self, rates: Mapping[str, Rate], grads: Mapping[str, Tensor | None], visible: Tensor | None = None) -> int:
        """One step of the rows where visible [N] uint8 is not 0; None: of all. grads: name -> [N, ...].

        rates: name -> learning rate, or a tensor of one rate per column, shaped like a row ([...]): the constant term
        and the higher spherical harmonics share a tensor and have different rates.
        Tensors without a gradient are not updated; the global step count increases by one for all. Returns the number
        of rows of the others skipped for a gradient with NaN or infinity, as a tensor where it is not on the CPU.
        """
        self.steps += 1
        device = next(iter(self.params.values())).device
        # On a GPU one counter for all tensors: each zero and each sum would be a launch.
        counter = {} if device.type == "cpu" else {"skipped": torch.zeros((), dtype=torch.int32, device=device)}
        skipped = 0
        for name, param in self.params.items():
            grad = grads.get(name)
            if grad is None or not param.numel():
                continue
            tensors = (param, grad.contiguous(), self._first[name], self._second[name])
            matrices = [tensor.view(len(param), -1) for tensor in tensors]
            rate = np.asarray(rates[name], dtype=np.float64).reshape(-1)
            rate = np.ascontiguousarray(np.broadcast_to(rate, matrices[0].shape[1]))
            adam = training_kernels(device).adam
            found = adam(*matrices, visible, rate, self.steps, *BETAS, EPS, **counter)
            skipped = found if counter else skipped + found
        return skipped

    def keep(self, index: Tensor) -> None:
        """Keeps the rows `index` selects, in its order: [N] bool, or int64 row numbers (repeats allowed)."""
        rows = index.nonzero()[:, 0] if index.dtype == torch.bool else index
        for table in self._tables.values():
            for name, tensor in table.items():
                table[name] = tensor.index_select(0, rows)

    def resize(self, name: str, count: int) -> None:
        """Cuts the rows of `name`, [N, K, ...], to K = count, or extends them by zeros, and their moments alike."""
        for table in self._tables.values():
            old = table[name]
            more = old.new_zeros(len(old), max(0, count - old.shape[1]), *old.shape[2:])
            table[name] = torch.cat([old[:, :count], more], dim=1)

    def append(self, rows: Mapping[str, Tensor]) -> None:
        """Appends rows (name -> [M, ...], the same M for all) with zero moments."""
        for name, new in rows.items():
            for table in self._tables.values():
                old = table[name]
                table[name] = torch.cat([old, new.to(old) if table is self.params else old.new_zeros(new.shape)])

    def state_dict(self, copy: bool = True) -> dict[str, Any]:
        """Everything needed to continue: params and moments on the CPU, step count. Without `copy`, tensors that are on
        the CPU are returned themselves, and the next step changes them."""
        copies: dict[str, Any] = {
            key: {name: t.to("cpu", copy=copy) for name, t in table.items()} for key, table in self._tables.items()
        }
        return copies | {"steps": self.steps}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores a `state_dict` of the same names; the number of rows may differ."""
        for key, table in self._tables.items():
            for name, tensor in state[key].items():
                table[name] = tensor.to(table[name].device, copy=True).contiguous()
        self.steps = state["steps"]

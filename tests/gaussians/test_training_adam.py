"""SparseAdam against torch.optim.Adam, and its promises about rows."""

import numpy as np
import pytest
import torch
from torch.optim.adam import adam

pytest.importorskip("perception._core")
from perception import _core
from perception.gaussians.optimiser import SparseAdam

SHAPES = {"means": (3,), "quats": (4,), "opacities": (), "sh": (16, 3), "features": (8,)}
RATES = {"means": 1.6e-4, "quats": 1e-3, "opacities": 0.05, "sh": 2.5e-3, "features": 1e-2}


def tensors(rows, seed=0, dtype=torch.float64, scale=1.0):
    random = np.random.default_rng(seed)
    return {n: torch.from_numpy(random.normal(size=(rows, *s)) * scale).to(dtype) for n, s in SHAPES.items()}


@pytest.mark.parametrize("dtype, tolerance", [(torch.float64, 1e-13), (torch.float32, 2e-6)])
def test_all_rows_is_torch_adam(dtype, tolerance):
    ours = SparseAdam(tensors(700, dtype=dtype))
    reference = tensors(700, dtype=dtype)
    moments = {n: [torch.zeros_like(p), torch.zeros_like(p), torch.zeros(())] for n, p in reference.items()}
    for step in range(5):
        grads = tensors(700, seed=step + 1, dtype=dtype, scale=1e-3)
        ours.step(RATES, grads)
        for n, param in reference.items():  # by the function of torch.optim.Adam, whose class loads torch's compiler
            first, second, count = ([tensor] for tensor in moments[n])
            rest = {"amsgrad": False, "beta1": 0.9, "beta2": 0.999, "weight_decay": 0.0, "maximize": False}
            adam([param], [grads[n]], first, second, [], count, foreach=False, lr=RATES[n], eps=1e-15, **rest)
    for name, param in reference.items():
        assert (param - ours.params[name]).abs().max() < tolerance


@pytest.mark.parametrize("share", [0.0, 0.03, 0.5, 0.97])
def test_only_visible_rows_change_and_they_change_as_if_alone(share):
    rows = 3000
    visible = torch.from_numpy(np.random.default_rng(9).random(rows) < share)
    sparse, alone = SparseAdam(tensors(rows)), SparseAdam(tensors(rows))
    alone.keep(visible)
    before = {n: p.clone() for n, p in sparse.params.items()}
    for step in range(3):
        grads = tensors(rows, seed=step + 1)
        skipped = sparse.step(RATES, grads, visible.to(torch.uint8))
        alone.step(RATES, {n: g[visible] for n, g in grads.items()})
        assert skipped == 0
    for name, param in sparse.params.items():
        assert torch.equal(param[~visible], before[name][~visible])
        assert torch.allclose(param[visible], alone.params[name], rtol=1e-14, atol=1e-15)


def test_one_rate_per_column():
    rates = torch.full((16, 3), 2.5e-3 / 20)
    rates[0] = 2.5e-3
    ours = SparseAdam({"sh": tensors(50)["sh"]})
    grads = tensors(50, seed=2)["sh"]
    dc = SparseAdam({"x": tensors(50)["sh"][:, :1].contiguous()})
    rest = SparseAdam({"x": tensors(50)["sh"][:, 1:].contiguous()})
    ours.step({"sh": rates}, {"sh": grads})
    dc.step({"x": float(rates[0, 0])}, {"x": grads[:, :1]})
    rest.step({"x": float(rates[1, 0])}, {"x": grads[:, 1:]})
    assert torch.allclose(ours.params["sh"], torch.cat([dc.params["x"], rest.params["x"]], 1), rtol=1e-15)


@pytest.mark.parametrize("poison", [float("nan"), float("inf"), -float("inf")])
def test_a_gradient_that_is_not_finite_is_skipped_and_counted(poison):
    ours, clean = SparseAdam(tensors(400)), SparseAdam(tensors(400))
    good = torch.ones(400, dtype=torch.bool)
    good[[0, 17, 399]] = False
    grads = tensors(400, seed=1)
    poisoned = {n: g.clone() for n, g in grads.items()}
    poisoned["sh"][~good, 3, 1] = poison
    skipped = ours.step(RATES, poisoned)
    clean.step(RATES, grads, good.to(torch.uint8))
    assert skipped == 3
    assert torch.equal(ours.params["sh"], clean.params["sh"])
    assert all(torch.isfinite(t).all() for t in ours.state_dict()["second"].values())


@pytest.mark.parametrize("share", [0.2, 0.8])
def test_a_bad_gradient_in_an_invisible_row_is_nobodys_concern(share):
    visible = torch.from_numpy(np.random.default_rng(2).random(500) < share)
    ours, clean = SparseAdam(tensors(500)), SparseAdam(tensors(500))
    grads = tensors(500, seed=1)
    clean.step(RATES, grads, visible.to(torch.uint8))
    poisoned = {n: torch.where(_rows(visible, g), g, torch.inf) for n, g in grads.items()}
    skipped = ours.step(RATES, poisoned, visible.to(torch.uint8))
    assert skipped == 0
    for name, param in ours.params.items():
        assert torch.isfinite(param).all()
        assert torch.allclose(param, clean.params[name], rtol=1e-14, atol=0)


def _rows(mask, like):
    return mask.reshape(-1, *[1] * (like.ndim - 1))


def test_zero_gradient_moves_on_by_momentum():
    ours = SparseAdam({"x": torch.zeros(2, 1, dtype=torch.float64)})
    ours.step({"x": 0.1}, {"x": torch.ones(2, 1, dtype=torch.float64)})
    ours.step({"x": 0.1}, {"x": torch.zeros(2, 1, dtype=torch.float64)}, torch.tensor([1, 0], dtype=torch.uint8))
    m, v = 0.9 * 0.1 / (1 - 0.81), 0.999 * 0.001 / (1 - 0.999**2)
    assert abs(ours.params["x"][0].item() - (-0.1 - 0.1 * m / v**0.5)) < 1e-12
    assert abs(ours.params["x"][1].item() + 0.1) < 1e-12


def test_keep_and_append_carry_the_state():
    ours, long = SparseAdam(tensors(30)), SparseAdam(tensors(30))
    grads = tensors(30, seed=1)
    ours.step(RATES, grads)
    long.step(RATES, grads)
    order = torch.tensor([5, 5, 29, 0])
    ours.keep(order)
    ours.append(tensors(2, seed=8))
    assert len(ours.params["sh"]) == 6
    more = tensors(30, seed=2)
    long.step(RATES, more)
    ours.step(RATES, {n: torch.cat([g[order], torch.ones(2, *SHAPES[n], dtype=g.dtype)]) for n, g in more.items()})
    for name, param in ours.params.items():
        assert torch.equal(param[:4], long.params[name][order])
    # Zero state at global step 2, unit gradient: m = .1 / (1 − .9²), v = .001 / (1 − .999²).
    moved = tensors(2, seed=8)["means"] - ours.params["means"][4:]
    assert torch.allclose(moved, torch.full_like(moved, 1.6e-4 * (0.1 / 0.19) / (0.001 / (1 - 0.999**2)) ** 0.5))


def test_resized_columns_go_on_as_if_the_others_had_never_been_there():
    """Columns are independent: those that stay take the steps of an optimiser without the others."""
    few, many = ({"sh": tensors(50)["sh"][:, :n].contiguous()} for n in (4, 16))
    alone, resized = (SparseAdam(tables) for tables in (few, many))
    for step in range(4):
        grads = tensors(50, seed=step + 1)["sh"]
        if step == 2:
            resized.resize("sh", 4)
        alone.step({"sh": 1e-2}, {"sh": grads[:, :4].contiguous()})
        resized.step({"sh": 1e-2}, {"sh": grads[:, : 16 if step < 2 else 4].contiguous()})
    assert torch.equal(alone.params["sh"], resized.params["sh"])
    resized.resize("sh", 9)
    state = resized.state_dict()
    for table in ("params", "first", "second"):
        assert state[table]["sh"].shape == (50, 9, 3) and not state[table]["sh"][:, 4:].any()
    assert torch.equal(state["params"]["sh"][:, :4], alone.params["sh"])


def test_resume_goes_on_with_the_same_bits():
    whole = SparseAdam(tensors(100))
    for step in range(4):
        if step == 2:
            state = whole.state_dict()
        whole.step(RATES, tensors(100, seed=step))
    resumed = SparseAdam(tensors(3))
    resumed.load_state_dict(state)
    for step in (2, 3):
        resumed.step(RATES, tensors(100, seed=step))
    assert all(torch.equal(p, resumed.params[n]) for n, p in whole.params.items())


def run_kernel(threads, level, width):
    random = np.random.default_rng(3)
    p, g, m, v = (torch.from_numpy(random.random((5000, width))).float() for _ in range(4))
    visible = torch.from_numpy((random.random(5000) < 0.6).astype(np.uint8))
    rate = torch.full((width,), 1e-2, dtype=torch.float64)
    _core.training.adam(p, g, m, v, visible, rate, 7, 0.9, 0.999, 1e-15, threads, level)
    return p, m, v


@pytest.mark.parametrize("width", [1, 3, 48])
def test_threads_same_bits_and_instruction_sets_agree(width):
    reference = run_kernel(1, "baseline", width)
    for level in _core.simd_levels():
        one = run_kernel(1, level, width)
        for threads in (2, 16):
            assert all(torch.equal(a, b) for a, b in zip(one, run_kernel(threads, level, width), strict=True))
        assert all((a - b).abs().max() < 3e-7 for a, b in zip(one, reference, strict=True))


def test_empty_and_bad_input():
    empty = SparseAdam(tensors(0))
    assert empty.step(RATES, tensors(0)) == 0
    ours = SparseAdam(tensors(4))
    with pytest.raises(ValueError, match="visible"):
        ours.step(RATES, tensors(4), torch.ones(3, dtype=torch.uint8))
    with pytest.raises(ValueError, match="grad"):
        ours.step(RATES, {"means": torch.zeros(4, 5, dtype=torch.float64)})
    with pytest.raises(ValueError, match="broadcast"):
        ours.step({**RATES, "sh": torch.ones(7)}, tensors(4))

"""Instance and variance losses against plain torch, written here from the paper's equations."""

import numpy as np
import pytest
import torch

pytest.importorskip("perception._core")
from perception import _core
from perception.gaussians.losses import assign_labels, variance_loss
from perception.gaussians.losses import instance_loss as of_assigned
from support.losses import known


def instance_loss(features, labels, *, margin=1.0, w_pos=1.0, w_neg=1.0):
    return of_assigned(features, assign_labels(labels), margin=margin, w_pos=w_pos, w_neg=w_neg)


def torch_instance(features, labels, margin=1.0):
    ids = [int(i) for i in torch.unique(labels) if i != 0]
    if not ids:
        return features.sum() * 0, features.sum() * 0, features.new_zeros(0, features.shape[2])
    masks = [features[labels == i] for i in ids]
    z = torch.stack([m.mean(0) for m in masks])
    scatter = [((m - c) ** 2).sum(1) for m, c in zip(masks, z, strict=True)]
    pos = torch.stack([s.mean() for s in scatter]).mean()
    count = len(ids)
    i, j = torch.triu_indices(count, count, 1)
    square = ((z[i] - z[j]) ** 2).sum(1)
    hinge = torch.relu(margin - square)
    return pos, hinge.sum() * (2 / (count * (count - 1)) if count > 1 else 0), z


def scene(height=17, width=23, depth=8, count=6, seed=0, scale=0.4):
    random = np.random.default_rng(seed)
    features = torch.from_numpy(random.normal(size=(height, width, depth)) * scale).requires_grad_()
    return features, torch.from_numpy(random.integers(0, count + 1, (height, width)).astype(np.int32))


def compare(features, labels, tolerance=1e-12, **options):
    ours = instance_loss(features, labels, **options)
    pos, neg, z = torch_instance(features, labels, **options)
    assert abs(ours.pos - pos.item()) < tolerance and abs(ours.neg - neg.item()) < tolerance
    assert (ours.prototypes - z).abs().max() < tolerance if len(z) else len(ours.prototypes) == 0
    expected = torch.autograd.grad(pos + neg, features)[0]
    assert (ours.gradient - expected).abs().max() <= tolerance
    return ours


@pytest.mark.parametrize("depth", [1, 3, 8, 16, 32])
def test_matches_the_equations(depth):
    features, labels = scene(depth=depth)
    compare(features, labels, margin=1.5)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_none_one_and_two_labels(count):
    features, labels = scene(count=count)
    ours = compare(features, labels)
    assert len(ours.prototypes) == count
    if count < 2:
        assert ours.neg == 0


def test_all_one_label_and_one_pixel():
    features, _ = scene()
    compare(features, torch.full((17, 23), 7, dtype=torch.int32))
    pixel = torch.ones(1, 1, 4, dtype=torch.float64)
    loss = instance_loss(pixel, torch.ones(1, 1, dtype=torch.int32))
    assert loss.value == 0 and torch.equal(loss.prototypes[0], pixel[0, 0])


def test_300_labels():
    features, labels = scene(40, 60, 8, 300)
    assert len(compare(features, labels).prototypes) == 300


def test_ids_need_not_be_dense():
    features, labels = scene()
    names = torch.tensor([0, 5, 40_000, 3, 2_000_000_000, 12, 70_000], dtype=torch.int32)
    plain, wild = instance_loss(features, labels), instance_loss(features, names[labels.long()])
    assert assign_labels(names[labels.long()]).ids.tolist() == sorted(names[1:].tolist())
    assert abs(plain.value - wild.value) < 1e-13


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int64])
def test_labels_of_any_integer_type(dtype):
    _, labels = scene()
    plain, read = assign_labels(labels), assign_labels(labels.to(dtype))
    assert torch.equal(plain.slots, read.slots) and torch.equal(plain.counts, read.counts)


def test_features_far_from_zero_do_not_cancel():
    random = np.random.default_rng(3)
    labels = torch.from_numpy(random.integers(1, 4, (60, 80)).astype(np.int32))
    features = torch.from_numpy(100 + 1e-3 * random.normal(size=(60, 80, 8))).float()
    ours = instance_loss(features, labels, w_neg=0.0)
    exact = features.double().requires_grad_()
    pos = torch_instance(exact, labels)[0]
    assert abs(ours.pos / pos.item() - 1) < 1e-6
    expected = torch.autograd.grad(pos, exact)[0]
    assert (ours.gradient - expected).abs().max() < 1e-5 * expected.abs().max()


def test_equal_prototypes_have_a_finite_gradient():
    features = torch.ones(4, 6, 3, dtype=torch.float64)
    labels = torch.arange(24).reshape(4, 6) % 2 + 1
    loss = instance_loss(features, labels)
    assert loss.neg == 1
    assert loss.gradient.abs().max() == 0


def test_gradcheck():
    features, labels = scene(5, 6, 3, 3)

    def run(f):
        loss = instance_loss(f, labels, margin=2.0, w_pos=0.7, w_neg=1.3)
        return known(loss.value, [loss.gradient], f)

    assert torch.autograd.gradcheck(run, (features,), eps=1e-6, atol=1e-8)


def test_same_bits_for_any_thread_count():
    features, labels = scene(120, 331, 8, 40)
    features = features.detach().float().reshape(-1, 8)
    a = assign_labels(labels)
    outputs = []
    for threads in (1, 2, 5, 16):
        means, scatter = torch.empty(40, 8, dtype=torch.float64), torch.empty(40, dtype=torch.float64)
        _core.training.prototypes(features, a.slots, a.counts, a.first, means, scatter, threads)
        out = torch.empty_like(features)
        _core.training.spread(features, a.slots, means, scatter, means, out, threads)
        outputs.append((means, scatter, out, _core.training.sum(features.reshape(-1), True, threads)))
    for other in outputs[1:]:
        assert all(torch.equal(x, y) for x, y in zip(outputs[0][:3], other[:3], strict=True))
        assert outputs[0][3] == other[3]


def test_instruction_sets_agree():
    features, labels = scene(50, 60, 8, 5)
    features = features.detach().float().reshape(-1, 8)
    a = assign_labels(labels)
    reference = None
    for level in _core.simd_levels():
        means, scatter = torch.empty(5, 8, dtype=torch.float64), torch.empty(5, dtype=torch.float64)
        _core.training.prototypes(features, a.slots, a.counts, a.first, means, scatter, 1, level)
        reference = reference or (means, scatter)
        assert (means - reference[0]).abs().max() < 1e-14
        assert (scatter / reference[1] - 1).abs().max() < 1e-13


@pytest.mark.parametrize("shape", [(1, 1, 1), (7, 9, 1), (33, 41, 8), (5, 3, 32)])
def test_variance_loss(shape):
    variance = torch.from_numpy(np.random.default_rng(7).random(shape)).requires_grad_()
    (ours, gradient), expected = variance_loss(variance, 2.0), 2 * (variance**2).sum(2).mean()
    assert abs(ours - expected.item()) < 1e-13
    assert (gradient - torch.autograd.grad(expected, variance)[0]).abs().max() < 1e-15


def test_negative_labels_and_other_shapes_are_refused():
    features, labels = scene()
    with pytest.raises(ValueError, match="labels must be >= 0"):
        assign_labels(labels - 5)
    with pytest.raises(ValueError, match="slots"):
        instance_loss(features, labels[:3])

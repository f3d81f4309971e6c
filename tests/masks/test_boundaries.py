"""The network of object borders against convolutions in float64 by scipy, and on a scene whose things are known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from scipy.signal import correlate

from perception.masks.boundaries import REACH, boundaries, forward, inputs_of, read_layers, scaled
from perception.masks.cues import depth_cues, photo_cues

K = np.array([[200.0, 0, 80], [0, 200, 60], [0, 0, 1]])


def shown(shadow: bool = False) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A ball before a wall of fine texture: photo [120, 160, 3], z-depth and ids (1 wall, 2 ball); or its shadow."""
    y, x = np.mgrid[:120, :160] + 0.5
    rays = np.stack([(x - 80) / 200, (y - 60) / 200, np.ones_like(x)], axis=-1)
    middle = np.array([0.0, 0.0, 1.0])
    a, b, c = (rays**2).sum(-1), rays @ middle, (middle**2).sum() - 0.15**2
    inside = b**2 - a * c > 0
    near = (b - np.sqrt(np.where(inside, b**2 - a * c, 0))) / a
    ids = np.where(inside, 2, 1)
    texture = np.random.default_rng(0).normal(0, 4, (120, 160, 1))
    wall, ball = np.array([150.0, 140, 130]), np.array([160.0, 40, 40])
    light = 1 - 0.4 * cv2.GaussianBlur(inside.astype(float), (0, 0), 4)[..., None]  # a lamp is no point
    photo = wall * light + texture if shadow else np.where(inside[..., None], ball, wall) + texture
    depth = np.where(inside & (not shadow), near, 1.2).astype(np.float32)
    return photo.clip(0, 255).astype(np.uint8), depth, ids


def test_the_network_against_convolutions_in_float64():
    rng = np.random.default_rng(1)
    inputs = rng.integers(0, 256, (1, 11, 48, 64)).astype(np.uint8)
    layers = read_layers()

    def enlarged(x: np.ndarray, size: tuple[int, int]) -> np.ndarray:
        return np.stack([cv2.resize(image, size[::-1], interpolation=cv2.INTER_LINEAR) for image in x])

    parts = iter([(weight.double().numpy(), offset.double().numpy()) for weight, offset in layers])

    def layer(x: np.ndarray, stride: int = 1) -> np.ndarray:
        weight, offset = next(parts)
        padded = np.pad(x, ((0, 0), (1, 1), (1, 1)))
        rows = [correlate(padded, kernel, mode="valid")[0] for kernel in weight]
        return np.maximum(np.stack(rows)[:, ::stride, ::stride] + offset[:, None, None], 0)

    x, kept = inputs[0] / 127.5 - 1, []
    for _ in range(4):
        x = layer(layer(x, 2))
        kept.append(x)
    for skip in kept[2::-1]:
        x = layer(layer(np.concatenate([enlarged(x, skip.shape[1:]), skip])))
    weight, offset = next(parts)
    expected = enlarged(np.einsum("oc,chw->ohw", weight[..., 0, 0], x) + offset[:, None, None], (48, 64))
    found = forward(layers, scaled(torch.from_numpy(inputs)))[0].numpy()
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())  # float32, 15 layers


def test_borders_are_where_a_ball_ends_and_not_where_its_shadow_does():
    photo, depth, ids = shown()
    odds = boundaries(photo_cues(photo), depth_cues(depth, K), read_layers())
    for told, image in ((odds[0], ids), (odds[1].T, ids.T)):
        differ = image[:, : -2 * REACH] != image[:, 2 * REACH :]
        inner = told[:, REACH:-REACH]
        assert np.median(inner[differ]) > 0 and (inner[~differ] < 0).mean() > 0.97
    assert np.median(odds[2][ids == 2]) > 0 > np.median(odds[2][ids == 1])
    photo, depth, ids = shown(shadow=True)
    odds = boundaries(photo_cues(photo), depth_cues(depth, K), read_layers())
    assert (odds[:2] < 0).mean() > 0.97


@pytest.mark.parametrize("size", [(120, 160), (37, 21), (9, 320)])
def test_borders_have_the_same_bits_for_any_number_of_threads(size):
    photo, depth, _ = shown()
    photo, depth = (cv2.resize(image, size[::-1]) for image in (photo, depth))
    cues, before, found = (photo_cues(photo), depth_cues(depth, K)), torch.get_num_threads(), []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        found.append(boundaries(*cues, read_layers()))
    torch.set_num_threads(before)
    assert found[0].shape == (3, *size) and np.isfinite(found[0]).all()
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


def test_inputs_do_not_depend_on_the_unit_of_depth():
    photo, depth, _ = shown()
    metres, feet = (inputs_of(photo_cues(photo), depth_cues(depth * unit, K)) for unit in (1.0, 3.28084))
    assert (np.abs(metres.astype(int) - feet) <= 1).mean() > 0.999

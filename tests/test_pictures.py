"""Pictures: separation of the palette, and the other helpers against what they must show by definition."""

from __future__ import annotations

import colorsys
import math

import numpy as np
from skimage.color import deltaE_ciede2000, rgb2lab

from perception import pictures
from perception.colors import GREY, instance_palette, rgb8_from_sh, rgb_from_sh, sh_from_rgb


def test_palette_is_stable_separated_and_grey_for_none() -> None:
    colors = instance_palette(24)
    np.testing.assert_array_equal(instance_palette([7, -1, 3]), [colors[7], GREY, colors[3]])
    lab = rgb2lab(np.concatenate([colors, GREY[None]])[None] / 255.0)[0]
    distance = deltaE_ciede2000(lab[:, None], lab[None])[np.triu_indices(25, 1)]
    assert distance.min() > 5  # told apart side by side; 2.3 is about the least difference seen
    neighbours = deltaE_ciede2000(lab[:23], lab[1:24])
    assert neighbours.min() > 20
    assert instance_palette(0).shape == (0, 3)


def test_palette_is_the_hsv_formula_of_the_standard_library() -> None:
    """Byte for byte: an instance has one colour in reports, clouds, the viewer and ROS messages."""
    for i, color in enumerate(instance_palette(200)):
        saturation, value = (0.80, 0.55, 0.95)[i // 8 % 3], (0.95, 0.78, 0.62)[(i // 8 + i // 24) % 3]
        rgb = colorsys.hsv_to_rgb((0.02 + i * 0.6180339887498949) % 1.0, saturation, value)
        assert color.tolist() == [round(255 * c) for c in rgb]


def test_colours_of_the_constant_harmonic() -> None:
    """c = 1/2 + k / (2 √π) (Kerbl et al. 2023, the degree 0 term of the real spherical harmonics)."""
    sh = np.array([[0.0, 1.0, -9.0], [9.0, 0.3, -0.3]])
    rgb = 0.5 + sh / (2 * math.sqrt(math.pi))
    np.testing.assert_allclose(rgb_from_sh(sh), rgb, atol=1e-15)
    np.testing.assert_allclose(sh_from_rgb(rgb), sh, atol=1e-14)
    np.testing.assert_array_equal(rgb8_from_sh(sh), np.round(255 * rgb.clip(0, 1)))


def test_instances_and_overlay() -> None:
    ids = np.array([[-1, -1, 2, 2]] * 4)
    photo = np.full((4, 4, 3), 90, np.uint8)
    laid = pictures.overlay(photo, ids, 0.5)
    np.testing.assert_array_equal(laid[:, 0], photo[:, 0])
    assert (laid[:, 2] == 255).all()
    np.testing.assert_array_equal(laid[0, 3], np.round((90.0 + instance_palette([2])[0]) / 2))


def test_error_map_is_dark_where_equal_and_bright_where_not() -> None:
    a = np.zeros((8, 8, 3), np.uint8)
    b = a.copy()
    b[2, 5] = 255
    error = pictures.error_map(a, b)
    assert error.sum(-1).argmax() == 2 * 8 + 5 and (error[0, 0] < 10).all()


def test_features_to_rgb_ignores_rotation_up_to_axis_signs() -> None:
    rng = np.random.default_rng(0)
    features = rng.standard_normal((40, 30, 8)) * np.array([9, 5, 3, 1, 1, 1, 0.5, 0.1])
    turn, _ = np.linalg.qr(rng.standard_normal((8, 8)))
    a = pictures.features_to_rgb(features).astype(int)
    b = pictures.features_to_rgb(features @ turn).astype(int)
    for k in range(3):
        assert min(np.abs(a[..., k] - b[..., k]).max(), np.abs(255 - a[..., k] - b[..., k]).max()) <= 1
    assert pictures.features_to_rgb(features[..., :2]).shape == (40, 30, 3)
    assert pictures.features_to_rgb(features[:1, :1]).tolist() == [[[0, 0, 0]]]  # one pixel has no components


def test_outline_and_row() -> None:
    photo = np.full((40, 60, 3), 200, np.uint8)
    mask = np.zeros((40, 60), bool)
    mask[10:30, 20:40] = True
    drawn = pictures.outline(photo, mask)
    assert (drawn[20, 30] == 200).all() and (drawn[2, 2] == 110).all() and (drawn[10, 30] != 200).any()
    sheet = pictures.titled_row([photo, drawn], ["one", "two"])
    assert sheet.shape == (6 + 22 + 40 + 6, 2 * 66 + 6, 3)
    np.testing.assert_array_equal(sheet[28:68, 72:132], drawn)

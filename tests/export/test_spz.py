"""`.spz`, against a decoder written from the format's description, within what its bits can hold."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from perception.cli import main
from perception.errors import InputError
from perception.export.export_map import ExportOptions, export_map
from perception.export.spz import FLIPS, spz_bytes
from perception.map.write import Map, read_map, write_map
from perception.rasterizer.rasterize import rasterize
from support.compressed import read_spz
from support.query_maps import write_map_of

SHIFT = np.array([1, -1, -1])


def a_map(degree: int = 3, size: float = 5.0, count: int = 200) -> Map:
    rng = np.random.default_rng(degree)
    quats = rng.normal(size=(count, 4)).astype(np.float32)
    return Map(
        means=rng.uniform(-size, size, (count, 3)).astype(np.float32),
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        log_scales=rng.uniform(-8, 2, (count, 3)).astype(np.float32),
        opacity_logits=rng.normal(0, 3, count).astype(np.float32),
        sh=rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2, 3)).astype(np.float32),
        features=np.zeros((count, 1), np.float32),
        instance_ids=np.arange(count, dtype=np.int32) - 1,
        membership=np.ones(count, np.float32),
    )


@pytest.mark.parametrize(("degree", "size"), [(0, 5.0), (1, 0.1), (3, 5.0), (3, 3000.0), (0, 4e6)])
def test_values_are_what_the_bits_can_hold(degree: int, size: float) -> None:
    gmap = a_map(degree, size)
    found = read_spz(spz_bytes(gmap))
    bits = min(12, 22 - math.ceil(math.log2(max(1, size))))
    assert np.abs(found["means"] - gmap.means * SHIFT).max() <= 0.5 / 2**bits
    assert np.abs(found["opacities"] - gmap.opacities).max() <= 0.5 / 255 + 1e-6
    assert np.abs(found["dc"] - gmap.sh[:, 0]).max() <= 0.5 / 255 / 0.15 + 1e-6
    assert np.abs(found["log_scales"] - gmap.log_scales).max() <= 0.5 / 16 + 1e-6
    wanted = gmap.quats * np.where(gmap.quats[:, :1] < 0, -1, 1) * [1, 1, -1, -1]
    assert np.abs(found["quats"][:, 1:] - wanted[:, 1:]).max() <= 0.5 / 127.5 + 1e-6
    if degree:
        bound = np.where(np.arange(found["sh"].shape[1]) < 3, 4.5 / 128, 8.5 / 128)[:, None]
        flipped = gmap.sh[:, 1:] * FLIPS[: found["sh"].shape[1], None]
        assert (np.abs(found["sh"] - flipped) <= bound + 1e-6).all()


def test_the_flipped_scene_seen_from_the_flipped_camera_is_the_same_picture() -> None:
    """Signs of rotations and harmonics: against the rasterizer, with the values before they are rounded."""
    gmap, turn = a_map(3, 0.8, 60), np.diag([1.0, -1, -1, 1])
    quats = gmap.quats * np.array([1, 1, -1, -1], np.float32)
    sh = gmap.sh * np.concatenate([[1], FLIPS[:15]]).astype(np.float32)[:, None]
    pose = np.eye(4)
    pose[2, 3] = 3.0
    K = torch.tensor([[[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]])
    scales = torch.from_numpy(np.exp(gmap.log_scales.clip(-4, -1.5)))
    pictures = []
    for means, rotations, colors, camera in (
        (gmap.means, gmap.quats, gmap.sh, pose),
        (gmap.means * SHIFT.astype(np.float32), quats, sh, pose @ turn),
    ):
        tensors = [
            torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in (means, rotations, colors, camera[None])
        ]
        opacities = torch.from_numpy(gmap.opacities)
        out = rasterize(tensors[0], tensors[1], scales, opacities, tensors[2], tensors[3], K, 64, 48, sh_degree=3)
        pictures.append(out.colors[0].numpy())
    assert np.abs(pictures[0] - pictures[1]).max() < 1e-4 and pictures[0].std() > 0.05


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_map_of(tmp_path / "a.gsmap")
    assert main(["export", str(path), "-o", str(tmp_path / "a.spz")]) == 0
    gmap = read_map(path)
    found = read_spz((tmp_path / "a.spz").read_bytes())
    assert len(found["means"]) == len(gmap)
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), gmap.instance_ids)
    assert "3000 Gaussians" in capsys.readouterr().out
    assert main(["export", str(path), "-o", str(tmp_path / "b.spz"), "--points", str(path)]) == 2
    assert "labels of a scan" in capsys.readouterr().err


def test_a_value_that_no_bits_hold_is_told(tmp_path: Path) -> None:
    gmap = a_map()
    gmap.means[3, 1] = -5e6
    with pytest.raises(InputError, match=r"a Gaussian lies 5e\+06 from the origin, at most 4194304 is held"):
        spz_bytes(gmap)
    gmap.means[3] = np.nan
    with pytest.raises(InputError, match="means of some Gaussians are not finite"):
        spz_bytes(gmap)


def test_opacities_of_1_and_flat_gaussians_are_written() -> None:
    """Their logits and logarithms are infinite, as trainers and converters leave them."""
    gmap = a_map()
    gmap.opacity_logits[:2] = np.inf, -np.inf
    gmap.log_scales[0, 2] = -np.inf
    found = read_spz(spz_bytes(gmap))
    assert found["opacities"][:2].tolist() == [1, 0] and found["log_scales"][0, 2] == -10


@pytest.mark.parametrize(("far", "told"), [(200.0, None), (1e5, "rounded by up to 0.016")])
def test_positions_that_a_far_gaussian_makes_coarse_are_told(far: float, told: str | None, tmp_path: Path) -> None:
    path = write_map_of(tmp_path / "a.gsmap")
    gmap = read_map(path)
    gmap.means[0] = far
    write_map(path, gmap)
    _, text = export_map(path, tmp_path / "a.spz", None, ExportOptions())
    assert (told or "Gaussians") in text and ("rounded" in text) == bool(told)
    found = read_spz((tmp_path / "a.spz").read_bytes())["means"] * SHIFT
    worst = np.abs(found - gmap.means).max()
    assert worst <= 0.016 and (worst > 2e-3) == bool(told)

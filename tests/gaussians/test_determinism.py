"""A seeded map is the same map, byte for byte, whatever the number of threads."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from perception._core.training import activate
from perception.cli import main
from perception.config import load_config
from perception.gaussians.model import exponential, sigmoid
from perception.io.cloud import read_cloud, write_cloud
from perception.map.write import read_map
from perception.pipeline.mapping import build_map
from perception.rasterizer.cpu import simd_levels
from perception.types import PointCloud

PAIRS = ["train.iterations=100", "train.budget=3000", "densify.every=10", "photos.holdout=6"]
PAIRS += ["instances.min_cluster_size=15", "instances.min_samples=5", "language.encoder=none"]
U = 2.0**-24
FILES = ("gaussians.ply", "features.npy", "instance_ids.npy", "membership.npy", "instances.json")


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch):
    """Sets torch's number of threads, which the kernels follow; it is put back afterwards."""
    import torch

    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def thin(small_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small scene with one point in forty, so that the map has to grow."""
    folder = tmp_path_factory.mktemp("thin")
    cloud = read_cloud(small_scene / "truth" / "gt_points.ply")
    assert cloud.colors is not None
    write_cloud(folder / "points.ply", PointCloud(cloud.points[::40], cloud.colors[::40]))
    cameras = json.loads((small_scene / "transforms.json").read_text())
    for frame in cameras["frames"]:
        frame["file_path"] = str(small_scene / frame["file_path"])
    source = folder / "transforms.json"
    source.write_text(json.dumps({**cameras, "ply_file_path": str(folder / "points.ply")}))
    return source


@pytest.mark.slow
def test_a_seeded_map_is_the_same_for_one_two_and_three_threads(
    thin: Path, small_scene: Path, tmp_path: Path, threads
) -> None:
    """And another seed is another map, else this would show nothing."""
    words = ["map", str(thin), "--masks", f"labels:{small_scene / 'labels'}", *(f"--set={pair}" for pair in PAIRS)]
    for count, seed in ((1, 5), (2, 5), (3, 5), (4, 6)):
        threads(min(count, 3))
        assert main([*words, "--seed", str(seed), "-o", str(tmp_path / f"{count}.gsmap")]) == 0
    one, other = (read_map(tmp_path / f"{count}.gsmap") for count in (1, 4))
    assert len(one) != len(other) or not np.array_equal(one.means, other.means)
    for count in (2, 3):
        for name in FILES:
            assert (tmp_path / "1.gsmap" / name).read_bytes() == (tmp_path / f"{count}.gsmap" / name).read_bytes(), name
        other = read_map(tmp_path / f"{count}.gsmap")
        assert one.info["quality"] == other.info["quality"]
        assert one.info["training"]["decisions"] == other.info["training"]["decisions"]
        assert np.array_equal(one.poses, other.poses)
    assert 700 < len(one) <= 3000 and any("holes" in told for told in one.info["training"]["decisions"])


@pytest.mark.slow
def test_so_is_one_of_more_gaussians_than_torch_gives_one_thread(small_scene: Path, tmp_path: Path, threads) -> None:
    """Above 32,768 elements torch shares an operation out, and some of its results depend on where the shares end."""
    cloud = read_cloud(small_scene / "truth" / "gt_points.ply")
    assert cloud.colors is not None
    count = 40_001
    rows = np.arange(count) % len(cloud.points)
    points = cloud.points[rows] + np.random.default_rng(0).normal(0, 0.002, (count, 3))
    write_cloud(tmp_path / "points.ply", PointCloud(points, cloud.colors[rows]))
    cameras = json.loads((small_scene / "transforms.json").read_text())
    for frame in cameras["frames"]:
        frame["file_path"] = str(small_scene / frame["file_path"])
    source = tmp_path / "transforms.json"
    source.write_text(json.dumps({**cameras, "ply_file_path": str(tmp_path / "points.ply")}))
    pairs = ["train.iterations=12", "train.budget=50000", "densify.every=4", "language.encoder=none"]
    pairs.append(f"masks=labels:{small_scene / 'labels'}")
    for number in (1, 2):
        threads(number)
        build_map(source, tmp_path / f"{number}.gsmap", load_config(None, pairs))
    assert len(read_map(tmp_path / "1.gsmap")) > 2**15
    for name in FILES:
        assert (tmp_path / "1.gsmap" / name).read_bytes() == (tmp_path / "2.gsmap" / name).read_bytes(), name


@pytest.mark.parametrize("level", simd_levels())
def test_activations_have_the_same_bits_with_any_threads_and_are_those_of_float64(level) -> None:
    """torch's fail at about half of these sizes."""
    random = np.random.default_rng(0)
    for size in [*range(2**15 + 1, 2**15 + 25), 3 * 2**16 + 5]:
        values = (12 * random.standard_normal(size)).clip(-87, 87).astype(np.float32)
        exact = np.exp(values.astype(np.float64))
        for logistic, wanted in ((False, exact), (True, 1 / (1 + np.exp(-values.astype(np.float64).clip(-80, 80))))):
            found = np.empty((3, size), np.float32)
            for threads in (1, 2, 3):
                activate(values, logistic, found[threads - 1], threads=threads, level=level)
            assert np.array_equal(found[0], found[1]) and np.array_equal(found[0], found[2]), size
            np.testing.assert_allclose(found[0], wanted, rtol=8 * U)  # exp within 4 U, a sum, a quotient


def test_activations_of_what_no_scale_should_be() -> None:
    far = torch.tensor([-torch.inf, -1e30, -100.0, 88.5, 1e30, torch.inf, torch.nan])
    scales, opacities = exponential(far), sigmoid(far)
    assert scales[3:6].isinf().all() and (scales[:3] >= 0).all() and (scales[:3] < 1e-37).all()
    faintest = torch.full((3,), np.exp(-80.0), dtype=torch.float64)
    torch.testing.assert_close(opacities[:3].double(), faintest, rtol=1e-6, atol=0)
    assert opacities[3:6].tolist() == [1, 1, 1] and scales[6].isnan() and opacities[6].isnan()
    double = torch.linspace(-700, 700, 1001, dtype=torch.float64)
    torch.testing.assert_close(exponential(double), torch.exp(double), rtol=1e-15, atol=0)

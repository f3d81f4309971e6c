"""`.sog`, against a decoder written from the format's description, within what its bits and codebooks can hold."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from sklearn.cluster import KMeans

from export.test_spz import a_map
from perception.cli import main
from perception.errors import InputError
from perception.export import sog
from perception.export.sog import codebook, palette, sog_bytes, spatial_order, write_sog
from perception.instances import segments
from perception.map.write import read_map
from support.compressed import read_sog
from support.query_maps import write_map_of


@pytest.mark.parametrize(("degree", "size", "count"), [(0, 5.0, 1), (1, 0.1, 17), (3, 5.0, 250), (2, 3000.0, 64)])
def test_values_are_what_the_format_can_hold(
    degree: int, size: float, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sog, "SHARE", 1)  # every Gaussian's harmonics are in the palette
    gmap = a_map(degree, size, count)
    order = np.random.default_rng(0).permutation(count)
    found = read_sog(sog_bytes(gmap, order))
    # A step of the stretched coordinate, ln(1 + |x|) in 16 bits, is (1 + |x|) times as long at x. Rounding: half of it.
    step = 2 * np.log1p(size) / 65535
    assert (np.abs(found["means"] - gmap.means[order]) <= 0.51 * step * (1 + np.abs(gmap.means[order])) + 1e-6).all()
    assert np.abs(found["opacities"] - gmap.opacities[order]).max() <= 0.5 / 255 + 1e-6
    turned = np.abs((found["quats"] * gmap.quats[order]).sum(axis=1))
    assert turned.min() > 1 - 3 * (0.5 / 255 * np.sqrt(2)) ** 2  # three components, and the fourth that follows
    for name, values in (("log_scales", gmap.log_scales), ("dc", gmap.sh[:, 0]), ("sh", gmap.sh[:, 1:])):
        spread = float(np.ptp(values)) if values.size else 0.0
        assert np.abs(found[name] - values[order]).max(initial=0) <= 2 * spread / 255 + 1e-6  # even steps leave 1/2


def test_near_gaussians_are_near_each_other_in_the_file() -> None:
    """The order of interleaved bits, against a loop over them."""
    means = np.random.default_rng(1).uniform(-3, 9, (300, 3))
    size = (means - means.min(axis=0)).max()

    def code(point: np.ndarray) -> int:
        cell = [int(x) for x in (point - means.min(axis=0)) / size * (2**21 - 1)]
        return sum(((cell[axis] >> bit) & 1) << (3 * bit + axis) for bit in range(21) for axis in range(3))

    assert spatial_order(means).tolist() == sorted(range(300), key=lambda row: code(means[row]))
    assert spatial_order(np.zeros((4, 3))).tolist() == [0, 1, 2, 3] and len(spatial_order(np.zeros((0, 3)))) == 0


def test_a_codebook_holds_few_values_as_they_are_and_others_as_another_k_means_does() -> None:
    rng = np.random.default_rng(2)
    few = np.rint(rng.normal(size=(900, 3)) * 20) / 20  # about 130 values, most of them often
    codes, nearest = codebook(few)
    np.testing.assert_allclose(np.array(codes)[nearest], few, atol=1e-9)
    for many in (rng.standard_cauchy((2000, 3)).clip(-50, 50), rng.normal(size=(2000, 3)), rng.uniform(size=(2000, 3))):
        codes, nearest = codebook(many)
        assert len(codes) == 256 and codes == sorted(codes)
        np.testing.assert_array_equal(nearest, np.abs(many[..., None] - codes).argmin(axis=-1))
        theirs = KMeans(256, n_init=1, random_state=0).fit(many.reshape(-1, 1)).inertia_ / many.size
        assert np.square(np.array(codes)[nearest] - many).mean() < 2 * theirs  # both stop in some local minimum


def test_a_palette_finds_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segments, "CHUNK", 50)
    rng = np.random.default_rng(3)
    kinds = rng.normal(size=(9, 24))
    member = rng.integers(0, 9, 800)
    rows = kinds[member] + rng.normal(0, 0.01, (800, 24))
    centroids, labels = palette(rows)
    assert len(centroids) == 100
    distance = np.linalg.norm(rows[:, None] - centroids[None], axis=2)
    np.testing.assert_allclose(distance[np.arange(800), labels], distance.min(axis=1), atol=1e-5)
    assert np.abs(centroids[labels] - kinds[member]).max() < 0.05


def test_the_same_map_gives_the_same_bytes_and_none_is_fine(tmp_path: Path) -> None:
    gmap = a_map(3, 2.0, 500)
    order = spatial_order(gmap.means)
    assert sog_bytes(gmap, order) == sog_bytes(gmap, order)
    empty = a_map(1, 1.0, 0)
    assert len(read_sog(sog_bytes(empty, spatial_order(empty.means)))["means"]) == 0
    with pytest.raises(InputError, match="means of some Gaussians are not finite"):
        gmap.means[3] = np.inf
        write_sog(tmp_path / "x.sog", gmap)
    assert not list(tmp_path.iterdir())


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_map_of(tmp_path / "a.gsmap")
    assert main(["export", str(path), "-o", str(tmp_path / "a.sog")]) == 0
    gmap, ids = read_map(path), np.load(tmp_path / "a.npy")
    means = read_sog((tmp_path / "a.sog").read_bytes())["means"]
    nearest = np.linalg.norm(gmap.means[None] - means[::100, None], axis=2).argmin(axis=1)
    np.testing.assert_array_equal(ids[::100], gmap.instance_ids[nearest])
    assert zipfile.is_zipfile(tmp_path / "a.sog") and "3000 Gaussians" in capsys.readouterr().out

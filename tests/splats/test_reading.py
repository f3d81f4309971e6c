"""Finished splats as tools write them: every coding read to the same Gaussians, and what is none told in one line."""

from __future__ import annotations

import gzip
import struct
import tracemalloc
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard
from plyfile import PlyData, PlyElement

from perception.errors import InputError
from perception.splats.read import read_splat
from perception.splats.spz import MAGIC

COUNT = 300
STANDARD = ("x", "y", "z", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")


def columns(degree: int = 1, seed: int = 0) -> dict[str, np.ndarray]:
    """The properties of 3DGS by name, in its order."""
    rng = np.random.default_rng(seed)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))] + list(STANDARD[3:])
    values = {name: rng.normal(size=COUNT).astype(np.float32) for name in names}
    for i in range(3):
        values[f"scale_{i}"] = rng.uniform(-5, -3, COUNT).astype(np.float32)
    return values


def write(path: Path, values: dict[str, np.ndarray], text: bool = False, order: str = "<") -> Path:
    """By plyfile, which is not the writer under test."""
    rows = np.empty(len(next(iter(values.values()))), [(name, array.dtype.str) for name, array in values.items()])
    for name, array in values.items():
        rows[name] = array
    PlyData([PlyElement.describe(rows, "vertex")], text=text, byte_order=order).write(str(path))
    return path


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_all_degrees_are_read_bit_for_bit(tmp_path: Path, degree: int) -> None:
    values = columns(degree)
    splat = read_splat(write(tmp_path / "a.ply", values))
    assert np.array_equal(splat.means, np.stack([values[n] for n in "xyz"], axis=1))
    assert np.array_equal(splat.opacity_logits, values["opacity"])
    assert np.array_equal(splat.log_scales[:, 1], values["scale_1"])
    assert np.array_equal(splat.quats[:, 3], values["rot_3"])
    size = (degree + 1) ** 2 - 1
    for channel in range(3):
        assert np.array_equal(splat.sh[:, 0, channel], values[f"f_dc_{channel}"])
        for k in range(size):
            assert np.array_equal(splat.sh[:, 1 + k, channel], values[f"f_rest_{channel * size + k}"])


@pytest.mark.parametrize(("text", "order"), [(True, "="), (False, ">")])
def test_texts_and_the_other_byte_order(tmp_path: Path, text: bool, order: str) -> None:
    values = columns()
    splat = read_splat(write(tmp_path / "a.ply", values, text, order))
    assert np.allclose(splat.means[:, 2], values["z"], rtol=1e-6)


def changed(**change: Callable[[dict[str, np.ndarray]], np.ndarray | None]) -> dict[str, np.ndarray]:
    values = columns(0)
    for name, function in change.items():
        new = function(values)
        if new is None:
            values.pop(name, None)
        else:
            values[name] = new
    return values


def test_values_that_are_activated_already(tmp_path: Path) -> None:
    plain = columns(0)
    scales = {f"scale_{i}": (lambda v, i=i: np.exp(v[f"scale_{i}"])) for i in range(3)}
    values = changed(opacity=lambda v: 1 / (1 + np.exp(-v["opacity"])), **scales)
    splat = read_splat(write(tmp_path / "a.ply", values))
    assert np.allclose(splat.opacity_logits, plain["opacity"], atol=1e-5)
    assert np.allclose(splat.log_scales[:, 2], plain["scale_2"], atol=1e-5)
    assert len(splat.notes) == 2


@pytest.mark.parametrize("unit", [1.0, 20.0, 1000.0])
def test_lengths_are_no_logarithms_however_large_the_scene(unit: float, tmp_path: Path) -> None:
    """A scene of the same density that is 1 to 1000 units wide: in metres, wider, and in millimetres."""
    lengths = {f"scale_{i}": (lambda v, i=i: unit * np.exp(v[f"scale_{i}"])) for i in range(3)}
    wide = {name: (lambda v, n=name: v[n] * unit) for name in "xyz"}
    splat = read_splat(write(tmp_path / "a.ply", changed(**lengths, **wide)))
    assert np.allclose(splat.log_scales[:, 1], columns(0)["scale_1"] + np.log(unit), atol=1e-5)
    sparse = changed(
        **{f"scale_{i}": (lambda v, i=i: np.exp(v[f"scale_{i}"])) for i in range(3)}, x=lambda v: 1e4 * v["x"]
    )
    assert np.allclose(read_splat(write(tmp_path / "b.ply", sparse)).log_scales[:, 1], columns(0)["scale_1"], atol=1e-5)


def test_opacities_by_their_absolute_values_and_rounded_above_1(tmp_path: Path) -> None:
    """Taming 3DGS draws |opacity|."""
    share = 1 / (1 + np.exp(-columns(0)["opacity"]))
    signed = np.where(np.arange(COUNT) % 2, share, -share)
    signed[0] = 1.0004
    splat = read_splat(write(tmp_path / "a.ply", changed(opacity=lambda v: signed)))
    assert np.allclose(1 / (1 + np.exp(-splat.opacity_logits[1:])), share[1:], atol=1e-5)
    assert splat.opacity_logits[0] > 10 and "by their absolute values" in splat.notes[0]


def test_the_filter_of_mip_splatting_is_part_of_what_is_drawn(tmp_path: Path) -> None:
    """A 3D Gaussian of covariance S convolved with one of σ² I keeps its integral, opacity √|S|, and has S + σ² I."""
    plain = columns(0)
    sigma = np.linspace(0.001, 0.05, COUNT)
    splat = read_splat(write(tmp_path / "a.ply", changed(filter_3D=lambda v: sigma)))
    sizes = np.exp(np.stack([plain[f"scale_{i}"] for i in range(3)], axis=1))
    wider = np.sqrt(sizes**2 + sigma[:, None] ** 2)
    assert np.allclose(np.exp(splat.log_scales), wider, rtol=1e-5)
    opacity, old = (1 / (1 + np.exp(-values.astype(np.float64))) for values in (splat.opacity_logits, plain["opacity"]))
    assert np.allclose(opacity * wider.prod(axis=1), old * sizes.prod(axis=1), rtol=1e-4)
    assert "filter_3D" in splat.notes[0]


def test_large_units_do_not_make_logarithms_lengths(tmp_path: Path) -> None:
    """A scene in millimetres has positive logarithms."""
    values = changed(**{name: (lambda v, n=name: v[n] * 1000) for name in "xyz"})
    values |= {f"scale_{i}": values[f"scale_{i}"] + 7 for i in range(3)}
    splat = read_splat(write(tmp_path / "a.ply", values))
    assert np.array_equal(splat.log_scales[:, 0], values["scale_0"])


def test_missing_properties_that_have_a_meaning(tmp_path: Path) -> None:
    rot = {f"rot_{i}": (lambda v: None) for i in range(4)}
    gone = {f"f_dc_{i}": (lambda v: None) for i in range(3)}
    colors = {name: (lambda v: np.full(COUNT, 51, np.uint8)) for name in ("red", "green", "blue")}
    splat = read_splat(write(tmp_path / "a.ply", changed(scale_2=lambda v: None, **rot, **gone, **colors)))
    assert np.array_equal(splat.quats, np.tile([1, 0, 0, 0], (COUNT, 1)))
    assert np.allclose(0.5 + 0.28209479 * splat.sh[:, 0], 0.2, atol=1e-6)
    assert np.all(splat.log_scales[:, 2] < splat.log_scales[:, :2].min(axis=1) - 6)


def test_rows_that_are_no_numbers_are_kept_and_counted(tmp_path: Path) -> None:
    values = columns(0)
    values["x"][3], values["opacity"][5], values["scale_1"][7], values["rot_0"][9] = np.nan, np.nan, np.inf, np.inf
    values["opacity"][11] = np.inf  # opaque, as some tools write it
    values["f_dc_1"][13], values["y"] = np.inf, values["y"].astype(np.float64)
    values["y"][15], values["z"][17] = 1e300, np.inf
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        splat = read_splat(write(tmp_path / "a.ply", values))
    assert np.flatnonzero(splat.parked).tolist() == [3, 5, 7, 9, 13, 15, 17]
    assert len(splat) == COUNT
    with np.errstate(all="raise", under="ignore"):  # a warning would reach the user
        assert np.all(1 / (1 + np.exp(-splat.opacity_logits[splat.parked])) < 1e-30)
    assert all(np.isfinite(splat.arrays()[name]).all() for name in ("means", "quats", "sh"))
    assert any("7 Gaussians that are not finite" in note for note in splat.notes)


def test_positions_that_float32_cannot_hold_are_refused(tmp_path: Path) -> None:
    """5.4 million metres north, as of a georeferenced scene: neighbouring float32 numbers are half a metre apart."""
    for north, refused in ((5.4e6, True), (5.4e3, False)):
        path = write(tmp_path / "a.ply", changed(y=lambda v, n=north: v["y"].astype(np.float64) + n))
        if refused:
            with pytest.raises(InputError, match=r"rounds positions by 0.1\d, and σ is 0.018; move the scene"):
                read_splat(path)
        else:
            assert len(read_splat(path)) == COUNT


def turned(degree: int) -> np.ndarray:
    """[K] signs of the harmonics of degrees 1 and more when y and z change sign: Y_lm has the parity of m + l in z, and
    is odd in y where m is negative."""
    return np.array([(-1) ** (m + n) * (-1 if m < 0 else 1) for n in range(1, degree + 1) for m in range(-n, n + 1)])


def spz_of(version: int, count: int = 100, degree: int = 1) -> tuple[bytes, dict[str, np.ndarray]]:
    """A file of a version, and its values in the axes of the PLY, written from the format's description."""
    rng = np.random.default_rng(version)
    k = (degree + 1) ** 2 - 1
    fixed = rng.integers(-(2**14), 2**14, (count, 3))
    alphas, colors, scales, rest = (rng.integers(1, 255, (count, n)).astype(np.uint8) for n in (1, 3, 3, 3 * k))
    quats = rng.normal(size=(count, 4))
    quats *= np.sign(np.take_along_axis(quats, np.abs(quats).argmax(axis=1)[:, None], axis=1))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)  # x y z w; the largest positive
    if version == 1:
        positions = (fixed / 4096).astype("<f2").tobytes()
    else:
        positions = b"".join(int(v).to_bytes(3, "little", signed=True) for v in fixed.ravel())
    if version >= 3:
        words = []
        for q in quats:
            largest, word = int(np.abs(q).argmax()), 0
            for i in (i for i in range(4) if i != largest):
                word = word << 10 | (512 if q[i] < 0 else 0) | round(abs(q[i]) * np.sqrt(2) * 511)
            words.append(largest << 30 | word)
        turns = np.array(words, "<u4").tobytes()
    else:
        quats = quats * np.where(quats[:, 3:] < 0, -1, 1)
        turns = np.rint(quats[:, :3] * 127.5 + 127.5).astype(np.uint8).tobytes()
    parts = [positions, alphas.tobytes(), colors.tobytes(), scales.tobytes(), turns]
    parts += [rest.tobytes()] if degree else []
    if version == 4:  # with an extension, which is skipped
        packed = [zstandard.compress(part) for part in parts]
        header = struct.pack("<IIIBBBBI12x", MAGIC, version, count, degree, 12, 2, len(parts), 48) + bytes(16)
        table = [struct.pack("<QQ", len(short), len(part)) for short, part in zip(packed, parts, strict=True)]
        data = header + b"".join(table + packed)
    else:
        data = gzip.compress(struct.pack("<IIIBBBB", MAGIC, version, count, degree, 12, 0, 0) + b"".join(parts))
    return data, {
        "means": fixed / 4096 * [1, -1, -1],
        "opacity": alphas[:, 0] / 255,
        "log_scales": scales / 16.0 - 10,
        "quats": quats[:, [3, 0, 1, 2]] * [1, 1, -1, -1],
        "rest": (rest.reshape(count, k, 3) - 128.0) / 128 * turned(degree)[:, None],
    }


@pytest.mark.parametrize(("version", "degree"), [(1, 1), (2, 2), (3, 3), (4, 0), (4, 4)])
def test_spz_of_every_version(tmp_path: Path, version: int, degree: int) -> None:
    data, wanted = spz_of(version, degree=degree)
    (tmp_path / "a.spz").write_bytes(data)
    splat = read_splat(tmp_path / "a.spz")
    assert np.allclose(splat.means, wanted["means"], atol=3e-3 if version == 1 else 1e-6)
    assert np.allclose(1 / (1 + np.exp(-splat.opacity_logits)), wanted["opacity"], atol=1e-5)
    assert np.allclose(splat.log_scales, wanted["log_scales"])
    assert np.allclose(splat.sh[:, 1:], wanted["rest"])
    assert all(array.flags.c_contiguous and array.dtype == np.float32 for array in splat.arrays().values())
    cosine = np.abs((splat.quats * wanted["quats"]).sum(axis=1)) / np.linalg.norm(splat.quats, axis=1)
    assert cosine.min() > (0.9999 if version >= 3 else 0.99)  # w is the root of what three rounded squares leave


def test_the_number_of_gaussians_is_told_before_they_are_read(tmp_path: Path) -> None:
    (tmp_path / "a.spz").write_bytes(spz_of(3)[0])
    for path, number in ((write(tmp_path / "a.ply", columns()), COUNT), (tmp_path / "a.spz", 100)):

        def check(count: int, number: int = number) -> None:
            raise MemoryError if count == number else AssertionError

        with pytest.raises(MemoryError):
            read_splat(path, check)


def refused(path: Path) -> str:
    with pytest.raises(InputError) as error:
        read_splat(path)
    text = str(error.value)
    assert text.startswith(str(path))
    assert "\n" not in text
    return text


def test_what_is_no_splat_is_told(tmp_path: Path) -> None:
    values = columns(0)
    cloud = write(tmp_path / "cloud.ply", {name: values[name] for name in "xyz"})
    assert "cloud of points" in refused(cloud)
    for name in ("opacity", "scale_1"):
        cut = write(tmp_path / "cut.ply", {other: v for other, v in values.items() if other != name})
        assert f"lacks the properties {name} of" in refused(cut)
    vertex = PlyElement.describe(np.zeros(3, [(n, "f4") for n in "xyz"]), "vertex")
    face = PlyElement.describe(np.array([([0, 1, 2],)], [("vertex_indices", "i4", (3,))]), "face")
    PlyData([vertex, face]).write(str(tmp_path / "mesh.ply"))
    assert "is a mesh" in refused(tmp_path / "mesh.ply")
    assert "holds no Gaussians" in refused(write(tmp_path / "none.ply", {n: v[:0] for n, v in values.items()}))
    assert "one blob" in refused(write(tmp_path / "blob.ply", values | {n: np.zeros(COUNT, np.float32) for n in "xyz"}))
    odd = refused(write(tmp_path / "odd.ply", values | {"f_rest_0": values["x"]}))
    assert "has 1 properties f_rest_*" in odd
    nan = {name: np.full(COUNT, np.nan, np.float32) for name in "xyz"}
    assert "0 of 300 rows are numbers" in refused(write(tmp_path / "nan.ply", values | nan))


def test_spz_that_cannot_be_read_is_told(tmp_path: Path) -> None:
    good, packed = gzip.decompress(spz_of(2)[0]), spz_of(4)[0]
    file = tmp_path / "a.spz"
    for data, words in (
        (gzip.compress(struct.pack("<II", MAGIC, 7) + good[8:]), "of version 7"),
        (struct.pack("<II", MAGIC, 5) + bytes(24), "of version 5"),
        (packed[:8] + struct.pack("<I", 99) + packed[12:], "not of the size"),
        (packed[:100], "cannot be read"),
        (packed[:-50], "is cut short"),
        (packed[:150] + b"\xff" * 50 + packed[200:], "cannot be read"),
        (gzip.compress(good[:-100]), "is cut short"),
        (gzip.compress(b"x" * 64), "is no .spz file"),
        (b"no gzip", "cannot be read"),
    ):
        file.write_bytes(data)
        assert words in refused(file)


def test_spz_is_unpacked_no_farther_than_its_header_tells(tmp_path: Path) -> None:
    good = gzip.decompress(spz_of(2)[0])
    (tmp_path / "a.spz").write_bytes(gzip.compress(good + bytes(50 << 20)))
    tracemalloc.start()
    try:
        assert len(read_splat(tmp_path / "a.spz")) == 100
        assert tracemalloc.get_traced_memory()[1] < 2 << 20
    finally:
        tracemalloc.stop()
    (tmp_path / "a.spz").write_bytes(gzip.compress(good[:8] + struct.pack("<I", 2**32 - 1) + good[12:]))
    assert "cannot hold the 4294967295 Gaussians" in refused(tmp_path / "a.spz")


def test_colours_between_0_and_1(tmp_path: Path) -> None:
    values = {name: array for name, array in columns(0).items() if not name.startswith("f_dc")}
    shares = np.linspace(0, 1, COUNT, dtype=np.float32)
    as_shares = read_splat(write(tmp_path / "a.ply", values | dict.fromkeys(("red", "green", "blue"), shares)))
    bytes_ = np.rint(255 * shares).astype(np.uint8)
    as_bytes = read_splat(write(tmp_path / "b.ply", values | dict.fromkeys(("red", "green", "blue"), bytes_)))
    assert np.allclose(0.5 + 0.28209479177387814 * as_shares.sh[:, 0, 0], shares, atol=1e-6)
    assert np.allclose(as_shares.sh, as_bytes.sh, atol=0.5 / 255 / 0.28)


def test_a_compressed_file_without_its_colours_is_one_line(tmp_path: Path) -> None:
    rows = dict.fromkeys(("packed_position", "packed_rotation", "packed_scale"), np.zeros(COUNT, np.uint32))
    with pytest.raises(InputError, match="do not fit each other"):
        read_splat(write(tmp_path / "a.ply", rows))

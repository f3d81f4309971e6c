"""Levels of detail: moments are kept, instances stay apart, and the picture is nearer than that of fewer Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from perception.map.write import write_map
from perception.viewer.levels import level
from perception.viewer.picking import covariances
from support.viewer_maps import small_map


def test_moments_opacity_and_ids_are_kept() -> None:
    gmap = small_map(900)
    ids, opacities = gmap.instance_ids, gmap.opacities
    full = covariances(gmap).astype(np.float64)
    found = level(gmap.means, full, opacities, ids, 150)
    assert 0.6 * 150 <= len(found) <= 150 and set(found.owner.tolist()) == set(range(len(found)))
    for row in range(len(found)):  # against sums over its members, row by row
        own = found.owner == row
        assert len(set(ids[own].tolist())) == 1
        area = np.cbrt(np.linalg.det(full[own]))
        w = opacities[own] * area
        middle = (w[:, None] * gmap.means[own]).sum(axis=0) / w.sum()
        second = np.einsum("n,nij->ij", w, full[own]) + np.einsum("n,ni,nj->ij", w, *[gmap.means[own] - middle] * 2)
        np.testing.assert_allclose(found.means[row], middle, atol=1e-5)
        np.testing.assert_allclose(found.covariances[row], second / w.sum(), atol=1e-5)
        wanted = min(1.0, w.sum() / np.cbrt(np.linalg.det(second / w.sum())))
        assert found.opacities(np.ones(900, bool))[row] == pytest.approx(wanted, rel=1e-4)


def test_colours_and_hidden_gaussians() -> None:
    gmap = small_map(300)
    found = level(gmap.means, covariances(gmap), gmap.opacities, gmap.instance_ids, 40)
    palette = np.array([[250, 0, 0], [0, 250, 0], [0, 0, 250], [9, 9, 9]], np.uint8)
    colors = found.colors(palette[gmap.instance_ids])
    own = np.array([gmap.instance_ids[found.owner == row][0] for row in range(len(found))])
    np.testing.assert_array_equal(colors, palette[own])
    hidden = found.opacities(gmap.instance_ids != 1)
    assert (hidden[own == 1] == 0).all() and (hidden[own != 1] > 0).all()


def test_few_ids_and_equal_places() -> None:
    means, cov = np.zeros((50, 3), np.float32), np.tile(np.eye(3) * 0.01, (50, 1, 1))
    ids = np.repeat(np.arange(10), 5)
    assert len(level(means, cov, np.full(50, 0.5), ids, 10)) == 10
    assert len(level(means, cov, np.full(50, 0.5), ids, 3)) == 10  # ids are never merged


@pytest.mark.slow
def test_the_page_of_a_large_map_shows_a_level_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("viser")
    from perception.viewer import app

    write_map(tmp_path / "m.gsmap", small_map(600))
    monkeypatch.setattr(app, "MOST", 200)
    monkeypatch.setattr(app, "level", lambda *words: level(*words, 200))
    viewer = app.Viewer(tmp_path / "m.gsmap", port=0)
    try:
        sent = viewer._gaussians()
        assert len(sent[0]) == len(sent[1]) == len(sent[2]) == len(sent[3]) <= 200
        assert viewer.detail == "0.0 of 0.0 million Gaussians" and viewer.detail in viewer.panel._facts.content
        viewer.session.editor.hide(1)
        viewer.redraw()
        assert (viewer._gaussians()[3] == 0).any()
    finally:
        viewer.stop()

"""What the report shows of a map of several visits: photos of a spot from before and after, and of today."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from perception.map.write import Map, read_map, write_map
from perception.photos.view_json import StoredView, stored_view
from perception.query import QueryMap
from perception.report import page
from perception.report.page import write_page
from perception.types import View
from support.query_maps import encoders
from support.visited_map import number, write_visited_map

COLORS = np.array([(200, 0, 0), (0, 200, 0), (0, 0, 200)])
"""Of all pixels of the photo that each visit took."""


def _view(folder: Path, visit: int, map_path: Path) -> StoredView:
    """A photo of 64 × 48 pixels that looks down on all cells from 5 m above them."""
    photo = folder / f"{visit}.png"
    Image.fromarray(np.full((48, 64, 3), COLORS[visit], np.uint8)).save(photo)
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[:3, 3] = -pose[:3, :3] @ [1.0, 1.0, 5.0]
    K = np.array([[40.0, 0, 32], [0, 40, 24], [0, 0, 1]])
    return stored_view(View(f"{visit}.jpg", photo, K, 64, 48, pose), map_path, visit=visit)


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """What the page shows."""
    path, shown = write_visited_map(tmp_path / "a.gsmap"), dict[str, Any]()
    views = [_view(tmp_path, visit, path) for visit in range(3)]
    write_map(path, Map.of(read_map(path), views=views))
    monkeypatch.setattr(page, "write_page", lambda _, data: shown.update(data))
    page.write_map_report(QueryMap.open(path, encoders=encoders), tmp_path / "report.html", [])
    return shown


def _visit_of(picture: np.ndarray) -> int:
    """The visit whose photo a picture is of, by its median colour."""
    return int(np.median(picture.reshape(-1, 3), axis=0).argmax())


def test_the_spots_of_a_change_are_of_its_visits(data: dict[str, Any]) -> None:
    spots = {row["id"]: [_visit_of(picture) for picture in row["pictures"]] for row in data["changes"]["rows"]}
    assert spots == {number("lamp"): [1, 2], number("drum"): [1, 2], number("teapot"): [1, 2]}


def test_the_overview_is_of_the_newest_visit(data: dict[str, Any]) -> None:
    assert next(iter(data["overview"])) == "instances in 2.jpg"


def test_a_moved_thing_is_cut_out_of_an_earlier_photo_where_it_stood_in_it(data: dict[str, Any]) -> None:
    crops = {row["id"]: row["crop"] for row in data["instances"]}
    lamp = crops[number("lamp")]  # all things list photo 0 alone, with the box (0, 0, 8, 8)
    assert lamp.shape[:2] == (8 + 3, 8 + 3)  # and a margin of 3 pixels, inside of the photo
    assert (lamp == COLORS[0]).all()


def test_a_spot_half_outside_of_all_photos_is_shown(tmp_path: Path) -> None:
    path = write_visited_map(tmp_path / "a.gsmap")
    write_map(path, Map.of(read_map(path), views=[_view(tmp_path, 0, path)]))
    album = page._Album(read_map(path))
    box = {"center": [4.8, 1.0, 0.0], "rotation": np.eye(3).tolist(), "extent": [0.2, 0.2, 0.02]}
    cut = album.spot(box, 0, 0)  # the photo ends at x = 1 + 5 · 32 / 40 = 5
    assert cut is not None
    assert album.spot({**box, "center": [4.97, 1.0, 0.0]}, 0, 0) is not None
    assert album.spot({**box, "center": [5.1, 1.0, 0.0]}, 0, 0) is None


def test_of_two_held_out_photos_one_is_the_worst_and_one_the_best(tmp_path: Path) -> None:
    path = write_visited_map(tmp_path / "a.gsmap")
    figures = {f"{visit}.jpg": {"psnr": 20.0 + visit, "ssim": 0.5} for visit in range(2)}
    info = {**read_map(path).info, "quality": {"psnr": 20.5, "ssim": 0.5, "views": figures}}
    views = [_view(tmp_path, visit, path) for visit in range(2)]
    rows = page._view_rows(page._Album(Map.of(read_map(path), views=views, info=info)))
    captions = [next(caption for caption in row if caption.startswith("render")) for row in rows]
    assert captions == ["render: 20.00 dB, SSIM 0.500, worst of 2", "render: 21.00 dB, SSIM 0.500, best of 2"]


@pytest.mark.parametrize("rows", [0, 3])
def test_changes_are_a_table_where_there_are_some(data: dict[str, Any], rows: int, tmp_path: Path) -> None:
    changes = {**data["changes"], "rows": data["changes"]["rows"][:rows]}
    write_page(tmp_path / "page.html", {**data, "changes": changes})
    told = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert changes["title"] in told
    assert told.count('<td class="spot">') == 2 * rows and ("<th>before</th>" in told) == (rows > 0)

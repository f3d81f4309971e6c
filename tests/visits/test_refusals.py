"""What an update refuses before it changes anything: older photos, and depth in another unit; its settings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from PIL import Image

from perception.changes.colours import without_colours
from perception.changes.look import Look
from perception.config import MapConfig, load_config
from perception.errors import InputError
from perception.gaussians.model import Gaussians, from_points, isotropic
from perception.gaussians.views import TrainingView
from perception.language import encoders
from perception.map.map import Map
from perception.map.write import read_map, set_labels, write_map
from perception.pipeline.changes import inputs_of
from perception.pipeline.checkpoint import digest, fingerprint
from perception.pipeline.optimise import Photos, Run
from perception.types import View
from perception.visits.growth import GROWING, LEAST_ITERATIONS, SETTLING, changed_pixels, trained, update_config
from perception.visits.record import joined_language, visit_record
from perception.visits.scene import foreign_photos, refuse_older, update_settings
from perception.visits.update import _encoder_of, renamed, update_map
from perception.visits.visit import Visit
from support.progress import Told
from support.visited_map import number, write_visited_map

TAKEN, OFFSET = 0x9003, 0x9011  # EXIF DateTimeOriginal and OffsetTimeOriginal


def photo(path: Path, time: str | None, offset: str | None = None) -> SimpleNamespace:
    """A view of visit 0, of a photo that was taken at a time by EXIF, by a clock of this offset."""
    exif = Image.Exif()
    stated = {TAKEN: time, OFFSET: offset}
    exif.get_ifd(0x8769).update({tag: text for tag, text in stated.items() if text is not None})
    Image.new("RGB", (8, 8)).save(path, exif=exif)
    return SimpleNamespace(photo=path, visit=0)


def a_map(views: list[SimpleNamespace]) -> Any:
    return SimpleNamespace(views=views, located_views=lambda: views, path=Path("home.gsmap"))


def test_photos_older_than_the_map_are_refused_by_their_exif(tmp_path: Path) -> None:
    old = [photo(tmp_path / "a.jpg", "2026:11:24 10:00:00"), photo(tmp_path / "b.jpg", "2026:11:24 10:05:00")]
    before: Any = [photo(tmp_path / "c.jpg", "2026:11:23 09:00:00")]
    later: Any = [photo(tmp_path / "d.jpg", "2026:11:25 09:00:00")]
    unknown: Any = [photo(tmp_path / "e.jpg", None)]
    with pytest.raises(InputError, match="older than the map") as refused:
        refuse_older(a_map(old), before)
    assert str(tmp_path) in str(refused.value) and "2026-11-24 10:05" in str(refused.value)
    refuse_older(a_map(old), later)
    refuse_older(a_map(old), unknown)
    refuse_older(a_map(unknown), before)
    unknown[0].visit = 1
    with pytest.raises(InputError, match="older than the map"):
        refuse_older(a_map([*old, *unknown]), before)


@pytest.mark.parametrize(
    ("offset", "time"),
    [("+02:00", "2026-11-23T23:30:00Z"), ("-05:30", "2026-11-24T07:00:00Z"), (None, "2026-11-24T01:30:00Z")]
    + [(text, "2026-11-24T01:30:00Z") for text in ("   :  ", "Z", "+2", "")],
)
def test_the_time_of_a_visit_is_utc_where_the_camera_states_its_offset(
    tmp_path: Path, offset: str | None, time: str
) -> None:
    view = photo(tmp_path / "a.jpg", "2026:11:24 01:30:00", offset)
    assert visit_record(tmp_path, [view.photo])["time"] == time


def test_depth_in_another_unit_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    variance = rng.uniform(0.01, 0.02, (20, 30))
    black = torch.zeros(20, 30, 3, dtype=torch.uint8)

    def look(unit: float) -> Look:
        view = TrainingView("a", black, None, torch.eye(3), torch.eye(4), depth=torch.full((20, 30), 2.0 * unit))
        none = np.full((20, 30), -1)
        return Look(view, np.full((20, 30), 2.0), np.zeros((20, 30)), none, variance, variance, variance, variance)

    assert foreign_photos(tmp_path, a_map([]), [look(1.0)]) == []
    with pytest.raises(InputError, match="another unit: its depth images measure 1e"):
        foreign_photos(tmp_path, a_map([]), [look(1000.0)])


def test_ignored_pixels_say_nothing_of_the_place_and_start_nothing(tmp_path: Path) -> None:
    """A person fills most of each photo, before what the map shows, and is ignored."""
    rng, nothing = np.random.default_rng(0), np.zeros((20, 30))
    person = np.arange(30) < 24
    product, variance = np.where(person, -0.5, 0.9) * np.ones((20, 1)), rng.uniform(0.99, 1, (20, 30))
    measured, colour = np.where(person, 1.0, 2.0) * np.ones((20, 1)), np.where(person, 0.5, 0.0) * np.ones((20, 1))
    for weight, here in ((None, False), (torch.from_numpy(np.where(person, 0, 1) * np.ones((20, 1))), True)):
        view = TrainingView("a", torch.zeros(20, 30, 3, dtype=torch.uint8), None, torch.eye(3), torch.eye(4))
        view = replace(view, weight=weight)
        shown = Look(view, np.full((20, 30), 2.0), measured, nothing - 1, product, variance, variance, colour)
        assert changed_pixels(shown).any() is np.bool_(not here)
        if here:
            assert foreign_photos(tmp_path, a_map([]), [shown]) == []
        else:
            with pytest.raises(InputError, match="1 of 1 photos do not show"):
                foreign_photos(tmp_path, a_map([]), [shown])


def test_a_setting_without_effect_is_refused(tmp_path: Path) -> None:
    path = write_visited_map(tmp_path / "a.gsmap")
    for pair in ("frame.known_length=2: mug, lamp", "splat.unit=metre", "photos.init_points=a.ply"):
        with pytest.raises(InputError, match="no effect on an update"):
            update_settings(path, None, ["seed=1", pair])
    assert update_settings(path, None, ["seed=1"]).seed == 1
    for text in ("[frame]\ntag_size = 0.1", '[splat]\nunit = "metre"', "photos.init_points = 'a.ply'"):
        (tmp_path / "c.toml").write_text(f"seed = 2\n{text}\n")
        with pytest.raises(InputError, match=r"c\.toml (frame|splat|photos)\.\w+: has no effect on an update"):
            update_settings(path, tmp_path / "c.toml", [])
    (tmp_path / "c.toml").write_text("seed = 2\n")
    assert update_settings(path, tmp_path / "c.toml", []).seed == 2


def test_a_visit_has_no_files_of_the_maps_own_input(tmp_path: Path) -> None:
    """They may be gone; those of masks and words are asked for again."""
    gmap, path = read_map(write_visited_map(tmp_path / "a.gsmap")), tmp_path / "a.gsmap"
    names = ("photos.camera", "photos.ignore_masks", "photos.init_points", "photos.held_out", "splat.cameras")
    gmap.info["config"] = load_config(pairs=[f"{name}={tmp_path / 'gone'}" for name in names]).to_json()
    write_map(path, gmap)
    (tmp_path / "photos").mkdir()
    photo(tmp_path / "photos/a.jpg", None)
    found = inputs_of(tmp_path / "photos", update_settings(path, None, []), tmp_path / "new.gsmap")
    assert [list(files) for files in found.values()] == [["a.jpg"]]


@pytest.mark.parametrize(("words", "given"), [(True, "none"), (True, "conse"), (False, "conse")])
def test_another_encoder_than_that_of_the_map_is_refused(tmp_path: Path, words: bool, given: str) -> None:
    """Else the new map would tell an encoder that did not make its embeddings."""
    write_visited_map(tmp_path / "old.gsmap")
    if not words:
        gmap = read_map(tmp_path / "old.gsmap")
        gmap.language = {}
        write_map(tmp_path / "old.gsmap", gmap)
    (tmp_path / "photos").mkdir()
    photo(tmp_path / "photos/a.jpg", None)
    config = update_settings(tmp_path / "old.gsmap", None, ["masks=builtin", f"language.encoder={given}"])
    with pytest.raises(
        InputError, match=r"language\.encoder: that of .* is (none|hash.*), that of the visit (none|conse)"
    ):
        update_map(tmp_path / "old.gsmap", tmp_path / "photos", tmp_path / "new.gsmap", config)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["old.gsmap", "photos"]


def test_settings_of_the_maps_own_input_are_none_of_its_visits(tmp_path: Path) -> None:
    """Cameras of a finished splat may be gone: an update reads none of them."""
    gmap = read_map(write_visited_map(tmp_path / "a.gsmap"))
    own = {"splat": {"cameras": str(tmp_path / "gone"), "up": "z"}, "photos": {"camera": "gone.yaml", "max_side": 320}}
    gmap.info["config"] = own
    write_map(tmp_path / "b.gsmap", gmap)
    (tmp_path / "photos").mkdir()
    photo(tmp_path / "photos" / "a.jpg", None)
    config = update_settings(tmp_path / "b.gsmap", None, [])
    assert config.photos.max_side == 320 and config.splat == MapConfig().splat and config.photos.camera is None
    assert inputs_of(tmp_path / "photos", config, tmp_path / "new.gsmap")


def test_what_is_new_is_described_by_the_encoder_of_the_map(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another one would be recorded, and prompts answered by that. A map without instances has none yet."""
    known = {
        "conse": SimpleNamespace(identity="conse-3"),
        "clip:here": SimpleNamespace(identity="conse-3"),
        "none": None,
    }
    monkeypatch.setattr(encoders, "make_encoder", {**known, "clip:other": SimpleNamespace(identity="other")}.get)

    def a_map(described: bool, made_with: str, count: int = 1) -> Any:
        language = {"encoder": np.array("conse-3")} if described else {}
        return Map(instances=[{}] * count, language=language, info={"config": {"language": {"encoder": made_with}}})

    for spec in ("conse", "clip:here"):
        assert _encoder_of(a_map(True, "conse"), spec) is known[spec]
    assert _encoder_of(a_map(False, "none"), "none") is _encoder_of(a_map(False, "conse"), "conse") is None
    assert _encoder_of(a_map(False, "conse", 0), "conse") is known["conse"]
    for described, spec in ((True, "none"), (True, "clip:other"), (False, "conse")):
        with pytest.raises(InputError, match=r"encoder.*; (leave it out|give the first)"):
            _encoder_of(a_map(described, "conse" if described else "none"), spec)


def test_what_is_new_in_a_map_without_instances_keeps_its_embeddings() -> None:
    new = {"encoder": np.array("conse-3")}
    assert joined_language({}, new) is new and joined_language(new, {}) is new


def test_both_trainings_of_an_update_share_the_time_limit() -> None:
    config = load_config(pairs=["train.time_limit=60"])
    limits = [update_config(config, 20, share, 1000).train.time_limit or 0 for share in (GROWING, SETTLING)]
    assert sum(limits) == pytest.approx(60) and limits[0] / limits[1] == pytest.approx(GROWING / SETTLING)
    assert update_config(load_config(), 20, GROWING, 1000).train.time_limit is None
    assert update_config(config, 20, SETTLING, 1000, alone=True).train.time_limit == 60  # nothing grows


def test_a_leg_goes_on_only_from_the_gaussians_that_it_began_with(tmp_path: Path) -> None:
    """Other settings of instances, or more time for growth, give others, of which each row is of some instance."""
    rng = np.random.default_rng(0)
    picture = torch.from_numpy(rng.integers(0, 255, (16, 24, 3)).astype(np.uint8))
    K = torch.tensor([[20.0, 0, 12], [0, 20, 8], [0, 0, 1]])
    view = TrainingView("a", picture, None, K, torch.eye(4))
    # Of a torch with CUDA and no GPU, the device that is taken is told.
    config, told = load_config(pairs=["train.iterations=20", "train.exchange_db=0", "device=cpu"]), Told()
    run, photos = Run.begun(tmp_path, config, tmp_path, told), Photos([], [], [view], [])

    def settled(count: int) -> Gaussians:
        points = np.random.default_rng(1).uniform([-1, -1, 3], [1, 1, 5], (count, 3))
        held = from_points(points, np.full((count, 3), 90, np.uint8), feature_dim=2, seed=0)
        visit = cast(Visit, SimpleNamespace(run=run, photos=photos, mark="mark"))
        return trained(visit, "settle", SETTLING, held, count, [])[0]

    first = settled(30)
    assert len(settled(40)) == 40 and not told.lines  # with the checkpoint of 30
    assert torch.equal(settled(30).sh, first.sh) and told.lines == [f"resuming at iteration {LEAST_ITERATIONS}"]


def test_a_finished_update_is_that_of_the_same_photos_and_the_same_map(tmp_path: Path) -> None:
    """Else `resume` would return the map of other photos, or one without the names given since."""
    old, new, source, config = tmp_path / "old.gsmap", tmp_path / "new.gsmap", tmp_path / "photos", MapConfig()
    source.mkdir()
    photo(source / "a.jpg", None)
    write_visited_map(old)
    made = read_map(old)
    mark = digest(made.map_id, fingerprint(source, config))
    made.info |= {"fingerprint": mark, "inputs": inputs_of(source, config, new)}
    write_map(new, made)
    assert update_map(old, source, new, config, resume=True).info["fingerprint"] == mark
    photo(source / "a.jpg", "2026:11:24 10:00:00")
    with pytest.raises(InputError, match=r"others since this map was made.*a\.jpg"):
        update_map(old, source, new, config, resume=True)
    set_labels(old, {number("lamp"): "reading lamp"})
    with pytest.raises(InputError, match="exists already"):
        update_map(old, source, new, config, resume=True)


def test_photos_or_maps_without_colours_are_known() -> None:
    colours = torch.tensor([[200, 30, 30], [30, 90, 200], [120, 120, 120]], dtype=torch.uint8)
    grey = torch.tensor([[90, 90, 90], [91, 90, 89], [20, 20, 20]], dtype=torch.uint8)
    generator, zeros = torch.Generator().manual_seed(0), np.zeros((3, 3))
    maps = [isotropic(zeros, torch.zeros(3), rgb / 255, 0.9, 4, generator) for rgb in (colours, grey)]
    views: list[Any] = [[SimpleNamespace(photo=rgb[None])] for rgb in (colours, grey)]
    assert [[without_colours(one, photos) for photos in views] for one in maps] == [[False, True], [True, True]]


def test_boxes_of_a_visit_of_another_size_are_at_the_size_of_the_map() -> None:
    """A square of a picture of 400 × 300, found at 200 × 150, in a map at 800: at 400 × 300, as no photo grows."""
    view, small = (
        View(name, Path(name), np.eye(3), w, h, np.eye(4)) for name, w, h in (("a", 400, 300), ("b", 90, 60))
    )
    boxes = np.array([[10, 20, 200, 150], [1, 2, 90, 60]], np.int32)
    found = renamed({"view_names": np.array(["a", "b"]), "view_boxes": boxes}, "visit1/", [small, view], 200, 800)
    assert found["view_boxes"].tolist() == [[20, 40, 400, 300], [1, 2, 90, 60]]
    assert found["view_boxes"].dtype == np.int32 and found["view_names"].tolist() == ["visit1/a", "visit1/b"]
    back = renamed({"view_names": np.array(["a"]), "view_boxes": found["view_boxes"][:1] + 1}, "", [view], 800, 200)
    assert back["view_boxes"].tolist() == [[10, 20, 201, 151]]  # all of it

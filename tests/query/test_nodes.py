"""Parts and groups as answers: embeddings of names tell which of part, instance and group a prompt means."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from perception.errors import InputError
from perception.export.export_map import ExportOptions, at_granularity, export_map
from perception.io.cloud import read_cloud
from perception.language.base import Reading
from perception.language.colors import PALETTE
from perception.language.description import InstanceDescription, to_arrays
from perception.map.write import read_map, write_map
from perception.query import QueryMap, Where, axis_box, load_map
from perception.viewer.session import Session
from support.query_maps import HashEncoder, encoders, write_map_of
from support.visited_map import NAMES, number, write_visited_map


def said(*names: str) -> dict[str, np.ndarray]:
    rows, colors = HashEncoder().encode_texts(names), np.zeros((PALETTE, 4), np.float32)
    found = [InstanceDescription(row, row[None], colors, ["a.jpg"], [(0, 0, 1, 1)]) for row in rows]
    return {f"language_{name}": array for name, array in to_arrays(found, HashEncoder.identity).items()}


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Mug 3 with a handle (id 20) and an inside (21), banana 4, and laptop 5 and teapot 6, which are a tea set."""
    path = write_map_of(tmp_path_factory.mktemp("nodes") / "m.gsmap", first_id=3)
    gmap = read_map(path)
    left = gmap.means[:, 0] < gmap.means[gmap.instance_ids == 3][:, 0].mean()
    ids = np.where(gmap.instance_ids == 3, np.where(left, 20, 21), -1).astype(np.int32)
    mug = gmap.instances[0]
    mug["parts"] = [{**mug, "id": i, "parent": 3, "num_gaussians": int((ids == i).sum())} for i in (20, 21)]
    gmap.parts = {"ids": ids, **said("handle", "hollow")}
    of = np.array([-1, -1, 0, 0, -1, -1, -1, -1, -1], np.int32)
    gmap.groups = {"of": of, "scores": np.array([0.7], np.float32), **said("breakfast")}
    gmap.opacity_logits[:] = 4 * gmap.means[:, 0] - 8  # more to the right
    write_map(path, gmap)
    return path


@pytest.fixture(scope="module")
def gmap(path: Path) -> QueryMap:
    return load_map(path, encoders)


def test_a_prompt_is_answered_by_the_node_that_it_names(gmap: QueryMap) -> None:
    (mug,) = gmap.query("mug", top_k=1)
    assert mug.instance_id == 3 and mug.part is None and not mug.instances
    (handle,) = gmap.query("handle", top_k=1)
    assert (handle.instance_id, handle.part, handle.to_json()["part"]) == (3, 20, 20)
    np.testing.assert_array_equal(handle.points, gmap.means[gmap.parts["ids"] == 20])
    (both,) = gmap.query("breakfast", top_k=1)
    assert both.instance_id == 5 and both.to_json()["instances"] == [5, 6]
    members = gmap.means[np.isin(gmap.instance_ids, [5, 6])]
    np.testing.assert_array_equal(np.sort(both.points, axis=0), np.sort(members, axis=0))
    weights = 1 / (1 + np.exp(-gmap.opacity_logits[np.isin(gmap.instance_ids, [5, 6])].astype(np.float64)))
    np.testing.assert_allclose(both.centroid, weights @ members / weights.sum(), rtol=1e-6)
    assert "part" not in mug.to_json() and "instances" not in mug.to_json()
    assert {hit.instance_id for hit in gmap.query("handle", min_score=0.0)} == set(range(3, 12))  # instances alone


def test_a_filter_applies_to_nodes_by_their_own_points_and_the_labels_of_their_instances(gmap: QueryMap) -> None:
    handle, breakfast = gmap.query("handle")[0], gmap.query("breakfast")[0]
    for text, hit in (("handle", handle), ("breakfast", breakfast)):
        low, high = hit.points.min(axis=0), hit.points.max(axis=0)
        around = Where(region=axis_box(low, high), share=1.0)
        (found,) = gmap.query(text, where=around)
        assert (found.part, found.instances) == (hit.part, hit.instances)
        elsewhere = Where(region=axis_box(high + 100, high + 101))
        assert gmap.query(text, where=elsewhere) == []
        above = high + np.array([0, 0, 0.5])
        (found,) = gmap.query(text, where=Where(near=above, within=5.0))
        assert found.distance == pytest.approx(np.linalg.norm(hit.points - above, axis=1).min())
        smaller = gmap.query(text, where=Where(max_size=0.99 * max(hit.obb.extent)))
        assert all((other.part, other.instances) != (hit.part, hit.instances) for other in smaller)
    assert gmap.query("handle", where=Where(labels=["mug"])) == []  # its mug has no label
    gmap.instances[0]["label"] = "Mug"
    try:
        assert gmap.query("handle", where=Where(labels=["mug"]))[0].part == 20
    finally:
        del gmap.instances[0]["label"]


def test_a_prompt_that_is_repeated_is_not_encoded_again(path: Path) -> None:
    class Counting(HashEncoder):
        asked: ClassVar[list[str]] = []

        def encode_texts(self, texts: Sequence[str]) -> np.ndarray:
            self.asked.extend(texts)
            return super().encode_texts(texts)

    gmap = load_map(path, lambda _: Counting())
    hits = [hit.to_json() for hit in gmap.query("handle")]
    assert hits[0]["part"] == 20
    before = len(Counting.asked)
    assert [hit.to_json() for hit in gmap.query(" handle ")] == hits and len(Counting.asked) == before


def test_only_groups_whose_members_all_stand_today_answer(tmp_path: Path) -> None:
    """The mug is gone, and with it the breakfast; the tea set is there."""
    gmap = read_map(write_visited_map(tmp_path / "m.gsmap"))
    of = {"mug": 0, "banana": 0, "lamp": 1, "kettle": 1}
    ids = np.array([of.get(name, -1) for name in NAMES], np.int32)
    gmap.groups = {"of": ids, "scores": np.array([0.5, 0.6], np.float32), **said("breakfast", "tea set")}
    write_map(tmp_path / "m.gsmap", gmap)
    opened = load_map(tmp_path / "m.gsmap", encoders)
    (tea,) = opened.query("tea set")
    assert tea.instances == (number("lamp"), number("kettle"))
    assert all(not hit.instances for hit in opened.query("breakfast", min_score=0.0))
    assert not any(hit.instances for hit in opened.query("breakfast"))


def test_parts_do_not_answer_where_the_encoder_knows_whole_objects(path: Path) -> None:
    class Wholes(HashEncoder):
        reading = Reading(wholes=True)

    gmap = load_map(path, lambda name: Wholes())
    assert all(hit.part is None for hit in gmap.query("handle"))
    assert gmap.query("breakfast", top_k=1)[0].instances == (5, 6)


def test_parts_without_embeddings_are_no_part_of_what_a_prompt_is_compared_with(path: Path, tmp_path: Path) -> None:
    stored = read_map(path)
    blank = {name: np.zeros_like(array) for name, array in stored.parts.items() if "embeddings" in name}
    stored.parts = stored.parts | blank
    write_map(tmp_path / "blank.gsmap", stored)
    stored.parts = {"ids": stored.parts["ids"]}
    for entry in stored.instances:
        entry.pop("parts", None)
    write_map(tmp_path / "without.gsmap", stored)
    blanked, without = (load_map(tmp_path / f"{name}.gsmap", encoders) for name in ("blank", "without"))
    for text in ("mug", "handle", "breakfast", "hollow"):
        answers = [[hit.to_json() for hit in gmap.query(text, min_score=0.0)] for gmap in (blanked, without)]
        assert answers[0] == answers[1] and len(answers[0]) >= 8


def test_granularity_of_an_export(path: Path, tmp_path: Path) -> None:
    gmap = read_map(path)
    ids, entries = at_granularity(gmap, "parts")
    np.testing.assert_array_equal(ids, np.where(gmap.parts["ids"] >= 0, gmap.parts["ids"], gmap.instance_ids))
    assert entries[20]["parent"] == 3
    facts, _ = export_map(path, tmp_path / "out.ply", None, ExportOptions(), granularity="groups")
    solid = gmap.opacities >= 0.5
    expected = np.where(gmap.instance_ids == 6, 5, gmap.instance_ids)[solid]
    np.testing.assert_array_equal(read_cloud(tmp_path / "out.ply").labels["instance_id"], expected)
    assert facts["instances"]["5"]["instances"] == [5, 6] and "6" not in facts["instances"]
    assert facts["instances"]["5"]["score"] == pytest.approx(0.7)
    bare = write_map_of(tmp_path / "bare.gsmap")
    for level in ("parts", "groups"):
        with pytest.raises(InputError, match=f"holds no {level} of instances"):
            at_granularity(read_map(bare), level)


def test_the_viewer_shows_no_group_of_which_a_member_is_hidden_or_gone(path: Path, tmp_path: Path) -> None:
    write_map(tmp_path / "m.gsmap", read_map(path))
    session = Session(tmp_path / "m.gsmap")

    def groups() -> list[tuple[int, ...]]:
        session._loaded().encoders = encoders
        return [hit.instances for hit in session.ask("breakfast") if hit.instances]

    assert groups() == [(5, 6)] and session.selected == [5, 6]
    session.select(None)  # as a click beside all things does: then the hits are lit
    assert session.lit() == [5, 6]
    session.editor.hide(6)
    session.edited()
    assert groups() == []
    session.show_all()
    session.edited()
    assert groups() == [(5, 6)]
    session.editor.remove(6)
    session.edited()
    assert session.hits == [] and session.selected == [5]

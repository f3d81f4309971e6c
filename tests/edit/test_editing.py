"""Edits by hand against what they must leave: counted by brute force on a map whose objects are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from perception.edit.editor import Editor
from perception.errors import InputError
from perception.io.json_shapes import LARGEST
from perception.language.colors import PALETTE
from perception.language.description import InstanceDescription, to_arrays
from perception.map.write import Map, read_map, set_labels, write_map


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Three balls of 60 Gaussians, the last one of two halves in feature space, 20 of no instance, one far away."""
    rng = np.random.default_rng(0)
    centres = np.array([[0, 0, 0], [2, 0, 0], [4, 0, 0]], float)
    ids = np.concatenate([np.repeat([0, 1, 2], 60), np.full(21, -1)]).astype(np.int32)
    means = np.concatenate([centres[ids[:180]] + rng.normal(0, 0.1, (180, 3)), rng.normal(2, 0.3, (21, 3))])
    means[-1] = [500, 0, 0]
    features = rng.normal(0, 0.01, (201, 4))
    features[:180, 0] += ids[:180]
    features[150:180, 1] += 0.6
    means[150:180] += [0, 0.25, 0]
    names = ["a.jpg", "b.jpg"]
    descriptions = [
        InstanceDescription(e, np.stack([e, e]), np.zeros((PALETTE, 4), np.float32), names, [(0, 0, 1, 1)] * 2)
        for e in np.eye(3, 8, dtype=np.float32)
    ]
    arrays = to_arrays(descriptions, "test")
    counts = [60, 60, 60]
    entries = [
        {"id": i, "label": None, "score": 0.5 + 0.1 * i, "num_gaussians": counts[i], "views": 3 + i}
        | {"centroid": [0, 0, 0], "aabb": {"min": [0, 0, 0], "max": [1, 1, 1]}}
        | {"obb": {"center": [0, 0, 0], "rotation": np.eye(3).tolist(), "extent": [1, 1, 1]}}
        for i in range(3)
    ]
    gmap = Map(
        means.astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (201, 1)),
        np.full((201, 3), np.log(0.05), np.float32),
        np.full(201, 2.0, np.float32),
        np.zeros((201, 1, 3), np.float32),
        features.astype(np.float32),
        ids,
        np.where(ids >= 0, 0.9, 0).astype(np.float32),
        entries,
        {"frame": "map"},
        [],
        arrays,
    )
    out = tmp_path / "m.gsmap"
    write_map(out, gmap)
    return out


def test_rename_is_saved_and_undone(path: Path) -> None:
    editor = Editor(path)
    editor.rename(1, "  grandma's   cup ")
    assert editor.dirty
    editor.save()
    assert not editor.dirty
    assert [entry["label"] for entry in read_map(path).instances] == [None, "grandma's cup", None]
    assert editor.undo() is not None
    assert editor.dirty
    editor.save()
    assert [entry["label"] for entry in read_map(path).instances] == [None, None, None]
    assert editor.redo() == "named 1 'grandma's cup'"


def test_merge_joins_points_names_and_words(path: Path) -> None:
    editor = Editor(path)
    editor.rename(2, "pot")
    new = editor.merge([2, 0])
    editor.save()
    saved = read_map(path)
    assert {entry["id"] for entry in saved.instances} == {1, new}
    entry = next(entry for entry in saved.instances if entry["id"] == new)
    before = editor.original
    rows = np.isin(before.instance_ids, [0, 2])
    assert entry["num_gaussians"] == rows.sum() == (saved.instance_ids == new).sum()
    assert entry["label"] == "pot"
    np.testing.assert_allclose(entry["aabb"]["min"], before.means[rows].min(0), rtol=1e-6)
    np.testing.assert_allclose(entry["centroid"], before.means[rows].mean(0), rtol=1e-5)  # equal opacities
    place = [entry["id"] for entry in saved.instances].index(new)
    assert saved.language["view_counts"].tolist()[place] == 4
    expected = (np.eye(8)[0] + np.eye(8)[2]) / np.sqrt(2)
    np.testing.assert_allclose(saved.language["embeddings"][place], expected, atol=1e-6)


def test_a_merged_instance_can_be_merged_again(path: Path) -> None:
    """It has the largest id and stands before the others."""
    editor = Editor(path)
    joined = editor.merge([editor.merge([0, 1]), 2])
    assert [entry["id"] for entry in editor.instances] == [joined] and np.sum(editor.ids == joined) == 180
    editor.save()
    assert len(read_map(path).language["embeddings"]) == 1


def test_an_id_that_was_saved_and_undone_is_given_to_nothing_else(path: Path) -> None:
    editor = Editor(path)
    first = editor.merge([0, 1])
    editor.save()
    editor.undo()
    editor.rename(2, "cup")  # what was undone is forgotten
    assert editor.merge([1, 2]) > first


def test_an_id_is_given_once_in_the_history_of_a_map(path: Path) -> None:
    """Each map on disk, and each map after it by another editor, by labels or without: against a list of all ids."""
    given = {entry["id"] for entry in read_map(path).instances}

    def new(ids: list[int]) -> list[int]:
        assert not given & set(ids)
        given.update(ids)
        return ids

    editor = Editor(path)
    new([editor.merge([0, 1])])
    editor.save()
    editor.undo()
    editor.save()  # without the joined one
    set_labels(path, {2: "cup"})
    editor = Editor(path)
    parts = new(editor.split(2))
    editor.save()
    editor.remove(parts[1])
    editor.save()
    assert Editor(path).current().next_id == max(given) + 1  # by which an update names what is new
    editor = Editor(path)
    new([editor.merge([0, 1])])


def test_split_finds_the_two_halves(path: Path) -> None:
    editor = Editor(path)
    parts = editor.split(2)
    assert len(parts) == 2
    halves = [set(np.flatnonzero(editor.ids == part)) for part in parts]
    assert {frozenset(half) for half in halves} == {frozenset(range(120, 150)), frozenset(range(150, 180))}
    editor.save()
    assert len(read_map(path).language["embeddings"]) == len(read_map(path).instances) == 4
    with pytest.raises(InputError, match="nothing to split"):
        editor.split(0)


def test_remove_leaves_the_gaussians(path: Path) -> None:
    editor = Editor(path)
    editor.remove(0)
    editor.save()
    saved = read_map(path)
    assert len(saved) == 201 and (saved.instance_ids == -1).sum() == 81
    assert [entry["id"] for entry in saved.instances] == [1, 2]
    np.testing.assert_allclose(saved.language["embeddings"], np.eye(3, 8)[1:])


def test_two_editors_do_not_overwrite_each_other(path: Path) -> None:
    first, second = Editor(path), Editor(path)
    first.rename(0, "mine")
    second.rename(0, "yours")
    first.save()
    with pytest.raises(InputError, match="changed by another program"):
        second.save()
    assert read_map(path).instances[0]["label"] == "mine"
    assert second.dirty and second.entry(0)["label"] == "yours"  # nothing is lost before the user says so
    second.reopen()
    assert not second.dirty and not second.outdated and second.history == []
    second.rename(1, "late")
    second.save()
    assert [entry["label"] for entry in read_map(path).instances] == ["mine", "late", None]


def test_unknown_instances_and_lonely_merges_are_refused(path: Path) -> None:
    editor = Editor(path)
    with pytest.raises(InputError, match="instance 7"):
        editor.rename(7, "x")
    with pytest.raises(InputError, match="at least 2"):
        editor.merge([1, 1])
    assert not editor.dirty and editor.undo() is None


def with_parts(path: Path) -> Path:
    """Instance 0 gets two parts, of 25 and of 30 of its 60 Gaussians, described by axes 3 and 4."""
    gmap = read_map(path)
    ids = np.full(len(gmap), -1, np.int32)
    ids[:25], ids[25:55] = 3, 4
    entry = gmap.instances[0]
    entry["parts"] = [{**entry, "id": i, "num_gaussians": n, "parent": 0} for i, n in ((3, 25), (4, 30))]
    said = [
        InstanceDescription(e, e[None], np.zeros((PALETTE, 4), np.float32), ["a.jpg"], [(0, 0, 1, 1)])
        for e in np.eye(8, dtype=np.float32)[3:5]
    ]
    gmap.parts = {"ids": ids, **{f"language_{name}": a for name, a in to_arrays(said, "test").items()}}
    write_map(path, gmap)
    return path


def test_a_split_needs_as_many_ids_as_parts(path: Path) -> None:
    gmap = read_map(path)
    gmap.info["next_id"] = LARGEST  # one is left
    write_map(path, gmap)
    editor = Editor(path)
    with pytest.raises(InputError, match=f"ids go up to {LARGEST}"):
        editor.split(2)
    assert editor.merge([0, 1]) == LARGEST and not editor.ids.min() < -1


def test_instances_without_gaussians_are_not_merged(path: Path) -> None:
    gmap = read_map(path)
    gmap.instance_ids = np.where(gmap.instance_ids < 2, -1, gmap.instance_ids).astype(np.int32)
    gmap.instances = [{**entry, "num_gaussians": 60 * (entry["id"] == 2)} for entry in gmap.instances]
    write_map(path, gmap)
    editor = Editor(path)
    with pytest.raises(InputError, match="0, 1 have no Gaussians"):
        editor.merge([0, 1])
    assert editor.merge([0, 2]) == 3 and editor.entry(3)["num_gaussians"] == 60


def test_a_split_follows_the_hierarchy(path: Path) -> None:
    editor = Editor(with_parts(path))
    first, second = editor.split(0)
    assert first >= 5  # ids of parts are taken
    before = editor.original.parts["ids"]
    assert set(editor.ids[before == 3]) == {first} and set(editor.ids[before == 4]) == {second}
    assert np.isin(editor.ids[55:60], [first, second]).all()  # those of no part go with their neighbours
    editor.save()
    assert (read_map(path).parts["ids"] == -1).all()  # the parts are instances of their own now


def test_parts_survive_what_happens_to_others(path: Path) -> None:
    editor = Editor(with_parts(path))
    editor.remove(2)
    editor.save()
    saved = read_map(path)
    np.testing.assert_array_equal(saved.parts["ids"], editor.original.parts["ids"])
    np.testing.assert_array_equal(saved.parts["language_embeddings"], np.eye(8)[3:5])
    editor.merge([0, 1])
    editor.save()
    assert (read_map(path).parts["ids"] == -1).all() and len(read_map(path).parts["language_embeddings"]) == 0


def test_a_map_opened_as_the_working_folder_is_saved_again_and_again(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each save exchanges the folder, so that the working folder is one that is deleted."""
    monkeypatch.chdir(path)
    editor = Editor(Path())
    for name in ("mug", "cup"):
        editor.rename(0, name)
        editor.save()
    assert read_map(path).instances[0]["label"] == "cup"


def test_unsaved_edits_are_written_beside_the_map(path: Path) -> None:
    editor, before = Editor(path), read_map(path).instances
    assert editor.rescue() is None
    for name in ("mug", "cup"):
        editor.rename(0, name)
        rescued = editor.rescue()
        assert rescued is not None and rescued.parent == path.parent and rescued != path
        assert read_map(rescued).instances[0]["label"] == name
    assert read_map(path).instances == before and len(list(path.parent.glob("*.unsaved-*"))) == 2

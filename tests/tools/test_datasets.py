"""The dataset benches, from miniature copies of the downloads' layouts to the table."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bench import run, scannetpp
from bench.datasets import by_words
from bench.lerf import LerfMask, LerfOvs
from bench.scannetpp import ScanNetPP
from perception.errors import InputError
from perception.io.cloud import read_cloud, write_cloud
from perception.map.files import read_info
from perception.map.write import read_map
from perception.query import load_map
from perception.query.ranking import Ranker
from perception.types import PointCloud
from score import instances, queries
from support.demo_truth import labels_of, load_truth, things

pytestmark = pytest.mark.slow

QUICK = [
    *("--set", "train.iterations=150", "--set", "train.budget=5000", "--set", "densify.every=25"),
    *("--set", "instances.min_cluster_size=15", "--set", "instances.min_samples=5"),
]
TESTS = ["003.jpg", "009.jpg"]


def write_colmap(folder: Path, truth, names: list[str]) -> None:
    """cameras.txt, images.txt, points3D.txt as COLMAP writes them, from exact cameras."""
    folder.mkdir(parents=True)
    first = truth.cameras[0]
    fx, fy, cx, cy = first.K[0, 0], first.K[1, 1], first.K[0, 2], first.K[1, 2]
    (folder / "cameras.txt").write_text(f"1 PINHOLE {first.width} {first.height} {fx} {fy} {cx} {cy}\n")
    lines = []
    for number, (name, camera) in enumerate(zip(names, truth.cameras, strict=True), 1):
        x, y, z, w = Rotation.from_matrix(camera.camera_from_world[:3, :3]).as_quat()
        t = camera.camera_from_world[:3, 3]
        lines += [f"{number} {w} {x} {y} {z} {t[0]} {t[1]} {t[2]} 1 {name}", "10 10 -1"]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    rows = np.random.default_rng(0).choice(len(truth.points), 1500, replace=False)
    points = [
        f"{i} {p[0]} {p[1]} {p[2]} {c[0]} {c[1]} {c[2]} 0.5"
        for i, (p, c) in enumerate(zip(truth.points[rows], truth.colors[rows], strict=True), 1)
    ]
    (folder / "points3D.txt").write_text("\n".join(points) + "\n")


@pytest.fixture(scope="module")
def truth(small_scene: Path):
    return load_truth(small_scene / "truth")


@pytest.fixture(scope="module")
def downloads(small_scene: Path, truth, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """LERF-mask and LERF-OVS side by side: one scene that can be mapped, and one whose poses were not downloaded."""
    root = tmp_path_factory.mktemp("downloads")
    ball = next(thing for thing in things(truth) if "ball" in thing.name)
    others = [thing for thing in things(truth) if thing.id != ball.id][:2]
    scene = root / "lerf_mask" / "table"
    shutil.copytree(small_scene / "images", scene / "images")
    write_colmap(scene / "sparse" / "0", truth, truth.names)
    (scene / "images_train").mkdir()
    for name in truth.names:
        if name not in TESTS:
            shutil.copy(small_scene / "images" / name, scene / "images_train")
    for number, name in enumerate(TESTS):
        (scene / "test_mask" / str(number)).mkdir(parents=True)
        for thing in [ball, *others]:
            mask = np.where(labels_of(truth, name) == thing.id, 255, 0).astype(np.uint8)
            cv2.imwrite(str(scene / "test_mask" / str(number) / f"{thing.name}.png"), mask)
    (root / "lerf_mask" / "broken").mkdir()
    shutil.copytree(scene / "images", root / "lerf_mask" / "broken" / "images")
    shutil.copytree(scene / "test_mask", root / "lerf_mask" / "broken" / "test_mask")
    (root / "lerf_mask" / "broken" / "transforms.json").write_text("{}")

    ovs = root / "lerf_ovs"
    shutil.copytree(scene / "images", ovs / "table" / "images")
    shutil.copytree(scene / "sparse", ovs / "table" / "sparse")
    (ovs / "label" / "table").mkdir(parents=True)
    for name in TESTS:
        mask = labels_of(truth, name) == ball.id
        outline, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        polygon = max(outline, key=len)[:, 0].tolist()
        label = {"info": {"height": 96, "width": 128}, "objects": [{"category": "ball", "segmentation": polygon}]}
        (ovs / "label" / "table" / f"{Path(name).stem}.json").write_text(json.dumps(label))
    return root


@pytest.fixture(scope="module")
def ovs_run(downloads: Path, small_scene: Path, truth, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, after which the user names the instance that is the ball."""
    work = tmp_path_factory.mktemp("ovs")
    masks = f"labels:{small_scene / 'labels'}"
    brief = ["--set", "language.views=1", "--set", "language.zooms=1"]
    LerfOvs.main([str(downloads / "lerf_ovs"), "-o", str(work), "--masks", masks, *QUICK, *brief])
    path = work / "maps" / "table.gsmap" / "instances.json"
    found = json.loads(path.read_text())
    ball = next(thing for thing in things(truth) if "ball" in thing.name)
    middle = truth.points[truth.instance_ids == ball.id].mean(axis=0)
    nearest = min(found["instances"], key=lambda entry: float(np.linalg.norm(entry["centroid"] - middle)))
    nearest["label"] = "ball"
    path.write_text(json.dumps(found))
    return work


def test_lerf_ovs_from_download_to_table(ovs_run: Path, downloads: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = json.loads((ovs_run / "lerf_ovs.json").read_text())
    assert first["failed"] == {} and first["maps"]["table"]["quality"]["psnr"] > 10
    views = read_info(ovs_run / "maps" / "table.gsmap")["views"]
    assert sorted(view["name"] for view in views if view["held_out"]) == TESTS
    # A second run renders nothing anew: it scores the predictions as they lie there.
    for picture in (ovs_run / "predictions").rglob("*.png"):
        cv2.imwrite(str(picture), np.zeros((96, 128), np.uint8))
    again = [str(downloads / "lerf_ovs"), "-o", str(ovs_run)]
    LerfOvs.main(again)
    assert json.loads((ovs_run / "lerf_ovs.json").read_text())["result"]["mean"]["miou"] == 0
    # Without them they are made again from the map, where the ball now has its name.
    shutil.rmtree(ovs_run / "predictions")
    LerfOvs.main(again)
    result = json.loads((ovs_run / "lerf_ovs.json").read_text())["result"]
    assert result["mean"]["miou"] > 0.5 and result["mean"]["macc25"] == 1.0
    protocol = result["protocol"]
    assert protocol["occlusion"] == "off" and "top-1" in protocol["selection"] and "held out" in protocol["test_views"]
    assert "occlusion: off" in capsys.readouterr().out


@pytest.mark.parametrize(("rule", "chosen"), [("top-1", [2]), ("relative", [2, 1])])
def test_published_rules_apply_to_cosines(
    rule: str, chosen: list[int], ovs_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gmap = read_map(ovs_run / "maps" / "table.gsmap")
    cosines = np.full(len(gmap.instances), 0.2)
    cosines[1:4] = 0.29, 0.3, 0.28  # (.285 − .2) is .85 of (.3 − .2)
    monkeypatch.setattr(Ranker, "similarity", lambda *_: cosines[None])
    assert by_words(gmap, "ball", rule, "cosine") == [gmap.instances[i]["id"] for i in chosen]


def test_a_made_scene_is_a_truth_scene(ovs_run: Path, small_scene: Path, tmp_path: Path) -> None:
    """tools/score on the generator's truth and a map in its frame."""
    scene, gmap = str(small_scene / "truth"), str(ovs_run / "maps" / "table.gsmap")
    instances.main([scene, gmap, "-o", str(tmp_path)])
    found = json.loads((tmp_path / "instances.json").read_text())
    assert found["ap"]["all, calibrated"]["ap25"] > 0.3 and 0.2 < found["rendered_miou"] <= 1
    assert found["truth"] == len(load_truth(small_scene / "truth").instances)
    queries.main([gmap, scene, "-o", str(tmp_path)])
    asked = json.loads((tmp_path / "queries.json").read_text())
    assert asked["prompts"] > 20 and asked["absent_prompts"] == 30
    assert asked["reliability"]["count"] == 30 + asked["prompts"] + asked["household_absent_prompts"]
    assert found["reliability"]["count"] > 3
    (tmp_path / "bare").mkdir()
    with pytest.raises(InputError, match=r"no scene\.json"):
        queries.main([gmap, str(tmp_path / "bare")])


def test_lerf_mask_from_download_to_table(
    ovs_run: Path, downloads: Path, truth, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The user names the instance that is the ball; the words of the other things may find anything."""
    ball = next(thing.name for thing in things(truth) if "ball" in thing.name)
    shutil.copytree(ovs_run / "maps", tmp_path / "maps")
    path = tmp_path / "maps" / "table.gsmap" / "instances.json"
    path.write_text(path.read_text().replace('"label": "ball"', f'"label": "{ball}"'))
    maps = ["--maps", str(tmp_path / "maps")]
    assert run.main(["lerf-mask", str(downloads / "lerf_mask"), "-o", str(tmp_path), *maps]) == 0
    facts = json.loads((tmp_path / "lerf_mask.json").read_text())
    table = facts["result"]["scenes"]["table"]
    assert table["prompts"][ball]["miou"] > 0.5
    assert facts["result"]["scenes"]["broken"]["miou"] == 0 and list(facts["failed"]) == ["broken"]
    assert facts["result"]["mean"]["miou"] == pytest.approx(table["miou"] / 2)
    out = capsys.readouterr().out
    assert "broken failed and scores 0" in out and "selection" in out and "with occlusion, > 0.2" in out


def test_scannetpp_from_download_to_table(
    small_scene: Path,
    truth,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = tmp_path / "spp" / "data" / "0a1b"
    shutil.copytree(small_scene / "images", scene / "dslr" / "resized_images")
    write_colmap(scene / "dslr" / "colmap", truth, truth.names)
    (scene / "dslr" / "train_test_lists.json").write_text(json.dumps({"train": truth.names[1:], "test": TESTS}))
    (scene / "scans").mkdir()
    rows = np.arange(0, len(truth.points), 2)
    write_cloud(scene / "scans" / "mesh_aligned_0.05.ply", PointCloud(truth.points[rows], truth.colors[rows]))
    ids = truth.instance_ids[rows]
    names_of = {thing.id: thing.name for thing in truth.instances}
    (scene / "scans" / "segments.json").write_text(json.dumps({"segIndices": (10 * ids).tolist()}))
    groups = [
        {"label": names_of[i], "objectId": i, "segments": [10 * i]} for i in np.unique(ids).tolist() if i in names_of
    ]
    everything = {"label": "floor", "objectId": 999, "segments": (10 * np.unique(ids)).tolist()}  # larger: loses
    (scene / "scans" / "segments_anno.json").write_text(json.dumps({"segGroups": [everything, *groups]}))
    write_metadata(tmp_path / "spp", ["wall", "floor", *sorted({group["label"] for group in groups} - {"wall"})])
    (scene / "scans" / "mesh_aligned_0.05_mask.txt").write_text("0\n1\n2\n")

    (scene / "dslr" / "resized_anon_masks").mkdir()
    cv2.imwrite(str(scene / "dslr" / "resized_anon_masks" / "001.png"), np.full((96, 128), 255, np.uint8))
    monkeypatch.setattr(scannetpp, "POINTS", 3000)
    monkeypatch.setattr(scannetpp, "FRAMES", 8)

    labels = f"labels:{small_scene / 'labels'}"
    quick = ["--set", "language.views=1", "--set", "language.zooms=1", "--set", "photos.max_side=128", *QUICK]
    words = [str(tmp_path / "spp"), "-o", str(tmp_path / "w"), "--masks", labels, "--no-train-on-test", *quick]
    ScanNetPP.main(words)
    facts = json.loads((tmp_path / "w" / "scannetpp.json").read_text())
    assert facts["result"]["ap50"] > 0.3
    photos = facts["maps"]["0a1b"]["config"]["photos"]
    assert photos["max_side"] == 128 and photos["ignore_masks"].endswith("resized_anon_masks")  # --set, not half of it
    assert len(read_cloud(photos["init_points"]).points) == 3000
    trained = sorted(set(truth.names) - set(TESTS))
    even = {trained[i] for i in np.linspace(0, len(trained) - 1, 8).round().astype(int)}
    assert {path.name for path in (tmp_path / "w/workspaces/0a1b/images").iterdir()} == even | set(TESTS)
    assert facts["result"]["protocol"]["test_photos"] == "held out"
    assert "smallest object" in facts["result"]["protocol"]["truth"]
    assert "protocol scannetpp" in capsys.readouterr().out

    # Every instance has the class of the largest cosine; with the right classes the scores by class are good.
    names = (tmp_path / "spp/metadata/semantic_benchmark/top100.txt").read_text().split("\n")
    gmap = load_map(tmp_path / "w/maps/0a1b.gsmap")
    cosines = gmap.ranker.similarity(names)
    given = json.loads((tmp_path / "w/predictions/0a1b/classes.json").read_text())
    assert given == {str(e["id"]): names[k] for e, k in zip(gmap.instances, cosines.argmax(axis=0), strict=True)}
    predicted = (tmp_path / "w/predictions/0a1b/0a1b.txt").read_text().split("\n")[:-1]
    assert {int(row.split()[1]) for row in predicted} <= set(range(len(names)))
    for right in (True, False):
        lines = []
        for row in predicted:
            mask, _, score = row.split()
            inside = ids[np.loadtxt(tmp_path / "w/predictions/0a1b" / mask) > 0]
            name = names_of.get(int(np.bincount(inside[inside >= 0], minlength=1).argmax()), "wall")
            lines.append(f"{mask} {names.index(name) if right else 0} {score}\n")
        (tmp_path / "w/predictions/0a1b/0a1b.txt").write_text("".join(lines))
        shutil.rmtree(tmp_path / "w/submission")
        ScanNetPP.main(words)
        found = json.loads((tmp_path / "w" / "scannetpp.json").read_text())["result"]
        assert found["ap50"] == facts["result"]["ap50"]
        assert (found["open_vocabulary"]["ap50"] > 0.2) == right
        assert set(found["open_vocabulary"]["classes"]) <= set(names) - {"wall", "floor", "ceiling"}

    written = np.loadtxt(tmp_path / "w" / "truth" / "instance-classes" / "0a1b.txt", dtype=int)
    assert (written[:3] == -2).all() and len(written) == len(rows)
    for i in np.unique(ids[3:]).tolist():
        values = np.unique(written[3:][ids[3:] == i])
        assert len(values) == 1  # one truth id an object, whatever lies around it
        assert (values[0] > 0) == (i in names_of and names_of[i] not in ("wall", "floor", "ceiling"))


def write_metadata(dataset: Path, names: list[str], mapped: str = "") -> None:
    """top100.txt, top100_instance.txt (no wall, floor, ceiling), and map_benchmark.csv that ends with `mapped`."""
    folder = dataset / "metadata" / "semantic_benchmark"
    folder.mkdir(parents=True)
    (folder / "top100.txt").write_text("\n".join(names))
    (folder / "top100_instance.txt").write_text("\n".join(n for n in names if n not in ("wall", "floor", "ceiling")))
    kept = "".join(f"{name},9,,\n" for name in names)
    (folder / "map_benchmark.csv").write_text(f"class,count,semantic_map_to,instance_map_to\n{kept}{mapped}")


def toolkit_truth(segments: list[int], groups: list[dict], names: list[str], mapping: dict[str, str]) -> list[int]:
    """ScanNet++'s toolkit vertex by vertex: three slots a vertex, and the slot of the smallest annotation counts."""
    slots: list[list[tuple[int, int, int]]] = [[] for _ in segments]
    for index, group in enumerate(groups):
        label = mapping.get(group["label"])
        inside = [v for v, segment in enumerate(segments) if segment in group["segments"] and len(slots[v]) < 3]
        if label in names:
            for v in inside:
                slots[v].append((len(inside), names.index(label), index))
    truth = []
    for held in slots:
        _, label, index = min(held, key=lambda slot: slot[0], default=(0, 0, 0))
        truth.append(1000 * label + index if index > 0 and label > 0 else 0)  # class 0 is the wall
    return truth


@pytest.mark.parametrize("seed", range(4))
def test_scannetpp_truth_is_the_toolkits(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    names = ["wall", "book", "cup", "box"]
    write_metadata(tmp_path, names, "books,5,book,\nmug,5,cup,\nREMOVE,5,None,None\ntiny thing,1,,\n")
    mapping = {name: name for name in [*names, "tiny thing"]} | {"books": "book", "mug": "cup"}
    segments = rng.integers(0, 12, 200).tolist()
    labels = ["wall", "books", "book", "mug", "box", "REMOVE", "tiny thing", "never heard of"]
    groups = [
        {"label": str(rng.choice(labels)), "objectId": n, "segments": rng.choice(12, rng.integers(1, 8)).tolist()}
        for n in range(14)
    ]
    scans = tmp_path / "scans"
    scans.mkdir()
    (scans / "segments.json").write_text(json.dumps({"segIndices": segments}))
    (scans / "segments_anno.json").write_text(json.dumps({"segGroups": groups}))
    classes = scannetpp.read_classes(tmp_path)
    found = scannetpp.vertex_truth(tmp_path, classes)
    assert found.tolist() == toolkit_truth(segments, groups, names, mapping)
    last = [max((n for n, g in enumerate(groups) if s in g["segments"]), default=-1000) for s in segments]
    assert scannetpp.vertex_truth(tmp_path, None).tolist() == [1000 + n for n in last]  # whatever the label
    (tmp_path / "metadata/semantic_benchmark/map_benchmark.csv").unlink()
    with pytest.raises(InputError, match=r"map_benchmark\.csv"):
        scannetpp.read_classes(tmp_path)


def test_what_is_not_a_dataset_is_told(tmp_path: Path, downloads: Path) -> None:
    for bench, word in ((LerfMask, "test_mask"), (LerfOvs, "label"), (ScanNetPP, "scans")):
        with pytest.raises(InputError, match=word):
            bench.main([str(tmp_path), "-o", str(tmp_path / "w")])
    with pytest.raises(InputError, match="no scene 'ramen'; found broken, table"):
        LerfMask.main([str(downloads / "lerf_mask"), "-o", str(tmp_path / "w"), "--scenes", "ramen"])

"""The map on disk: what is written is read back; damage, strangers and second writers are told in one line."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import perception
from perception.cli import main
from perception.errors import InputError
from perception.io.ply import read_ply
from perception.map.replace import lock_file, writing
from perception.map.write import read_map, set_labels, verify_map, write_map
from support.query_maps import encoders, write_map_of

STRICT = (
    "gaussians.ply",
    "features.npy",
    "instance_ids.npy",
    "membership.npy",
    "language.npz",
)


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_map_of(tmp_path_factory.mktemp("store") / "a.gsmap", gaussians=700)


@pytest.fixture
def copied(original: Path, tmp_path: Path) -> Path:
    shutil.copytree(original, tmp_path / "a.gsmap")
    return tmp_path / "a.gsmap"


@pytest.fixture(scope="module")
def mangled(original: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mangled") / "a.gsmap"
    shutil.copytree(original, path)
    edit_facts(path, files=None, sha256=None)
    return path


def edit_facts(path: Path, **changes: object) -> None:
    facts = json.loads((path / "map.json").read_text())
    facts.update(changes)
    (path / "map.json").write_text(json.dumps({key: value for key, value in facts.items() if value is not None}))


def one_line(error: pytest.ExceptionInfo[InputError], *words: str) -> None:
    text = str(error.value)
    assert "\n" not in text and len(text) < 400
    for word in words:
        assert word in text


# ------------------------------------------------------------------ round trip


def test_arrays_survive_the_disk_bit_by_bit(original: Path, tmp_path: Path) -> None:
    """The oracle is the plain PLY reader and numpy on the files; then a map written again has the same bytes."""
    rows = read_ply(original / "gaussians.ply")["vertex"]
    gmap = read_map(original)
    assert np.array_equal(gmap.means, np.stack([rows[a] for a in "xyz"], axis=1))
    assert np.array_equal(gmap.quats, np.stack([rows[f"rot_{i}"] for i in range(4)], axis=1))
    assert np.array_equal(gmap.log_scales, np.stack([rows[f"scale_{i}"] for i in range(3)], axis=1))
    assert np.array_equal(gmap.opacity_logits, rows["opacity"])
    assert np.array_equal(gmap.sh[:, 0, 2], rows["f_dc_2"]) and gmap.sh.shape == (700, 4, 3)
    assert np.array_equal(gmap.sh[:, 1:, 1], np.stack([rows[f"f_rest_{i}"] for i in (3, 4, 5)], axis=1))
    assert np.array_equal(gmap.features, np.load(original / "features.npy"))
    assert gmap.means.flags.writeable and gmap.features.flags.writeable
    write_map(tmp_path / "again.gsmap", gmap)
    for name in STRICT:
        if not name.endswith(".npz"):  # zip members carry the time
            assert (tmp_path / "again.gsmap" / name).read_bytes() == (original / name).read_bytes()


def test_listed_checksums_are_those_of_the_files(original: Path) -> None:
    facts = json.loads((original / "map.json").read_text())
    assert set(facts["files"]) == {*STRICT, "instances.json"}
    for name, entry in facts["files"].items():
        raw = (original / name).read_bytes()
        assert entry == {"bytes": len(raw), "sha256": hashlib.sha256(raw).hexdigest()}
    assert set(verify_map(original).values()) == {"ok"}
    assert main(["info", str(original), "--verify", "--json"]) == 0


def test_maps_from_before_checksums_still_open(original: Path, copied: Path) -> None:
    edit_facts(copied, files=None, sha256=None)
    old, new = perception.load_map(copied), perception.load_map(original)
    for entry in new.instances:
        assert np.array_equal(old.get(entry["id"]).points, new.get(entry["id"]).points)
    assert set(verify_map(copied).values()) == {"no checksum"}


# ---------------------------------------------------------------------- damage


@pytest.mark.parametrize("name", STRICT)
def test_a_shortened_or_missing_file_is_told_on_opening(copied: Path, name: str) -> None:
    file = copied / name
    file.write_bytes(file.read_bytes()[:-7])
    with pytest.raises(InputError) as error:
        perception.load_map(copied)
    one_line(error, name, "bytes", "damaged")
    file.unlink()
    with pytest.raises(InputError) as error:
        perception.load_map(copied)
    one_line(error, name, "missing")
    assert main(["query", str(copied), "mug"]) == 2


@pytest.mark.parametrize("name", STRICT)
@pytest.mark.parametrize("where", [0.02, 0.5, 0.99])
def test_one_flipped_bit_is_found(copied: Path, name: str, where: float) -> None:
    """By reading all of the map and by `info --verify`; opening alone may only notice what it reads."""
    raw = bytearray((copied / name).read_bytes())
    raw[int(where * len(raw))] ^= 1
    (copied / name).write_bytes(raw)
    for reader in (read_map, verify_map):
        with pytest.raises(InputError) as error:
            reader(copied)
        one_line(error, name)
    assert main(["info", str(copied), "--verify"]) == 2


def test_a_flipped_digit_in_the_facts_is_found(copied: Path) -> None:
    edit_facts(copied, seed=1)
    with pytest.raises(InputError) as error:
        verify_map(copied)
    one_line(error, "map.json", "checksum")


@pytest.mark.parametrize("keep", [0, 1, 40, 0.5, 0.9])
def test_truncated_maps_without_checksums_are_told_too(original: Path, tmp_path: Path, keep: float) -> None:
    """Older maps have no list of sizes, so every reader must find the damage by itself."""
    for name in [*STRICT, "map.json", "instances.json"]:
        path = tmp_path / f"{name}.gsmap"
        shutil.copytree(original, path)
        edit_facts(path, files=None, sha256=None)
        raw = (path / name).read_bytes()
        (path / name).write_bytes(raw[: int(keep * len(raw)) if isinstance(keep, float) else keep])
        with pytest.raises(InputError) as error:
            read_map(path)
            perception.load_map(path).get(0)
            pytest.fail(f"{name}: nothing was noticed")
        one_line(error, name)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[]", "instances"),
        ('{"instances": [{"id": "x"}]}', "valid integer"),
        ('{"instances": [{}]}', "id"),
        ('{"instances": 3}', "instances"),
        ("[" * 100_000, "instances"),
    ],
)
def test_instances_that_make_no_sense_are_told(copied: Path, text: str, words: str) -> None:
    (copied / "instances.json").write_text(text)
    with pytest.raises(InputError) as error:
        perception.load_map(copied)
    one_line(error, "instances.json", words, "mend it")
    assert "build it again" not in str(error.value)


def test_a_byte_order_mark_of_an_editor_is_read(copied: Path) -> None:
    file, whole = copied / "instances.json", perception.load_map(copied).instances
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert perception.load_map(copied).instances == whole


def test_a_file_in_place_of_a_map_is_told(copied: Path) -> None:
    with pytest.raises(InputError, match="is a file, expected the folder of a map"):
        perception.load_map(copied / "map.json")


def test_numbers_that_are_none_and_repeated_ids_are_told(copied: Path) -> None:
    facts = json.loads((copied / "instances.json").read_text())
    for change in (
        {"centroid": [1, 2]},
        {"score": "high"},
        {"label": 3},
        {"id": 1},
        {"centroid": [1, 2, float("nan")]},
    ):
        changed = [{**facts["instances"][0], **change}, *facts["instances"][1:]]
        (copied / "instances.json").write_text(json.dumps({"instances": changed}))
        with pytest.raises(InputError) as error:
            perception.load_map(copied)
        one_line(error, "instances.json", "damaged")


def test_an_archive_that_would_fill_the_memory_is_refused(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("perception.io.arrays.MOST_ARCHIVE", 1000)
    with pytest.raises(InputError) as error:
        perception.load_map(copied).language  # noqa: B018
    one_line(error, "language.npz", "unpacks")


def test_an_array_that_claims_to_be_giant_allocates_nothing(copied: Path) -> None:
    edit_facts(copied, files=None, sha256=None)
    raw = (copied / "features.npy").read_bytes()
    assert raw.count(b"(700, 8), }       ") == 1
    (copied / "features.npy").write_bytes(raw.replace(b"(700, 8), }       ", b"(9999999999, 8), }"))
    with pytest.raises(InputError) as error:
        read_map(copied)
    one_line(error, "features.npy")


@pytest.mark.filterwarnings("ignore:Reading `.npy` or `.npz` file required additional header parsing")
@given(name=st.sampled_from([*STRICT, "map.json", "instances.json"]), seed=st.integers(0, 2**32 - 1))
@settings(
    max_examples=int(os.environ.get("PERCEPTION_FUZZ", "150")), deadline=None, suppress_health_check=list(HealthCheck)
)
def test_random_damage_without_checksums_never_escapes_as_anything_else(mangled: Path, name: str, seed: int) -> None:
    """Bytes changed, cut out or repeated anywhere, most often in the header: an InputError, or a map that is whole.

    PERCEPTION_FUZZ=10000 for a longer run.
    """
    raw = (mangled / name).read_bytes()
    rng = np.random.default_rng(seed)
    changed = bytearray(raw)
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(0, min(len(changed), 200 if rng.random() < 0.7 else len(changed))))
        kind = rng.integers(0, 3)
        if kind == 0:
            changed[at] = int(rng.integers(0, 256))
        elif kind == 1:
            del changed[at : at + int(rng.integers(1, 9))]
        else:
            changed[at:at] = changed[at : at + int(rng.integers(1, 9))]
    try:
        (mangled / name).write_bytes(changed)
        gmap = read_map(mangled)
        perception.load_map(mangled, encoders).find()
        assert len(gmap.means) == len(gmap.instance_ids)
    except InputError as error:
        assert str(mangled) in str(error) and "\n" not in str(error)
    finally:
        (mangled / name).write_bytes(raw)


@pytest.mark.parametrize(
    ("version", "word"),
    [(0, "older"), (-1, "older"), (3, "newer"), ("1", "damaged"), (True, "damaged"), (1.5, "damaged")],
)
def test_another_format_version_says_which_and_what_to_do(copied: Path, version: object, word: str) -> None:
    edit_facts(copied, format_version=version)
    with pytest.raises(InputError) as error:
        perception.load_map(copied)
    one_line(error, "map.json", "format_version", word)


# --------------------------------------------------------------------- writers


def test_labels_are_kept_with_right_checksums(copied: Path) -> None:
    before = perception.load_map(copied).map_id
    set_labels(copied, {1: "fruit", 2: "work"})
    set_labels(copied, {2: None})
    assert [entry["label"] for entry in read_map(copied).instances[:3]] == [None, "fruit", None]
    assert set(verify_map(copied).values()) == {"ok"}
    assert perception.load_map(copied).map_id != before
    for bad in ({99: "x"}, {1: " "}, {1: "caf\udce9"}):
        with pytest.raises(InputError):
            set_labels(copied, bad)
    assert read_map(copied).instances[1]["label"] == "fruit"


def test_labels_set_by_hand_are_told_as_edited(copied: Path) -> None:
    text = (copied / "instances.json").read_text()
    (copied / "instances.json").write_text(text.replace('"label": null', '"label": "by hand"', 1))
    assert perception.load_map(copied).instances[0]["label"] == "by hand"
    states = verify_map(copied)
    assert states.pop("instances.json") == "edited" and set(states.values()) == {"ok"}


def test_two_writers_of_one_map_the_second_is_refused(copied: Path) -> None:
    gmap = read_map(copied)
    with writing(copied):
        write_map(copied, gmap)  # the same thread may go on
        refused: list[Exception] = []

        def second() -> None:
            try:
                set_labels(copied, {1: "lost"})
            except InputError as error:
                refused.append(error)

        thread = threading.Thread(target=second)
        thread.start()
        thread.join()
        assert len(refused) == 1 and "another thread" in str(refused[0])
    assert not lock_file(copied).exists()
    set_labels(copied, {1: "kept"})
    assert [path.name for path in copied.parent.iterdir()] == ["a.gsmap"]


def test_another_process_is_refused_and_a_killed_one_is_not_in_the_way(copied: Path) -> None:
    code = (
        "import sys, time; from pathlib import Path; from perception.map.replace import writing\n"
        "with writing(Path(sys.argv[1])):\n    print('held', flush=True); time.sleep(60)"
    )
    holder = subprocess.Popen(
        [sys.executable, "-c", code, str(copied)], stdout=subprocess.PIPE, text=True, cwd=copied.parent
    )
    try:
        assert holder.stdout is not None and holder.stdout.readline().strip() == "held"
        with pytest.raises(InputError) as error:
            set_labels(copied, {1: "lost"})
        one_line(error, f"process {holder.pid}", "wait")
        perception.load_map(copied)  # readers need no lock
    finally:
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    assert lock_file(copied).exists()  # left by the killed one
    set_labels(copied, {1: "kept"})
    assert not lock_file(copied).exists()


def test_many_writers_at_once_lose_no_label(copied: Path) -> None:
    """Each of four processes sets its own label as soon as it may; in the end all four are there."""
    code = (  # forks, so that all begin at once
        "import os, sys, time\nfrom pathlib import Path\nfrom perception.errors import InputError\n"
        "from perception.map.write import set_labels\n"
        "def label(k):\n"
        "    for attempt in range(2000):\n"
        "        try:\n            set_labels(Path(sys.argv[1]), {k: 'mine'}); os._exit(0)\n"
        "        except InputError as error:\n            assert 'is writing' in str(error), error; time.sleep(0.005)\n"
        "    sys.exit('never free')\n"
        "writers = [os.fork() or label(k) for k in range(4)]\n"
        "sys.exit(any([os.waitpid(writer, 0)[1] for writer in writers]))"
    )
    subprocess.run([sys.executable, "-c", code, str(copied)], cwd=copied.parent, check=True, timeout=120)
    assert [entry["label"] for entry in read_map(copied).instances[:4]] == ["mine"] * 4


def test_a_writer_killed_at_any_moment_leaves_a_map_that_opens(copied: Path) -> None:
    """SIGKILL while a process rewrites the map and its labels over and over; PERCEPTION_KILLS=100 for a longer run."""
    code = (  # a writer for each line that it is sent
        "import os, sys; from pathlib import Path; from perception.map.write import read_map, set_labels, write_map\n"
        "path = Path(sys.argv[1])\n"
        "for line in sys.stdin:\n"
        "    if (writer := os.fork()):\n        os.waitpid(writer, 0); print('killed', flush=True); continue\n"
        "    gmap, n = read_map(path), 0\n    print(os.getpid(), flush=True)\n"
        "    while True:\n        n += 1; write_map(path, gmap); set_labels(path, {0: f'n{n}'})\n"
    )
    means, pipes = read_map(copied).means, {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    command = [sys.executable, "-c", code, str(copied)]
    with subprocess.Popen(command, cwd=copied.parent, text=True, bufsize=1, **pipes) as starter:
        for delay in np.random.default_rng(0).uniform(0, 0.08, int(os.environ.get("PERCEPTION_KILLS", "4"))):
            starter.stdin.write("\n")
            writer = int(starter.stdout.readline())
            time.sleep(delay)
            os.kill(writer, signal.SIGKILL)
            assert starter.stdout.readline() == "killed\n"
            gmap = _recovered(copied)
            assert np.array_equal(gmap.means, means)
    write_map(copied, gmap)
    assert [path.name for path in copied.parent.iterdir()] == ["a.gsmap"]


def _recovered(path: Path):
    from perception.io.atomic import recover

    recover(path)
    return read_map(path)


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="needs a directory that not even root may write to")
def test_a_place_that_refuses_writing_is_told(original: Path) -> None:
    gmap = read_map(original)
    with pytest.raises(InputError) as error:
        write_map(Path("/proc/nowhere.gsmap"), gmap)
    one_line(error, "/proc/nowhere.gsmap", "cannot be written")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_read_only_map_can_be_asked_but_not_changed(copied: Path) -> None:
    for folder, mode in ((copied, 0o555), (copied.parent, 0o555)):
        folder.chmod(mode)
    try:
        assert len(perception.load_map(copied).get(0).points)
        with pytest.raises(InputError) as error:
            set_labels(copied, {1: "x"})
        one_line(error, "cannot be written")
    finally:
        for folder in (copied.parent, copied):
            folder.chmod(0o755)


def test_a_map_replaced_under_an_open_reader_stays_whole(copied: Path) -> None:
    """The reader mapped the old files; another map takes the directory's place before it reads its arrays."""
    before = read_map(copied)
    reader = perception.load_map(copied)
    write_map_of(copied, ["one", "two"], gaussians=300, seed=5)
    assert len(reader.instances) == 9 and np.array_equal(reader.means, before.means)
    shutil.rmtree(copied)
    assert np.array_equal(reader.get(4).points, before.means[before.instance_ids == 4])


def test_reading_while_others_replace_the_map_never_mixes_two(copied: Path) -> None:
    """Two maps of different size take turns; every reader gets arrays of one of them."""
    other = copied.parent / "b.gsmap"
    write_map_of(other, ["one", "two"], gaussians=300, seed=5)
    maps = [read_map(copied), read_map(other)]
    stop = threading.Event()

    def replace() -> None:
        turn = 0
        while not stop.is_set():
            turn += 1
            write_map(copied, maps[turn % 2])

    thread = threading.Thread(target=replace)
    thread.start()
    sizes = set()
    try:
        for _ in range(60):
            try:
                gmap = read_map(copied)
            except InputError as error:
                assert "no map" in str(error) or "again" in str(error)  # the moment between the two renames
                continue
            sizes.add((len(gmap), len(gmap.instances), len(gmap.features), gmap.info["num_gaussians"]))
    finally:
        stop.set()
        thread.join()
    assert sizes <= {(700, 9, 700, 700), (300, 2, 300, 300)} and sizes


@pytest.mark.parametrize("name", ["map.json", "instances.json", "gaussians.ply", "features.npy"])
def test_a_fifo_in_a_received_map_is_not_waited_for(copied: Path, name: str) -> None:
    info = json.loads((copied / "map.json").read_text())
    (copied / "map.json").write_text(json.dumps({key: info[key] for key in info if key not in ("files", "sha256")}))
    (copied / name).unlink()
    os.mkfifo(copied / name)
    with ThreadPoolExecutor(1) as pool:
        reading = pool.submit(read_map, copied)
        try:
            assert isinstance(reading.exception(60), InputError)
        finally:
            os.close(os.open(copied / name, os.O_RDWR))  # a reader that waits goes on

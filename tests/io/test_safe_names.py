"""Names that others gave: what stays below a folder passes unchanged, all else is refused in one line."""

import posixpath

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perception.errors import InputError
from perception.io.documents import safe_name

GOOD = [
    "a.jpg",
    "a/0001.jpg",
    "a/b/c.png",
    "..a.jpg",
    "a..b/c..jpg",
    "Küche 1.jpg",
    "#1.jpg",
    "写真.png",
    "a\\b.jpg",
    "./a.jpg",
]
BAD = {
    "": "names no file",
    ".": "names no file",
    "a/": "names no file",
    "..": "names no file",
    "a/..": "names no file",
    "/etc/passwd": "absolute",
    "\\\\host\\share\\a.jpg": "absolute",
    "C:\\a.jpg": "absolute",
    "c:a.jpg": "absolute",
    "../a.jpg": 'by ".."',
    "a/../../b.jpg": 'by ".."',
    "a\\..\\..\\b.jpg": 'by ".."',
    "a\0.jpg": "U+0000",
    "a\n.jpg": "U+000A",
    "a\x1b[2J.jpg": "U+001B",
    "a\udcff.jpg": "U+DCFF",
}


@pytest.mark.parametrize("name", GOOD)
def test_a_name_below_its_folder_passes_unchanged(name):
    assert safe_name(name, "here") == name


@pytest.mark.parametrize("name", BAD, ids=ascii)
def test_a_name_that_leaves_its_folder_or_cannot_be_written_is_refused(name):
    with pytest.raises(InputError, match=f"^here: the photo name .*{BAD[name].replace('+', '.')}") as refused:
        safe_name(name, "here")
    assert len(str(refused.value).splitlines()) == 1
    str(refused.value).encode()  # can be printed


@pytest.mark.parametrize("name", [None, 3, b"a.jpg", ["a.jpg"]])
def test_what_is_no_text_is_refused(name):
    with pytest.raises(InputError, match="not text"):
        safe_name(name, "here")


@settings(deadline=None)  # a busy machine may pause it
@given(st.lists(st.sampled_from(["..", ".", "/", "\\", "a", "C:", "\n", ".jpg", "\0"]), max_size=8).map("".join))
def test_whatever_passes_stays_below_the_folder(name):
    try:
        safe_name(name, "here")
    except InputError:
        return
    for spelt in (name, name.replace("\\", "/")):
        below = posixpath.normpath(posixpath.join("/folder", spelt))
        assert below.startswith("/folder/")

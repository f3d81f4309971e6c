"""What a map's report says of the photos that are missing."""

from __future__ import annotations

from perception.report.page import _left_out


def test_photos_that_are_not_in_the_map_are_named_by_reason() -> None:
    lost = [{"name": f"{i}.jpg", "why": "too blurred"} for i in range(14)] + [{"name": "x.jpg", "why": "no overlap"}]
    told = _left_out({"left_out": lost})
    assert len(told) == 2
    assert told[0].startswith("14 photos not in the map, too blurred: 0.jpg, ") and told[0].endswith(" and 2 more")
    assert told[1] == "1 photo not in the map, no overlap: x.jpg"
    assert _left_out({}) == []

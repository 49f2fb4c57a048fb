"""The page of a batch's results."""

import re

from idesplat.runtime.batch import index
from idesplat.runtime.batch.index import Index
from idesplat.runtime.batch.run import Summary
from idesplat.runtime.batch.worker import Outcome

DONE = {
    "id": "a b#1",
    "status": "done",
    "files": {"scene.spz": {"bytes": 1}, "picture.jpg": {"bytes": 1}, "../../elsewhere": {"bytes": 1}},
    "psnr": 24.46,
    "gaussians": 143360,
    "views": ["0", "1"],
    "seconds": 6.5,
    "peak_memory": 635_793_408,
}
FAILED = {"id": "c", "status": "failed", "error": "<script>alert(1)</script>", "hash": None, "seconds": None}


def test_a_scene_is_shown_with_what_its_record_says():
    page = Index()
    page.add(DONE)
    page.add(FAILED)
    text = page.page("1 of 2 scenes done, 1 failed")
    assert "PSNR 24.5 dB · 143,360 Gaussians · 2 views · 6.5 s · 636 MB" in text
    assert re.findall(r'(?:src|href)="([^"]*)"', text) == [
        "c/error.txt",
        "a%20b%231/picture.jpg",
        "a%20b%231/scene.spz",
    ]
    assert "<script" not in text


def test_what_is_held_in_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(index, "MAX_SHOWN", 3)
    monkeypatch.setattr("idesplat.runtime.batch.run.MAX_LISTED", 3)
    page, summary = Index(), Summary(10)
    for number in range(5):
        for record in (DONE, FAILED):
            page.add({**record, "id": str(number)})
            summary.add(Outcome({**record, "id": str(number)}, True), 1.0)
    text = page.page(summary.describe())
    assert text.count("<article>") == 6
    assert "4 more scenes are not shown" in text
    assert (summary.done, summary.failed, len(summary.failures)) == (5, 5, 3)

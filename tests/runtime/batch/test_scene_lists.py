"""The scenes of a batch, from folders and tables."""

import json

import pytest
from conftest import run_command
from idesplat.runtime.batch.scenes import check_options, read_scenes
from idesplat.runtime.cli import batch
from idesplat.runtime.errors import InputError


@pytest.mark.parametrize(
    ("row", "said"),
    [
        ({"id": "../up", "images": "x"}, "expected a name of a folder"),
        ({"id": ".", "images": "x"}, "expected a name of a folder"),
        ({"id": "summary.json", "images": "x"}, "none in .json"),
        ({"id": "é" * 101, "images": "x"}, "200 bytes at most"),
        ({"id": "a"}, "expected both"),
        ({"id": "a", "images": "ftp://host/a"}, "expected a local path, or a URL that begins with s3://"),
        ({"id": "a", "images": "s3:/bucket/a"}, "expected a local path, or a URL that begins with s3://"),
        ({"id": "a", "images": "\0"}, "no file can have this name"),
        ({"id": "a", "images": "x", "sise": 3}, "unknown column 'sise'"),
        ({"id": "a", "images": "x", "near": "close"}, "near 'close': expected a number"),
        ({"id": "a", "images": "x", "near": 0}, "scene 1: near 0: expected a positive depth"),
        ({"id": "a", "images": "x", "crop": 3}, "expected true or false"),
        ({"id": "a", "images": "x", "quality": "best"}, "expected one of fast, standard, high"),
        ([1], "expected an object"),
    ],
)
def test_a_bad_row_is_named(tmp_path, row, said):
    table = tmp_path / "scenes.jsonl"
    table.write_text(json.dumps(row))
    with pytest.raises(InputError, match=said):
        read_scenes(table)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.jsonl", "", "no scene in it"),
        ("a.jsonl", "\n", "no scene in it"),
        ("a.jsonl", "{", "cannot be read"),
        ("a.jsonl", "[" * 100_000, "cannot be read"),
        ("a.jsonl", '{"id": "a", "images": "x"}\n{"id": "A", "images": "y"}', "id a is given twice"),
        ("a.csv", "id,images\na,x,more", "unknown column 'None'"),
        ("a.txt", "a", "is no folder, .jsonl or .csv"),
    ],
)
def test_a_bad_table_is_refused(tmp_path, name, content, said):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=said):
        read_scenes(tmp_path / name)


def test_a_table_gives_paths_beside_it_and_options(tmp_path):
    table = tmp_path / "scenes.csv"
    table.write_text(
        "id,images,cameras,near,views,crop\na,one,one/transforms.json,0.5,3,true\nb,two,,,,\nc,/three,estimate,,,\n"
    )
    first, second, third = read_scenes(table)
    assert (first.images, first.cameras) == (tmp_path / "one", tmp_path / "one" / "transforms.json")
    assert first.options == {"near": 0.5, "views": 3, "crop": True}
    assert (second.cameras, second.options) == (None, {})
    assert (str(third.images), third.cameras) == ("/three", "estimate")


def test_shards_share_the_scenes_out(tmp_path):
    for number in range(7):
        (tmp_path / f"{number}").mkdir()
    scenes = read_scenes(tmp_path)
    shards = [scenes.of_shard(f"{number}/3") for number in (1, 2, 3)]
    assert sorted(scene.id for shard in shards for scene in shard) == [scene.id for scene in scenes]
    assert [len(shard) for shard in shards] == [len(list(shard)) for shard in shards]
    assert max(map(len, shards)) - min(map(len, shards)) <= 1
    for wrong in ("0/3", "4/3", "1", "1/", "a/b", "1/0", "-1/2", "²/3"):
        with pytest.raises(InputError, match="--shard"):
            scenes.of_shard(wrong)


def test_options_that_are_none_count_as_absent():
    check_options(
        {"near": None, "far": 2.0, "offset": None, "refine": None, "max_gaussians": None, "min_opacity": None}
    )


def test_the_command_refuses_a_near_of_zero(tmp_path, capsys):
    (tmp_path / "scenes" / "a").mkdir(parents=True)
    arguments = (tmp_path / "scenes", "--out", tmp_path / "out", "--near", "0", "--max-gaussians", "0")
    assert run_command(batch.main, *arguments) == 2
    assert "near 0: expected a positive depth" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()

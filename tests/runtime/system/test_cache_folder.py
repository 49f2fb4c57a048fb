"""Where the cache folder is."""

from pathlib import Path

import pytest
from idesplat.runtime.system import cache_folder as module
from idesplat.runtime.system.cache_folder import cache_folder


def test_it_is_where_the_environment_says(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder("graphs") == tmp_path / "idesplat" / "graphs"


def test_by_default_it_is_the_systems(monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME")
    folder = cache_folder("graphs")
    assert folder.is_relative_to(Path.home()) and folder.name == "graphs"


def test_without_a_home_folder_there_is_none(monkeypatch):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(module, "user_cache_path", lambda *_, **__: Path("~/.cache/idesplat"))  # as platformdirs does
    with pytest.raises(RuntimeError, match="home folder"):
        cache_folder("graphs")

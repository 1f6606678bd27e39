import pytest


@pytest.fixture(autouse=True)
def cache_folder(tmp_path, monkeypatch):
    """Keep decoded sequences out of the user's cache."""
    monkeypatch.setenv("ADAPTUNE_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("ADAPTUNE_CACHE_GB", raising=False)
    return tmp_path / "cache"

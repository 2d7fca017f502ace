"""Compiled kernels find a place, also where neither the package nor the home can be written to."""

import os

import pytest

from recordings import system_libraries


@pytest.fixture
def writable(monkeypatch):
    """The folders that can be written to; no place is named."""
    found = set()
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setattr(system_libraries, "_may_write", lambda folder: folder in found)
    return found


def test_where_the_package_or_the_users_cache_can_be_written_to_numba_chooses(writable, tmp_path):
    for one in (tmp_path, system_libraries._users_cache()):
        writable.clear()
        writable.add(one)
        system_libraries.place_kernel_cache(tmp_path)
        assert "NUMBA_CACHE_DIR" not in os.environ


def test_where_neither_can_be_a_folder_that_only_the_user_reads_is_named(writable, tmp_path):
    system_libraries.place_kernel_cache(tmp_path)
    folder = os.environ["NUMBA_CACHE_DIR"]
    assert os.stat(folder).st_mode & 0o777 == 0o700


def test_a_folder_that_is_not_there_yet_can_be_written_to_where_the_one_around_it_can(tmp_path):
    assert system_libraries._may_write(tmp_path / "a" / "b")

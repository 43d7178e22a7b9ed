"""Files are whole or absent, whatever happens while they are written."""

import os
import stat

import pytest

from physjax.files import ensure_writable_folder, write_atomically


@pytest.mark.parametrize(("mode", "content"), [("w", "ω = 2π/T\n"), ("wb", b"\x00\r\n\xff")])
def test_the_content_arrives_unchanged_and_replaces_what_was_there(tmp_path, mode, content):
    path = tmp_path / "result.txt"
    path.write_text("old")
    with write_atomically(path, mode) as file:
        file.write(content)
        assert path.read_text() == "old", "the place is taken only when the block ends"
    assert path.read_bytes() == (content if mode == "wb" else content.encode("utf-8"))
    assert [p.name for p in tmp_path.iterdir()] == ["result.txt"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("before", ["old", None])
def test_a_block_that_fails_leaves_the_old_file_and_no_litter(tmp_path, error, before):
    path = tmp_path / "result.txt"
    if before:
        path.write_text(before)
    with pytest.raises(error), write_atomically(path) as file:  # noqa: PT012
        file.write("half of the new")
        file.flush()
        raise error
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == ({"result.txt": "old"} if before else {})


def test_line_ends_are_those_that_were_written(tmp_path):
    with write_atomically(tmp_path / "table.csv") as file:
        file.write("a\r\nb\n")
    assert (tmp_path / "table.csv").read_bytes() == b"a\r\nb\n"


@pytest.mark.skipif(os.name != "posix", reason="file modes are POSIX")
@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600)])
def test_the_file_has_the_rights_of_any_new_file(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        with write_atomically(tmp_path / "result.txt") as file:
            file.write("x")
        assert os.umask(umask) == umask, "the process's umask is left as it was"
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "result.txt").stat().st_mode) == mode


def test_a_bare_name_is_written_here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with write_atomically("result.txt") as file:
        file.write("here")
    assert (tmp_path / "result.txt").read_text() == "here"


def test_a_missing_folder_is_a_plain_error(tmp_path):
    missing = tmp_path / "nowhere" / "result.txt"
    with (
        pytest.raises(
            FileNotFoundError, match=r"cannot write .*result\.txt: .*nowhere does not exist\. Create it first"
        ),
        write_atomically(missing),
    ):
        pytest.fail("the block must not run")


def test_a_folder_is_made_with_its_parents_and_left_empty(tmp_path):
    folder = ensure_writable_folder(str(tmp_path / "a" / "b"))
    assert folder == tmp_path / "a" / "b"
    assert folder.is_dir()
    assert not list(folder.iterdir())
    assert ensure_writable_folder(folder) == folder, "one that is there already will do"


def test_a_folder_that_cannot_be_written_is_a_plain_error(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OSError, match=r"cannot write into .*file.*\. Choose another folder\."):
            ensure_writable_folder(path)


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_the_right_to_write_is_a_plain_error(tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(OSError, match=r"cannot write into .*Permission denied\. Choose another folder\."):
            ensure_writable_folder(tmp_path)
    finally:
        tmp_path.chmod(0o700)


@pytest.mark.skipif(os.name != "posix", reason="folders can be opened on POSIX")
def test_a_durable_file_is_on_the_disk_before_it_takes_its_place_and_its_name_after(tmp_path, monkeypatch):
    done, sync, replace = [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (done.append(stat.S_ISDIR(os.fstat(handle).st_mode)), sync(handle)))
    monkeypatch.setattr(os, "replace", lambda *paths: (done.append("replace"), replace(*paths)))
    with write_atomically(tmp_path / "result.txt", durable=True) as file:
        file.write("here")
    assert done == [False, "replace", True]

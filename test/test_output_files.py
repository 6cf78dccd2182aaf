"""Where output goes: regular files, links, and what is no regular file."""

import os
import subprocess
import sys
import threading

import pytest

from vflatten_ros import cli, output_files
from vflatten_ros.output_files import make_room, whole_file


def write(path, text):
    with whole_file(path) as partial:
        partial.write_text(text)


def test_a_link_stays_and_what_it_names_is_replaced(tmp_path):
    target, link = tmp_path / "real" / "out.json", tmp_path / "link.json"
    target.parent.mkdir()
    target.write_text("old")
    link.symlink_to("real/out.json")
    write(link, "new")
    assert link.is_symlink()
    assert target.read_text() == "new"
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["link.json", "out.json", "real"]


def test_a_link_to_what_is_not_there_yet_makes_it(tmp_path):
    link = tmp_path / "link.json"
    link.symlink_to(tmp_path / "new" / "out.json")
    make_room(link)
    write(link, "new")
    assert (tmp_path / "new" / "out.json").read_text() == "new"
    assert link.is_symlink()


def test_a_failure_leaves_the_old_file_and_nothing_else(tmp_path):
    out = tmp_path / "out"
    out.write_text("old")
    with pytest.raises(ValueError, match="midst"), whole_file(out) as partial:
        partial.write_text("half")
        raise ValueError("in the midst")
    assert out.read_text() == "old"
    assert list(tmp_path.iterdir()) == [out]


def test_a_fifo_is_written_to_and_stays(tmp_path):
    fifo = tmp_path / "fifo"
    os.mkfifo(fifo)
    read = []
    reader = threading.Thread(target=lambda: read.append(fifo.read_text()), daemon=True)
    reader.start()
    make_room(fifo)
    write(fifo, "all of it")
    reader.join(10)
    assert read == ["all of it"]
    assert fifo.is_fifo()


def test_a_device_stays_one(tmp_path):
    link = tmp_path / "null"
    link.symlink_to(os.devnull)
    make_room(link)
    write(link, "gone")
    assert link.is_symlink()
    assert link.is_char_device()


def test_standard_output_goes_on_where_it_is(tmp_path):
    """Redirected to a file it looks like a regular one."""
    code = (
        "from pathlib import Path; from vflatten_ros.output_files import whole_file\n"
        "print('before')\n"
        "with whole_file(Path('/dev/stdout')) as p: p.write_text('whole\\n')\n"
        "print('after')"
    )
    out = tmp_path / "out"
    with out.open("w") as stream:
        subprocess.run([sys.executable, "-c", code], stdout=stream, check=True)
    assert out.read_text() == "before\nwhole\nafter\n"
    piped = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert piped.stdout == b"before\nwhole\nafter\n"


@pytest.mark.parametrize("option", ["--figures", "--json", "--mcap"])
def test_a_folder_that_cannot_be_written_to_is_told_before_the_work(
    option, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(output_files.os, "access", lambda *_: False)  # root may write anywhere
    out = tmp_path if option == "--figures" else tmp_path / "out"
    assert cli.main(["flatten", "none.npz", option, str(out)]) == 1
    assert capsys.readouterr().err == f"vflatten: {tmp_path}: cannot be written to\n"

"""Files that appear whole or not at all, and places that are known to be writable beforehand."""

from __future__ import annotations

import errno
import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

STDOUT, STDERR = 1, 2


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A place to write to; it becomes `path` if all goes well, else it is removed.

    Where `path` is a link, the file that it names is replaced and the link stays. What is no
    regular file, as a FIFO or a device, stays too, and is written to once all is there.
    """
    if _is_stream(path):
        with TemporaryDirectory() as folder:
            partial = Path(folder, "output")
            yield partial
            with partial.open("rb") as source, _opened(path) as target:
                shutil.copyfileobj(source, target)
        return
    path = _destination(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def make_room(path: Path) -> None:
    """The folder of a file; raises OSError where the file could not be written later."""
    if _is_stream(path):
        if not os.access(path, os.W_OK):
            raise PermissionError(errno.EACCES, "cannot be written to", str(path))
        return
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, "is a folder, expected a file", str(path))
    make_folder(_destination(path).parent)


def make_folder(folder: Path) -> None:
    """A folder to write files to; raises OSError where there can be none."""
    folder.mkdir(parents=True, exist_ok=True)
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(errno.EACCES, "cannot be written to", str(folder))


def _destination(path: Path) -> Path:
    """The file that a link names, else the path itself."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def _is_stream(path: Path) -> bool:
    """Whether it is there and cannot be replaced: a FIFO, a device, what we print to."""
    if not path.exists() or path.is_dir():
        return False
    return not path.is_file() or _printed_to(path) is not None


def _printed_to(path: Path) -> int | None:
    """Our own output that a path stands for, as /dev/stdout does."""
    for number in (STDOUT, STDERR):
        try:
            if os.path.samestat(os.fstat(number), path.stat()):
                return number
        except OSError:  # it is closed
            continue
    return None


def _opened(path: Path) -> BinaryIO:
    """A stream to write to; our own output goes on where it is."""
    number = _printed_to(path)
    if number is None:
        return path.open("wb")
    sys.stdout.flush()
    return os.fdopen(os.dup(number), "wb")

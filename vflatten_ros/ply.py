"""Vertices of .ply files, ASCII or binary, as numpy arrays.

The format: Greg Turk, "The PLY polygon file format", 1994.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from vflatten_ros.core.errors import InvalidCloud

TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
LONGEST_HEADER = 1000  # lines
NEEDED = {"format": 2, "element": 3, "property": 3}  # words of such a line


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    columns: tuple[tuple[str, str], ...]  # name, numpy type; "list" for a list


@dataclass(frozen=True)
class _Header:
    encoding: str
    elements: tuple[_Element, ...]
    notes: dict[str, int]  # whole numbers of obj_info lines


def read_ply(path: Path) -> tuple[NDArray[Any], NDArray[Any] | None]:
    """Points and colours of a .ply file's vertices.

    Returns
    -------
    xyz : ndarray of shape (n, 3), or (rows, cols, 3) where the file is organised
    rgb : the same shape, in the file's type, or None

    Raises
    ------
    InvalidCloud
        No .ply file, no vertices, or the file ends early.
    """
    with path.open("rb") as stream:
        header = _read_header(stream)
        tables = _read_elements(stream, header)
    if "vertex" not in tables:
        raise InvalidCloud("the .ply file has no vertices")
    vertex = tables["vertex"]
    missing = [name for name in "xyz" if name not in vertex]
    if missing:
        raise InvalidCloud(f"vertices have no {missing[0]!r}; they have {', '.join(vertex)}")
    xyz = np.stack([vertex[name] for name in "xyz"], axis=1)
    colours = ("red", "green", "blue")
    rgb = np.stack([vertex[name] for name in colours], axis=1) if _has(vertex, colours) else None
    shape = _grid(header, tables, len(xyz))
    if shape is None:
        return xyz, rgb
    return xyz.reshape(*shape, 3), None if rgb is None else rgb.reshape(*shape, 3)


def _read_header(stream: BinaryIO) -> _Header:
    if stream.readline(16).strip() != b"ply":
        raise InvalidCloud("this is no .ply file; its first line is not 'ply'")
    encoding, elements, notes = "", [], {}
    for _ in range(LONGEST_HEADER):
        line = stream.readline(4096)
        words = line.decode("latin-1").split()
        if not line or words[:1] == ["end_header"]:
            break
        if len(words) < NEEDED.get(words[0] if words else "", 0):
            raise InvalidCloud(f"the .ply header is damaged: {' '.join(words)!r} says too little")
        if words[:1] == ["format"]:
            encoding = words[1]
        elif words[:1] == ["element"]:
            if not words[2].isdigit():
                raise InvalidCloud(f"the .ply header has {words[2]!r} rows of {words[1]!r}")
            elements.append(_Element(words[1], int(words[2]), ()))
        elif words[:1] == ["property"] and elements:
            last = elements.pop()
            elements.append(_Element(last.name, last.count, (*last.columns, _column(words))))
        elif words[:1] == ["obj_info"] and len(words) == 3 and words[2].isdigit():
            notes[words[1]] = int(words[2])
    if words[:1] != ["end_header"] or encoding not in ORDERS:
        raise InvalidCloud(f"the .ply header is damaged or of unknown format {encoding!r}")
    return _Header(encoding, tuple(elements), notes)


def _column(words: list[str]) -> tuple[str, str]:
    if words[1] == "list":
        return words[-1], "list"
    if words[1] not in TYPES:
        raise InvalidCloud(f"property {words[-1]!r} has unknown type {words[1]!r}")
    return words[2], TYPES[words[1]]


def _read_elements(stream: BinaryIO, header: _Header) -> dict[str, dict[str, NDArray[Any]]]:
    """Columns of the elements up to the vertices and of those without lists after them."""
    tables: dict[str, dict[str, NDArray[Any]]] = {}
    for element in header.elements:
        if any(kind == "list" for _, kind in element.columns):
            if element.name == "vertex":
                raise InvalidCloud("the vertices have a property that is a list: write plain ones")
            if "vertex" not in tables:
                raise InvalidCloud(f"element {element.name!r} with lists comes before the vertices")
            break
        read = _read_text if header.encoding == "ascii" else _read_binary
        tables[element.name] = read(stream, element, ORDERS[header.encoding])
    return tables


def _read_binary(stream: BinaryIO, element: _Element, order: str) -> dict[str, NDArray[Any]]:
    dtype = np.dtype([(f"{k}", order + kind) for k, (_, kind) in enumerate(element.columns)])
    data = stream.read(dtype.itemsize * element.count) if element.count < 2**31 else b""
    if len(data) < dtype.itemsize * element.count:
        raise InvalidCloud(f"the file ends within its {element.count} {element.name} rows")
    table = np.frombuffer(data, dtype, element.count)
    # In the machine's own byte order, as everything after expects.
    return {
        name: table[f"{k}"].astype(np.dtype(kind)) for k, (name, kind) in enumerate(element.columns)
    }


def _read_text(stream: BinaryIO, element: _Element, order: str) -> dict[str, NDArray[Any]]:
    lines: list[bytes] = []
    while len(lines) < element.count:
        line = stream.readline()
        if not line:
            raise InvalidCloud(f"the file ends within its {element.count} {element.name} rows")
        if line.strip():
            lines.append(line)
    width = len(element.columns)
    values = np.array(b" ".join(lines).split(), dtype=np.float64)
    if values.size != width * element.count:
        raise InvalidCloud(f"{element.name} rows do not have {width} numbers each")
    table = values.reshape(element.count, width)
    return {name: table[:, k].astype(kind) for k, (name, kind) in enumerate(element.columns)}


def _has(table: dict[str, NDArray[Any]], names: tuple[str, ...]) -> bool:
    return all(name in table for name in names)


def _grid(
    header: _Header, tables: dict[str, dict[str, NDArray[Any]]], count: int
) -> tuple[int, int] | None:
    """Rows and columns of an organised cloud."""
    cols, rows = header.notes.get("num_cols", 0), header.notes.get("num_rows", 0)
    camera = tables.get("camera", {})
    if not rows and _has(camera, ("viewportx", "viewporty")) and len(camera["viewportx"]) == 1:
        cols, rows = int(camera["viewportx"][0]), int(camera["viewporty"][0])
    return (rows, cols) if rows > 1 and rows * cols == count else None

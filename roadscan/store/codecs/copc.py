"""COPC 1.0 (*Cloud Optimized Point Cloud Specification*, 2021): LAZ 1.4 whose chunks are the nodes of an octree.

lazrs compresses, laspy lays out the header; written here are the record that describes the octree, the chunks by node,
and the pages of the hierarchy.
"""

from __future__ import annotations

import datetime as dt
import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import lazrs
import numpy as np
import numpy.typing as npt

from roadscan.core.errors import StoreError
from roadscan.store.codecs.las import VLR_RECORD_ID, VLR_USER_ID, Layout

USER_ID: Final = "copc"
INFO_ID: Final = 1  # record id of the COPC info (specification, info VLR)
HIERARCHY_ID: Final = 1000  # record id of the hierarchy
SPAN: Final = 128
"""Voxels along an edge of a node."""

_INFO: Final = struct.Struct("<5d2Q2d11Q")
"""Centre, half edge, spacing; place and size of the root page; first and last GPS time; reserved (spec, info VLR)."""
_ENTRY: Final = np.dtype(
    [("level", "<i4"), ("x", "<i4"), ("y", "<i4"), ("z", "<i4"), ("at", "<u8"), ("bytes", "<i4"), ("points", "<i4")]
)
_EVLR_HEADER: Final = 60  # bytes of the header of an extended variable-length record (LAS 1.4)
_LONGEST_NOTE: Final = 65_535  # bytes that the 16-bit length of a variable-length record allows
_PAGE_NODES: Final = 4096
"""With more nodes, the hierarchy is split into pages, one for each node of the level `_PAGE_LEVEL`."""
_PAGE_LEVEL: Final = 4  # octree level of the nodes with separate pages

Key = tuple[int, int, int, int]
"""Level, and index of the node along x, y and z."""


class CopcWriter:
    """Writes a COPC file node by node; a context manager. Equal nodes in equal order give equal bytes."""

    def __init__(self, path: Path, layout: Layout, offsets: Sequence[float], date: dt.date) -> None:
        """Begin a file.

        Parameters
        ----------
        layout : kind of points (6 or 7, no further dimensions), scales, CRS.
        offsets : of the three coordinates.
        date : stands as the date of creation.
        """
        if layout.point_format not in (6, 7) or layout.further:
            raise StoreError(
                f"points of format {layout.point_format} with {len(layout.further)} further dimensions",
                expected="point format 6 or 7 of LAS 1.4, as COPC holds them", file=path,
            )  # fmt: skip
        self._path, self._layout = path, layout
        self._header = layout.header
        self._header.offsets, self._header.creation_date = np.array(offsets, np.float64), date
        self._kind = layout.records
        self._laz = lazrs.LazVlr.new_for_compression(layout.point_format, 0, True)
        self._nodes: list[Key] = []
        self._counts: list[int] = []
        self._low, self._high = np.full(3, np.iinfo(np.int32).max), np.full(3, np.iinfo(np.int32).min)
        self._gps_s = [np.inf, -np.inf]
        self._returns = np.zeros(16, np.int64)
        self._cube: tuple[Sequence[int], int] = ((0, 0, 0), 0)
        self._stated: dict[str, Any] = {}

    def begin(self, corner: Sequence[int], edge: int, facts: Mapping[str, Any]) -> Self:
        """Open the file, and state the octree's cube (corner and edge in whole steps) and facts about the file."""
        self._cube, self._stated = (corner, edge), dict(facts)
        self._stream = self._path.open("wb+")
        self._write_header()
        self._start = self._stream.tell()
        self._compressor = lazrs.ParLasZipCompressor(self._stream, self._laz)
        return self

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            self._stream.close()

    def add(self, nodes: Sequence[tuple[Key, npt.NDArray[np.void]]]) -> None:
        """Write nodes with their points (n > 0) as records of the layout; they are compressed in parallel."""
        for key, records in nodes:
            self._nodes.append(key)
            self._counts.append(records.size)
            self._note(records)
        self._compressor.compress_chunks([np.ascontiguousarray(r).view(np.uint8) for _, r in nodes])

    def _note(self, records: npt.NDArray[np.void]) -> None:
        for axis, name in enumerate("XYZ"):
            self._low[axis] = min(self._low[axis], records[name].min())
            self._high[axis] = max(self._high[axis], records[name].max())
        times = records["gps_time"]
        self._gps_s = [min(self._gps_s[0], float(times.min())), max(self._gps_s[1], float(times.max()))]
        self._returns += np.bincount(records["bit_fields"] & 15, minlength=16)

    def _finish(self) -> None:
        if len(set(self._nodes)) < len(self._nodes):
            raise StoreError("a node of the octree was written twice", file=self._path)
        self._compressor.done()
        end = self._stream.seek(0, 2)
        self._stream.seek(self._start)
        chunks = lazrs.read_chunk_table(self._stream, self._laz)
        if [points for points, _ in chunks] != self._counts:
            raise StoreError("the chunks do not hold the points of the nodes", file=self._path)
        sizes = np.array([size for _, size in chunks], np.int64)
        entries = _entries(self._nodes, self._counts, sizes, self._start + 8)
        pages, root_bytes = _pages(entries, end + _EVLR_HEADER)
        self._stream.seek(end)
        self._stream.write(struct.pack("<H16sHQ32s", 0, USER_ID.encode(), HIERARCHY_ID, len(pages), b"EPT hierarchy"))
        self._stream.write(pages)
        self._state(end, root_bytes)

    def _state(self, hierarchy_at: int, root_bytes: int) -> None:
        """Write the header again, with the final counts."""
        header = self._header
        header.point_count = sum(self._counts)
        header.mins = self._low * header.scales + header.offsets
        header.maxs = self._high * header.scales + header.offsets
        header.number_of_points_by_return = self._returns[1:].astype(np.uint64)
        header.number_of_evlrs, header.start_of_first_evlr = 1, hierarchy_at
        self._stream.seek(0)
        self._write_header(hierarchy_at + _EVLR_HEADER, root_bytes)

    def _write_header(self, root_at: int = 0, root_bytes: int = 0) -> None:
        import laspy
        from laspy.vlrs.known import LasZipVlr

        header, (corner, edge) = self._header, self._cube
        half = 0.5 * edge * float(header.scales[0])
        low = np.array(corner) * header.scales + header.offsets
        gps_s = self._gps_s if self._counts else (0.0, 0.0)
        info = _INFO.pack(*(low + half), half, 2 * half / SPAN, root_at, root_bytes, *gps_s, *[0] * 11)
        others = [v for v in self._layout.header.vlrs if not isinstance(v, LasZipVlr)]
        note = json.dumps(self._stated, sort_keys=True).encode("ascii")
        if len(note) > _LONGEST_NOTE:
            raise StoreError(f"{len(note):,} bytes of facts", expected=f"at most {_LONGEST_NOTE:,}", file=self._path)
        header.vlrs.clear()
        header.vlrs.append(laspy.VLR(USER_ID, INFO_ID, "COPC info", info))  # the first one, as specified
        header.vlrs.append(LasZipVlr(self._laz.record_data()))
        header.vlrs.extend(others)
        header.vlrs.append(laspy.VLR(VLR_USER_ID, VLR_RECORD_ID, "survey, sheet", note))
        header.are_points_compressed = True
        header.write_to(self._stream)


def _entries(
    keys: Sequence[Key], counts: Sequence[int], sizes: npt.NDArray[np.int64], start: int
) -> npt.NDArray[np.void]:
    """Return one row per node, by level and place; intermediate nodes without points are included."""
    held = {key: (0, 0, 0) for node in keys for key in _with_parents(node)}
    ends = start + np.cumsum(sizes)
    for key, at, size, count in zip(keys, (ends - sizes).tolist(), sizes.tolist(), counts, strict=True):
        held[key] = (at, size, count)
    return np.array([(*key, *held[key]) for key in sorted(held)], _ENTRY)


def _with_parents(key: Key) -> list[Key]:
    level, x, y, z = key
    return [(level - up, x >> up, y >> up, z >> up) for up in range(level + 1)]


def _pages(entries: npt.NDArray[np.void], start: int) -> tuple[bytes, int]:
    """Return the hierarchy's bytes for offset `start` of the file, and the size of the root page.

    A page below the root begins with the node that refers to it there, whose number of points is -1.
    """
    if entries.size <= _PAGE_NODES or not (entries["level"] >= _PAGE_LEVEL).any():
        return entries.tobytes(), entries.nbytes
    deep = entries["level"] >= _PAGE_LEVEL
    shift = np.maximum(entries["level"] - _PAGE_LEVEL, 0)
    place = np.stack([entries[name] >> shift for name in "xyz"], axis=-1)[deep]
    groups, page = np.unique(place, axis=0, return_inverse=True)
    below = [entries[deep][page.ravel() == number] for number in range(len(groups))]
    links = np.zeros(len(groups), _ENTRY)
    links["level"], links["points"] = _PAGE_LEVEL, -1
    for axis, name in enumerate("xyz"):
        links[name] = groups[:, axis]
    links["bytes"] = [one.nbytes for one in below]
    root_bytes = (int((~deep).sum()) + len(groups)) * _ENTRY.itemsize
    links["at"] = start + root_bytes + np.cumsum(links["bytes"]) - links["bytes"]
    root = np.concatenate([entries[~deep], links])
    return b"".join(one.tobytes() for one in (root, *below)), root_bytes

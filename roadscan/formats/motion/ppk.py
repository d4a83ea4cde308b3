"""Raw GNSS observations of a rover, post-processed against a base station by RTKLIB."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final

import numpy as np
import pyarrow as pa

from roadscan.core.crs import geographic_of, world_frame_of
from roadscan.core.errors import ConfigError, CrsError, FormatError, Missing, RoadscanError
from roadscan.core.settings.navigation import PpkBase, PpkSettings
from roadscan.formats.motion.nmea import Nmea
from roadscan.formats.motion.ppk_checks import (
    Separation,
    Track,
    antenna_findings,
    base_place,
    base_position_m,
    common_time,
    fixed_share,
    joined,
)
from roadscan.formats.motion.rtklib_pos import RtklibPos, RtklibPosOptions
from roadscan.formats.motion.rtklib_programs import (
    ANTENNAS,
    SOLVER,
    WHAT,
    Workplace,
    is_ubx,
    need_program,
    observed_epochs,
    programs_digest,
    rinex_header,
    rinex_kind,
)
from roadscan.formats.motion.ubx import Ubx
from roadscan.ingest.reading.format import Item, LogFormat, LogHeader, LogSource, Reject, Rows, beside
from roadscan.ingest.reading.gnss import NO_POSITION, QUALITIES
from roadscan.ingest.reading.records import options_of
from roadscan.ingest.reading.text_table import head_of, open_text

if TYPE_CHECKING:
    from roadscan.core.survey import Survey

RAWX: Final = b"\xb5\x62\x02\x15"
"""Sync characters, class and identifier of UBX-RXM-RAWX."""
_SNIFF_BYTES: Final = 1 << 16  # bytes from which a recording is recognised
_BLOCK_BYTES: Final = 4 << 20  # bytes that are read at once
_CHUNK_ROWS: Final = 100_000  # rows that are yielded at once, 2 MB
_BINS: Final = 400
"""Differences of both directions that a log's record keeps for the picture: as many as it has pixels for them."""


_UNKNOWN: Final = "????"
_UNKNOWN_BASE: Final = {
    "files": [_UNKNOWN], "crs": "EPSG:7930", "x_m": 6378137.0, "y_m": 0.0, "z_m": 0.0, "antenna_height_m": 0.0,
}  # fmt: skip
"""The base that `roadscan inspect` assumes to see a rover's epochs; no file has this name, so that no run takes it."""


class PpkOptions(PpkSettings):
    """Settings of `ppk`; what a log does not state is taken from `[navigation.ppk]`."""

    def shaping(self) -> dict[str, Any]:
        """Return the settings for keys, and a hash of RTKLIB's programs."""
        return {**super().shaping(), "programs": programs_digest()}


class Ppk(LogFormat):
    """Observations of code and carrier phase: RINEX 2 or 3, also packed with gzip, bzip2 or xz, or a UBX recording with
    RXM-RAWX (state format = "ppk" where it holds NAV-PVT or NMEA, too, which are read otherwise).

    RTKLIB computes positions from them, from those of a base station and from navigation files; they become rows like
    those of an RTKLIB solution ([`rtklib_pos`](#rtklib_pos)), in the datum of the base. `[navigation.ppk]` states base
    and settings for all such logs of a survey. RTKLIB (Debian's package `rtklib`) has to be on PATH. A record is an
    epoch of the rover. The page [GNSS post-processing](ppk.md) says what to give and how to read the result.
    """

    name = "ppk"
    title = "raw GNSS observations (RINEX, UBX), post-processed against a base station by RTKLIB"
    yields = ("gnss",)
    suffixes: ClassVar[tuple[str, ...]] = (".obs", ".rnx")
    time = "RTKLIB brings epochs to GPS time; a clock need not be stated, save for its measured offset"
    options = PpkOptions

    def sniff(self, path: Path) -> bool:
        """True for RINEX observations, and for UBX with raw observations and no positions."""
        if rinex_kind(path) == "O":
            return True
        return is_ubx(path) and RAWX in head_of(path, _SNIFF_BYTES) and not any(f.sniff(path) for f in (Ubx(), Nmea()))

    def shared_options(self, survey: Survey) -> dict[str, Any]:
        """Return `[navigation.ppk]`, its files absolute."""
        stated = survey.config.navigation.ppk
        return {} if stated is None else _resolved(stated.model_dump(exclude_unset=True), survey.folder)

    def companions(self, path: Path, options: PpkSettings) -> list[Path]:  # type: ignore[override]
        """Return the files of base, orbits and antennas."""
        named = [*(options.base.files if options.base else ()), *options.navigation, *options.precise]
        named += [options.antenna_calibration] if options.antenna_calibration is not None else []
        return [beside(path, one) for one in named]

    def header(self, source: LogSource) -> LogHeader:
        """Check what is stated of base, antennas and orbits."""
        source.need_file()
        settings, base = _settings(source), _base(source)
        world = _world(source, base)
        base_position_m(base, source.path)
        files = [source.path, *(beside(source.path, one) for one in base.files)]
        station = rinex_header(source.path)
        if not settings.navigation and not any(map(is_ubx, files)):
            raise ConfigError(
                "no navigation file is stated, which holds the satellites' orbits",
                expected="navigation, one or more RINEX navigation files of the day",
                file=source.path,
                missing=Missing("options.navigation", [_UNKNOWN]),
            )
        list(antenna_findings(settings, station, rinex_header(files[1]), source.path))
        said = {name: value for name, value in dataclasses.asdict(station).items() if value}
        if _is_unknown(base):
            return LogHeader(said)
        stated = base.model_dump(mode="json", exclude={"files"}, exclude_none=True)
        return LogHeader({"world_frame": world, **said, "base": stated})

    def lacks(self) -> RoadscanError | None:
        """Return an error where RTKLIB is not on PATH."""
        try:
            need_program(SOLVER, WHAT)
        except ConfigError as error:
            return error
        return None

    def beginning(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Yield the base's position, which is near the drive: nothing is computed before the run."""
        base = _base(source)
        columns = zip(_AXES["place"], base_position_m(base, source.path)[:, None], strict=True)
        yield Rows("gnss", pa.RecordBatch.from_pydict(dict(columns)))

    def read(self, source: LogSource, header: LogHeader) -> Iterator[Item]:
        """Compute the positions, compare them with their witnesses, and stream them.

        An unknown base, which only `roadscan inspect` assumes, gives the rover's epochs alone.
        """
        with tempfile.TemporaryDirectory(prefix="roadscan-ppk-") as folder:
            if _is_unknown(_base(source)):
                yield from _epochs_alone(source, Path(folder))
            else:
                yield from processed(source, header, Path(folder))


def processed(source: LogSource, header: LogHeader, folder: Path) -> Iterator[Item]:
    """Yield positions and findings of a rover's log; `solution.pos` stays in the folder.

    Figures of the solution become the entry `ppk` of the header's attributes.
    """
    settings, base = _settings(source), _base(source)
    mark_m, place = base_position_m(base, source.path), Workplace(folder, settings, source.path)
    rover, observed = _brought(source, place)
    station = rinex_header(observed[0])
    yield from antenna_findings(settings, rinex_header(rover[0]), station, source.path)
    epochs = _observed(rover, "rover", source.path)
    covered, doubts = common_time(epochs, _observed(observed, "base", source.path), settings.max_age_s, source.path)
    yield from doubts
    away_m, doubts = base_place(_track(source, place.single("base")), mark_m, base, station, source.path)
    yield from doubts
    found = place.solved(("forward", "backward", settings.direction), mark_m.tolist())
    found[settings.direction] = found[settings.direction].rename(folder / "solution.pos")
    solved = fixed = told = 0
    for item in _rows(source, folder / "solution.pos"):
        if isinstance(item, Rows):
            solved += item.batch.num_rows
            fixed += item.batch.column("quality").to_pylist().count("fixed")
        elif isinstance(item, Reject):
            told += item.records
        yield item
    if (damaged := _recorded(source.path) - int(epochs.size)) > 0:
        yield Reject("the message RXM-RAWX is damaged, or holds no observation", records=damaged)
    if (lost := int(epochs.size) - solved - told) > 0:
        yield Reject("RTKLIB found no position at this epoch", records=lost)
    yield from fixed_share(fixed, solved)
    forward, backward = _track(source, found["forward"]), _track(source, found["backward"])
    apart = Separation.of(forward, backward, world_frame_of(base.crs))
    yield from apart.findings()
    baseline_m = float(np.linalg.norm(np.median(forward.world_m, axis=0) - mark_m))
    header.attributes["programs"] = programs_digest()
    header.attributes["ppk"] = {
        "epochs": int(epochs.size), "epochs_with_base": covered, "positions": solved, "fixed": fixed,
        "base_from_code_m": round(away_m, 2), "baseline_km": round(baseline_m / 1000, 2), "mode": settings.mode,
        "direction": settings.direction, "ratio": settings.ratio, "apart": apart.figures(_BINS),
    }  # fmt: skip


def _brought(source: LogSource, place: Workplace) -> tuple[list[Path], list[Path]]:
    """Bring all files into the folder in which RTKLIB runs; return the observations of rover and base."""
    settings, base = _settings(source), _base(source)
    antennas = [] if settings.antenna_calibration is None else [settings.antenna_calibration]
    for role, files in (("nav", settings.navigation), ("precise", settings.precise), (ANTENNAS, antennas)):
        place.put(role, [beside(source.path, one) for one in files])
    return place.put("rover", [source.path]), place.put("base", [beside(source.path, one) for one in base.files])


def _epochs_alone(source: LogSource, folder: Path) -> Iterator[Item]:
    """Yield the rover's epochs, which have no position."""
    rover = Workplace(folder, _settings(source), source.path).put("rover", [source.path])
    epochs = _observed(rover, "rover", source.path)
    for first in range(0, epochs.size, _CHUNK_ROWS):
        part = epochs[first : first + _CHUNK_ROWS]
        columns = {"epoch_gps_ns": part, "quality": np.full(part.size, QUALITIES[NO_POSITION])}
        yield Rows("gnss", pa.RecordBatch.from_pydict(columns), first_record=first)


def _recorded(path: Path) -> int:
    """Return how many epochs a UBX recording has; 0 for other files."""
    if not is_ubx(path):
        return 0
    count, rest = 0, b""
    with open_text(path) as stream:
        while block := stream.read(_BLOCK_BYTES):
            count += (rest + block).count(RAWX)
            rest = block[-len(RAWX) + 1 :]
    return count


def _is_unknown(base: PpkBase) -> bool:
    return base.files == [Path(_UNKNOWN)]


def _settings(source: LogSource) -> PpkSettings:
    return options_of(source, PpkOptions)


def _base(source: LogSource) -> PpkBase:
    base = _settings(source).base
    if base is None:
        raise ConfigError(
            "the base station of raw GNSS observations is not stated",
            expected="[navigation.ppk] with base = { files, crs, epoch, x_m, y_m, z_m, antenna_height_m }; the "
            "approximate position in the header of its file is not used",
            file=source.path,
            missing=Missing("options.base", _UNKNOWN_BASE),
        )
    return base


def _world(source: LogSource, base: PpkBase) -> str:
    """Return the world frame of the positions: that of the base's datum."""
    world = world_frame_of(base.crs)
    if source.crs is not None and world_frame_of(source.crs) != world:
        raise CrsError(
            f"the log's crs is '{source.crs}', and the base's position is in '{base.crs}': another datum",
            expected="no crs for this log: its positions are in the datum of the base",
            file=source.path,
        )
    source.need_height("ellipsoidal", "the base's position")
    return world


def _observed(files: list[Path], role: str, log: Path) -> Any:
    epochs = np.concatenate([observed_epochs(one) for one in files])
    if epochs.size == 0:
        raise FormatError(f"the {role}'s file holds no epoch with observations", file=log)
    return epochs


def _rows(source: LogSource, solution: Path) -> Iterator[Item]:
    """Yield the rows of a solution as `rtklib_pos` reads it."""
    crs = geographic_of(world_frame_of(_base(source).crs)).to_wkt()
    read = replace(source, path=solution, options=RtklibPosOptions(), crs=crs, height="ellipsoidal", geoid=None)
    reader = RtklibPos()
    for item in reader.read(read, reader.header(read)):
        yield replace(item, offset=-1) if isinstance(item, Reject) else item


def _track(source: LogSource, solution: Path) -> Track:
    """Return the positions of a solution."""
    parts = [item.batch for item in _rows(source, solution) if isinstance(item, Rows)]
    if not parts:
        raise FormatError("RTKLIB's solution holds no position that can be read", file=source.path)
    tracks = []
    for batch in parts:
        columns = {name: batch.column(name).to_numpy(zero_copy_only=False) for name in _TRACK}
        stack = {end: np.stack([columns[one] for one in names], axis=-1) for end, names in _AXES.items()}
        fixed = np.array(columns["quality"]).astype(np.str_) == "fixed"
        tracks.append(Track(columns["epoch_gps_ns"], stack["place"], stack["sigma"].astype(np.float64), fixed))
    return joined(tracks)


_AXES: Final = {
    "place": ("x_world_m", "y_world_m", "z_world_m"), "sigma": ("sigma_north_m", "sigma_east_m", "sigma_down_m"),
}  # fmt: skip
_TRACK: Final = ("epoch_gps_ns", "quality", *_AXES["place"], *_AXES["sigma"])


def _resolved(value: Any, folder: Path) -> Any:
    """Return settings with absolute paths."""
    if isinstance(value, dict):
        return {key: _resolved(one, folder) for key, one in value.items()}
    if isinstance(value, list):
        return [_resolved(one, folder) for one in value]
    return (folder / value).resolve() if isinstance(value, Path) else value

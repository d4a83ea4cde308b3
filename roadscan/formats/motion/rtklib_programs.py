"""RTKLIB's programs `rnx2rtkp` and `convbin` (Debian's package rtklib): found on PATH, run in a separate folder.

Names of options: RTKLIB 2.4.3, options.c. The position that `rnx2rtkp` gives is that of the mark below the antenna.
"""

from __future__ import annotations

import functools
import hashlib
import lzma
import re
import shutil
import subprocess
import zlib
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from roadscan.core.errors import ConfigError, FormatError
from roadscan.core.gpstime import GPS_EPOCH_UNIX_S, NS_PER_S
from roadscan.core.settings.navigation import PpkSettings
from roadscan.ingest.reading.text_table import head_of, open_text

HEAD_BYTES: Final = 1 << 18
"""The header of an observation file with all systems and comments of its splicing is shorter (bytes)."""
_LABEL: Final = slice(60, 80)
"""Columns of a header line's label."""
_EPOCH: Final = re.compile(
    rb"^(?:> (\d{4})| (\d\d| \d)) ([ \d]\d) ([ \d]\d) ([ \d]\d) ([ \d]\d)([ \d]{2}\d\.\d{6})\d  [01]", re.MULTILINE
)
"""Line of an epoch with observations: RINEX 3 begins it with ">" and four digits of the year, RINEX 2 with two."""
_BLOCK_BYTES: Final = 4 << 20  # bytes that are read at once
_TWO_DIGITS: Final = 80  # years 80 to 99 of RINEX 2 are of the 20th century


@dataclass(frozen=True)
class RinexHeader:
    """What the header of an observation file says of its station."""

    rinex: str
    """Version of the format."""
    approximate_m: tuple[float, ...] | None
    """Approximate geocentric position (m), often a code solution of the receiver; None where it is not said, or 0."""
    antenna_height_m: float | None
    """Height of the antenna's reference point above the mark (m)."""
    antenna: str
    """Type of the antenna."""


def rinex_kind(path: Path) -> str:
    """Return the letter of a RINEX file's kind: O observations, N navigation, C clocks, …; "" for other files.

    "crinex" for observations in Hatanaka's compression.
    """
    first = head_of(path, 80).split(b"\n")[0].decode("ascii", "replace") if path.is_file() else ""
    if first[_LABEL].startswith("CRINEX VERS"):
        return "crinex"
    return first[20:21] if first[_LABEL].startswith("RINEX VERSION") else ""


def rinex_header(path: Path) -> RinexHeader:
    """Return what an observation file says of its station; what cannot be read counts as not said."""
    head = head_of(path, HEAD_BYTES).decode("ascii", "replace")
    said: dict[str, str] = {}
    for line in head.splitlines():
        label = line[_LABEL].strip()
        if label == "END OF HEADER":
            break
        said.setdefault(label, line[:60])
    position = _numbers(said.get("APPROX POSITION XYZ", ""), 3)
    height = _numbers(said.get("ANTENNA: DELTA H/E/N", ""), 1)
    return RinexHeader(
        said.get("RINEX VERSION / TYPE", "")[:9].strip(),
        position if position and any(position) else None,
        height[0] if height else None,
        said.get("ANT # / TYPE", "")[20:40].strip(),
    )


def observed_epochs(path: Path) -> npt.NDArray[np.int64]:
    """Return the epochs (n,) of an observation file, in the order of its lines.

    They are nanoseconds since 1980-01-06 in the file's time system (that of GPS, with few exceptions).
    """
    parts: list[npt.NDArray[np.int64]] = []
    with open_text(path) as stream:
        pending = b""
        while block := stream.read(_BLOCK_BYTES):
            pending += block
            end = pending.rfind(b"\n") + 1
            parts.append(_epochs(pending[:end]))
            pending = pending[max(end, len(pending) - _BLOCK_BYTES) :]
    parts.append(_epochs(pending))
    return np.concatenate(parts)


def _epochs(lines: bytes) -> npt.NDArray[np.int64]:
    found = [m for m in _EPOCH.findall(lines) if 1 <= int(m[2]) <= 12 and int(m[3]) > 0]
    if not found:
        return np.zeros(0, np.int64)
    text = np.array(found, dtype="S12")
    years = np.array([int(long) if long else _year(int(short)) for long, short in text[:, :2].tolist()])
    month, day, hour, minute = (text[:, k].astype(np.int64) for k in range(2, 6))
    months = (years - 1970).astype("datetime64[Y]").astype("datetime64[M]") + (month - 1).astype("timedelta64[M]")
    days = months.astype("datetime64[D]").astype(np.int64) + day - 1
    whole_s = days * 86_400 + hour * 3600 + minute * 60 - GPS_EPOCH_UNIX_S
    return np.asarray(whole_s * NS_PER_S + np.rint(text[:, 6].astype(np.float64) * NS_PER_S).astype(np.int64))


def _year(two_digits: int) -> int:
    return two_digits + (1900 if two_digits >= _TWO_DIGITS else 2000)


def _numbers(text: str, count: int) -> tuple[float, ...] | None:
    try:
        found = tuple(float(text[14 * k : 14 * (k + 1)]) for k in range(count))
    except ValueError:
        return None
    return found if np.all(np.isfinite(found)) else None


Direction = Literal["combined", "forward", "backward"]

SOLVER: Final = "rnx2rtkp"
CONVERTER: Final = "convbin"
WHAT: Final = "post-processing of GNSS observations"
ANTENNAS: Final = "antennas"
"""Role of the file with phase centres of antennas; the others are rover, base, nav and precise."""
UBX_SYNC: Final = b"\xb5\x62"
"""First bytes of a UBX message."""
_SNIFF_BYTES: Final = 4096  # a UBX recording may begin with some other bytes
_SLOWEST_BYTES_PER_S: Final = 20_000.0
"""A program that processes fewer bytes of observations a second has been caught by damaged ones: RTKLIB processes a
hundred times as many."""
PACKING_FAULTS: Final = (EOFError, OSError, zlib.error, lzma.LZMAError)
_LEAST_S: Final = 15.0  # a program is given this long at least, a hundred times what a short log takes
_SYSTEM_BITS: Final = {"G": 1, "R": 4, "E": 8, "J": 16, "C": 32}  # option pos1-navsys
_SINGLE_INTERVAL_S: Final = 30  # interval of the base's solutions: slower than their errors change


def need_program(name: str, what: str) -> Path:
    """Return the path of one of RTKLIB's programs.

    Raises
    ------
    ConfigError
        where it is not installed: the name of the package.
    """
    found = shutil.which(name)
    if found is None:
        raise ConfigError(
            f"{what} needs the program {name} of RTKLIB, which is not on PATH",
            change="install Debian's package rtklib (apt-get install rtklib)",
        )
    return Path(found).resolve()


def programs_digest() -> str:
    """Return a hash of the programs that are installed, for keys; "" where they are not."""
    files = [Path(found).resolve() for name in (SOLVER, CONVERTER) if (found := shutil.which(name))]
    return _digest(tuple((str(file), file.stat().st_mtime_ns) for file in files)) if files else ""


@functools.lru_cache(maxsize=4)
def _digest(files: tuple[tuple[str, int], ...]) -> str:
    whole = hashlib.sha256()
    for file, _ in files:
        whole.update(Path(file).read_bytes())
    return whole.hexdigest()[:16]


def is_ubx(path: Path) -> bool:
    """Whether a file begins as a UBX recording."""
    return path.is_file() and UBX_SYNC in head_of(path, _SNIFF_BYTES)


def is_precise(path: Path) -> bool:
    """Whether a file holds precise orbits (SP3) or clocks (RINEX)."""
    return rinex_kind(path) == "C" or re.match(rb"#[a-d][PV]\d{4}", head_of(path, 80)) is not None


class Workplace:
    """A folder with the files of a rover and its base under plain names, in which RTKLIB runs."""

    def __init__(self, folder: Path, settings: PpkSettings, log: Path) -> None:
        self.folder, self.settings, self.log = folder, settings, log
        self.bytes = 0

    def put(self, role: str, files: Sequence[Path]) -> list[Path]:
        """Bring files in as ROLE0.obs, ROLE1.obs, … (.nav, .sp3, .clk); packed ones are unpacked, UBX converted.

        Raises
        ------
        FormatError
            where a file is not of a kind that RTKLIB reads in this role.
        """
        return [self._put(f"{role}{number}", role, file) for number, file in enumerate(files)]

    def _put(self, name: str, role: str, file: Path) -> Path:
        kind = rinex_kind(file)
        if kind == "crinex":
            raise FormatError("the file is packed by Hatanaka's method", change="unpack it first (crx2rnx)", file=file)
        if role in ("rover", "base") and is_ubx(file):
            return self._converted(name, file)
        wanted = {"rover": "O", "base": "O"}.get(role)
        if wanted and kind != wanted:
            raise FormatError(
                f"the {role}'s file holds no observations",
                expected="RINEX observations or UBX with RXM-RAWX",
                file=file,
            )
        precise = "clk" if kind == "C" else "sp3"
        ending = {"rover": "obs", "base": "obs", "nav": "nav", "precise": precise}.get(role, file.suffix[1:].lower())
        target = self.folder / f"{name}.{ending}"
        _unpack(file, target)
        self.bytes += target.stat().st_size
        return target

    def _converted(self, name: str, file: Path) -> Path:
        """Return observations of a UBX recording; its orbits go beside them."""
        raw, target = self.folder / f"{name}.ubx", self.folder / f"{name}.obs"
        _unpack(file, raw)
        self.bytes += raw.stat().st_size
        program = need_program(CONVERTER, "a UBX recording")
        self._run([program, "-r", "ubx", "-os", "-od", "-o", target.name, "-n", f"nav-{name}.nav", raw.name], raw)
        raw.unlink()
        if not target.is_file() or rinex_kind(target) != "O":
            raise FormatError("the recording holds no raw observations", expected="UBX-RXM-RAWX", file=file)
        return target

    def solved(self, directions: Iterable[Direction], base_m: Sequence[float]) -> dict[Direction, Path]:
        """Return the files of the rover's positions by direction, which are computed beside one another."""
        wanted, observed = list(dict.fromkeys(directions)), ["rover*.obs", "base*.obs"]
        with ThreadPoolExecutor(len(wanted)) as threads:
            files = threads.map(lambda one: self._solved(one, self._options(one, base_m), observed), wanted)
            return dict(zip(wanted, files, strict=True))

    def single(self, role: str) -> Path:
        """Return the file of positions of a station by its code observations, every 30 s."""
        options = {"pos1-posmode": "single", "pos1-ionoopt": "brdc", "pos1-tropopt": "saas", **self._common()}
        return self._solved(f"single-{role}", options, [f"{role}*.obs"], "-ti", str(_SINGLE_INTERVAL_S))

    def _solved(self, name: str, options: dict[str, str], observed: list[str], *more: str) -> Path:
        config, target = self.folder / f"{name}.conf", self.folder / f"{name}.pos"
        config.write_text("".join(f"{key}={value}\n" for key, value in options.items()))
        orbits = [one for one in ("nav*.nav", "precise*.sp3", "precise*.clk") if any(self.folder.glob(one))]
        program = need_program(SOLVER, WHAT)
        said = self._run([program, *more, "-k", config.name, "-o", target.name, *observed, *orbits], target)
        if not target.is_file() or not _has_positions(target):
            words = f": {said}" if said else ""
            raise FormatError(
                f"RTKLIB found no position of the {observed[0][:-5]} at any epoch{words}",
                change="give navigation files of the day, and observations of one time",
                file=self.log,
            )
        return target

    def _options(self, direction: Direction, base_m: Sequence[float]) -> dict[str, str]:
        s, base = self.settings, self.settings.base
        found = {
            "pos1-posmode": s.mode, "pos1-soltype": direction, "pos1-frequency": "l1" + "".join(
                f"+{k}" for k in range(2, s.frequencies + 1)
            ),
            "pos1-ionoopt": "brdc", "pos1-tropopt": "saas", "pos1-dynamics": "off",
            "pos2-armode": s.ambiguities, "pos2-gloarmode": "off", "pos2-bdsarmode": "on",
            "pos2-arthres": f"{s.ratio:g}", "pos2-maxage": f"{s.max_age_s:g}",
            "ant1-antdelu": f"{s.antenna_height_m or 0.0:.4f}",
            "ant2-antdelu": f"{(base.antenna_height_m if base else None) or 0.0:.4f}",
            "ant2-postype": "xyz", **{f"ant2-pos{k}": f"{x:.4f}" for k, x in enumerate(base_m, 1)},
            **self._common(),
        }  # fmt: skip
        if s.antenna_calibration is not None:
            found |= {
                "pos1-posopt2": "on", "file-rcvantfile": next(self.folder.glob(f"{ANTENNAS}0.*")).name,
                "ant1-anttype": s.antenna, "ant2-anttype": base.antenna if base else "",
            }  # fmt: skip
        return found

    def _common(self) -> dict[str, str]:
        s = self.settings
        return {
            "pos1-elmask": f"{s.elevation_mask_deg:g}", "pos1-sateph": "precise" if s.precise else "brdc",
            "pos1-navsys": str(sum(_SYSTEM_BITS[one] for one in set(s.systems))),
            "out-solformat": "llh", "out-timesys": "gpst", "out-timeform": "hms", "out-timendec": "6",
            "out-degform": "deg", "out-height": "ellipsoidal", "out-outhead": "on", "out-solstatic": "all",
        }  # fmt: skip

    def _run(self, command: list[Path | str], subject: Path) -> str:
        """Run a program in the folder; return the last thing that it says, where that is no report of progress."""
        most_s = _LEAST_S + self.bytes / _SLOWEST_BYTES_PER_S
        heard = subject.with_suffix(".txt")
        with heard.open("wb") as out:
            try:
                ended = subprocess.run(
                    command,
                    cwd=self.folder,
                    stdin=subprocess.DEVNULL,
                    stdout=out,
                    stderr=out,
                    timeout=most_s,
                    check=False,
                )
            except subprocess.TimeoutExpired as error:
                raise FormatError(
                    f"{Path(command[0]).name} did not end within {most_s:.0f} s",
                    expected="sound observations",
                    file=self.log,
                ) from error
        if ended.returncode < 0:
            raise FormatError(
                f"{Path(command[0]).name} broke down (signal {-ended.returncode})",
                expected="sound observations",
                file=self.log,
            )
        with heard.open("rb") as stream:
            stream.seek(max(0, heard.stat().st_size - _SNIFF_BYTES))
            said = re.split(r"[\r\n]+", stream.read().decode("utf-8", "replace"))
        return next((one.strip() for one in reversed(said) if one.strip().startswith("error")), "")


def _unpack(file: Path, target: Path) -> None:
    """Copy a file, without its compression."""
    try:
        with open_text(file) as stream, target.open("wb") as out:
            shutil.copyfileobj(stream, out)
    except PACKING_FAULTS as error:
        raise FormatError(f"the file cannot be read: {error}", file=file) from error


def _has_positions(file: Path) -> bool:
    with file.open("rb") as stream:
        return any(not line.startswith(b"%") and line.strip() for line in stream)

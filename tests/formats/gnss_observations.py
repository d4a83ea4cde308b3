"""Observations of GPS satellites on circular orbits, by IS-GPS-200 (20.3.3.4.3) and none of roadscan's code.

Clocks of satellites and receivers are right and there is no ionosphere; the troposphere is 2.4 m over the sine of the
elevation.
"""

from __future__ import annotations

import datetime as dt
import struct
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]

MU, OMEGA_EARTH, LIGHT = 3.986005e14, 7.2921151467e-5, 299_792_458.0
WAVES_M = (LIGHT / 1575.42e6, LIGHT / 1227.60e6)
AXIS_M, INCLINATION = 26_559_710.0, np.radians(55.0)
ZENITH_DELAY_M = 2.4
LEAST_ELEVATION = np.radians(12.0)
CODE_SIGMA_M, CARRIER_SIGMA_M = 0.3, 0.002


@dataclass(frozen=True)
class Sky:
    """When the ephemerides are of; times count from there."""

    week: int = 2314
    toe_s: int = 302_400
    """Second of the GPS week: with that week, Wednesday 2024-05-15, 12:00:00 GPST."""

    @property
    def begin(self) -> dt.datetime:
        return dt.datetime(1980, 1, 6) + dt.timedelta(weeks=self.week, seconds=self.toe_s)

    def when(self, t: float) -> tuple[dt.datetime, float]:
        when = self.begin + dt.timedelta(seconds=float(np.floor(t)))
        return when, when.second + float(t - np.floor(t))


SKY = Sky()


@dataclass(frozen=True)
class Satellite:
    prn: int
    node: float
    """Longitude of the ascending node at the week's beginning (rad)."""
    anomaly: float
    """Mean anomaly at the time of ephemeris (rad)."""

    def position(self, since_toe_s: float, toe_s: float) -> Float64:
        """Earth-fixed position (3,) at a time, of a circular orbit."""
        u = self.anomaly + np.sqrt(MU / AXIS_M**3) * since_toe_s
        node = self.node - OMEGA_EARTH * (since_toe_s + toe_s)
        x, y = AXIS_M * np.cos(u), AXIS_M * np.sin(u)
        return np.array(
            [
                x * np.cos(node) - y * np.cos(INCLINATION) * np.sin(node),
                x * np.sin(node) + y * np.cos(INCLINATION) * np.cos(node),
                y * np.sin(INCLINATION),
            ]
        )


SATELLITES = tuple(
    Satellite(1 + 5 * plane + slot, np.radians(60.0 * plane), np.radians(72.0 * slot + 25.0 * plane))
    for plane in range(6)
    for slot in range(5)
)


def distance(satellite: Satellite, t: float, receiver_m: Float64, toe_s: float) -> tuple[float, float]:
    """Distance (m) at reception, and elevation (rad)."""
    delay = 0.07
    for _ in range(4):
        away = satellite.position(t - delay, toe_s)
        turn = OMEGA_EARTH * delay
        at = np.array(
            [np.cos(turn) * away[0] + np.sin(turn) * away[1], np.cos(turn) * away[1] - np.sin(turn) * away[0], away[2]]
        )
        range_m = float(np.linalg.norm(at - receiver_m))
        delay = range_m / LIGHT
    up = receiver_m / np.linalg.norm(receiver_m)
    return range_m, float(np.arcsin((at - receiver_m) @ up / range_m))


@dataclass(frozen=True)
class Epoch:
    t: float
    """Seconds after the time of ephemeris."""
    seen: dict[int, tuple[float, float, float, float]]
    """By satellite: code (m) and carrier (cycles) on L1, the same on L2."""


def observe(path_m: Callable[[float], Float64], times_s: Float64, seed: int = 1, sky: Sky = SKY) -> list[Epoch]:
    """Observations of a receiver on its way."""
    rng = np.random.default_rng(seed)
    whole = {s.prn: rng.integers(-(10**6), 10**6, 2) for s in SATELLITES}
    epochs = []
    for t in times_s:
        seen, at_m = {}, path_m(float(t))
        for s in SATELLITES:
            range_m, elevation = distance(s, float(t), at_m, sky.toe_s)
            if elevation < LEAST_ELEVATION:
                continue
            path = range_m + ZENITH_DELAY_M / np.sin(elevation)
            code = path + rng.normal(0.0, CODE_SIGMA_M, 2)
            carrier = [
                (path + rng.normal(0.0, CARRIER_SIGMA_M)) / w + n for w, n in zip(WAVES_M, whole[s.prn], strict=True)
            ]
            seen[s.prn] = (float(code[0]), float(carrier[0]), float(code[1]), float(carrier[1]))
        epochs.append(Epoch(float(t), seen))
    return epochs


def _line(text: str, label: str) -> str:
    return f"{text:<60}{label}\n"


def rinex2(epochs: list[Epoch], approximate_m: Float64, antenna_height_m: float = 0.0, sky: Sky = SKY) -> str:
    """RINEX 2.11 with C1, L1, P2, L2."""
    out = _line(f"{2.11:9.2f}{'':11}OBSERVATION DATA    G (GPS)", "RINEX VERSION / TYPE")
    out += _line("".join(f"{x:14.4f}" for x in approximate_m), "APPROX POSITION XYZ")
    out += _line(f"{antenna_height_m:14.4f}{0:14.4f}{0:14.4f}", "ANTENNA: DELTA H/E/N")
    out += _line("     1     1", "WAVELENGTH FACT L1/2")
    out += _line("     4    C1    L1    P2    L2", "# / TYPES OF OBSERV")
    out += _line(f"{sky.begin:  %Y    %m    %d    %H    %M}    0.0000000     GPS", "TIME OF FIRST OBS")
    out += _line("", "END OF HEADER")
    for epoch in epochs:
        when, second = sky.when(epoch.t)
        names = "".join(f"G{prn:2d}" for prn in epoch.seen)
        out += f" {when:%y} {when.month:2d} {when.day:2d} {when.hour:2d} {when.minute:2d}{second:11.7f}  0"
        out += f"{len(epoch.seen):3d}{names}\n"
        for values in epoch.seen.values():
            out += "".join(f"{x:14.3f}  " for x in values) + "\n"
    return out


def rinex3(epochs: list[Epoch], approximate_m: Float64) -> str:
    """RINEX 3.04 with C1C, L1C, C2W, L2W."""
    out = _line(f"{3.04:9.2f}{'':11}OBSERVATION DATA    G: GPS", "RINEX VERSION / TYPE")
    out += _line("".join(f"{x:14.4f}" for x in approximate_m), "APPROX POSITION XYZ")
    out += _line("G    4 C1C L1C C2W L2W", "SYS / # / OBS TYPES")
    out += _line("  2024     5    15    12     0    0.0000000     GPS", "TIME OF FIRST OBS")
    out += _line("", "END OF HEADER")
    for epoch in epochs:
        when, second = SKY.when(epoch.t)
        out += f"> {when:%Y %m %d %H %M}{second:11.7f}  0{len(epoch.seen):3d}\n"
        for prn, values in epoch.seen.items():
            out += f"G{prn:02d}" + "".join(f"{x:14.3f}  " for x in values) + "\n"
    return out


def navigation(sky: Sky = SKY, ahead_rad: float = 0.0) -> str:
    """RINEX 2.10 navigation file of all satellites, wrong by an angle along their orbits; next to no ionosphere."""
    out = _line(f"{2.10:9.2f}{'':11}N: GPS NAV DATA", "RINEX VERSION / TYPE")
    out += _line("  " + "".join(_number(1e-12)[7:] for _ in range(4)), "ION ALPHA")
    out += _line("  " + "".join(_number(1e3)[7:] for _ in range(4)), "ION BETA")
    out += _line("", "END OF HEADER")
    for s in SATELLITES:
        out += f"{s.prn:2d} {sky.begin:%y %m %d %H %M %S}.0" + "".join(map(_number, (0, 0, 0))) + "\n"
        for row in (
            (1, 0, 0, s.anomaly + ahead_rad), (0, 0, 0, np.sqrt(AXIS_M)), (sky.toe_s, 0, s.node, 0),
            (INCLINATION, 0, 0, 0), (0, 1, sky.week, 0), (2, 0, 0, 1), (sky.toe_s - 1800, 4),
        ):  # fmt: skip
            out += "   " + "".join(map(_number, row)) + "\n"
    return out


def sp3(hours: float = 4.0) -> str:
    """SP3-c of all satellites every 15 minutes from some hours before to as many after, with clocks that are right."""
    count = int(8 * hours) + 1
    begin = SKY.begin - dt.timedelta(hours=hours)
    first = f"{begin:%Y} {begin.month:2d} {begin.day:2d} {begin.hour:2d} {begin.minute:2d}"
    out = f"#cP{first}  0.00000000 {count:7d} ORBIT\n"
    out += f"## {SKY.week:4d} {SKY.toe_s - 3600 * hours:15.8f}   900.00000000 60445 0.5000000000000\n"
    names = [f"G{s.prn:02d}" for s in SATELLITES] + ["  0"] * (85 - len(SATELLITES))
    for k in range(5):
        head = f"+   {len(SATELLITES):2d}   " if k == 0 else "+        "
        out += head + "".join(names[17 * k : 17 * (k + 1)]) + "\n"
    out += ("++       " + "  0" * 17 + "\n") * 5
    out += ("%c G  cc GPS ccc cccc cccc cccc cccc ccccc ccccc ccccc ccccc\n") + "%c cc cc ccc\n"
    out += "%f  1.2500000  1.025000000  0.00000000000  0.000000000000000\n%f\n%i\n%i\n" + "/*\n" * 4
    for k in range(count):
        when = begin + dt.timedelta(minutes=15 * k)
        out += f"*  {when:%Y} {when.month:2d} {when.day:2d} {when.hour:2d} {when.minute:2d}  0.00000000\n"
        for s in SATELLITES:
            x, y, z = s.position(900.0 * k - 3600 * hours, SKY.toe_s) / 1000
            out += f"PG{s.prn:02d}{x:14.6f}{y:14.6f}{z:14.6f}{0.0:14.6f}\n"
    return out + "EOF\n"


def _number(x: float) -> str:
    return f"{x:19.12E}".replace("E", "D")


def ubx(epochs: list[Epoch]) -> bytes:
    """RXM-RAWX of each epoch (u-blox F9 HPG 1.32, UBX-22008968, 3.17.5): L1 C/A, and L2 CL for the second carrier."""
    out = b""
    for epoch in epochs:
        payload = struct.pack("<dHbBBBH", SKY.toe_s + epoch.t, SKY.week, 18, 2 * len(epoch.seen), 1, 1, 0)
        for prn, (c1, l1, c2, l2) in epoch.seen.items():
            for signal, code, carrier in ((0, c1, l1), (3, c2, l2)):
                payload += struct.pack(
                    "<ddfBBBBHBBBBBB", code, carrier, 0.0, 0, prn, signal, 0, 60_000, 45, 5, 1, 6, 0b0111, 0
                )
        body = struct.pack("<BBH", 0x02, 0x15, len(payload)) + payload
        a = b = 0
        for byte in body:
            a = (a + byte) & 0xFF
            b = (b + a) & 0xFF
        out += b"\xb5\x62" + body + bytes([a, b])
    return out


def ecef(latitude_deg: float, longitude_deg: float, height_m: float) -> Float64:
    """Geocentric position on the ellipsoid of WGS 84."""
    a, e2 = 6_378_137.0, 0.00669437999014
    la, lo = np.radians([latitude_deg, longitude_deg])
    n = a / np.sqrt(1 - e2 * np.sin(la) ** 2)
    return np.array(
        [
            (n + height_m) * np.cos(la) * np.cos(lo),
            (n + height_m) * np.cos(la) * np.sin(lo),
            (n * (1 - e2) + height_m) * np.sin(la),
        ]
    )


def enu_axes(latitude_deg: float, longitude_deg: float) -> Float64:
    """East, north, up as rows (3, 3)."""
    la, lo = np.radians([latitude_deg, longitude_deg])
    return np.array(
        [
            [-np.sin(lo), np.cos(lo), 0.0],
            [-np.sin(la) * np.cos(lo), -np.sin(la) * np.sin(lo), np.cos(la)],
            [np.cos(la) * np.cos(lo), np.cos(la) * np.sin(lo), np.sin(la)],
        ]
    )

"""Velodyne captures whose clock steps: the capture's time, GPRMC and the PPS byte against the stamps, part by part."""

from __future__ import annotations

import datetime as dt
from pathlib import Path

import numpy as np
import pytest

from roadscan.core.errors import TimeSystemError
from roadscan.core.gpstime import Clock, TimeSystem
from tests.formats.readings import Readings, read
from tests.formats.test_velodyne_pcap import (
    CLOCK,
    HOUR_9,
    HOUR_9_GPS,
    PERIOD_US,
    VLP_16,
    Packets,
    capture,
    data_packet,
    frame,
    position_packet,
    posix_ns,
    turning,
)

PERIOD = PERIOD_US[VLP_16]
LOCKED, NO_PPS = 2, 0
START_S = 600.0
"""True time of the first packet past the hour."""


def piece(
    true_s: float, stamp_s: float, count: int = 100, capture_s: float = 0.0, lost: frozenset[int] = frozenset()
) -> Packets:
    """`count` packets from `true_s` past nine on, stamped from `stamp_s`; the capture's clock is off by `capture_s`."""
    out: Packets = []
    for k in range(count):
        if k in lost:
            continue
        since_us = round(k * PERIOD)
        stamp_us = round(stamp_s * 1e6) + since_us
        content = frame(data_packet(stamp_us % 3_600_000_000, turning(round(k * 12 * 20)), product=VLP_16))
        out.append((posix_ns(HOUR_9) + round((true_s + capture_s) * 1e6) * 1000 + since_us * 1000 + 400_000, content))
    return out


def heard(
    true_s: float, stamp_s: float, pps: int = LOCKED, status: str = "A", late_s: int = 0, capture_s: float = 0.0
) -> Packets:
    """A position packet at `true_s` past nine, stamped `stamp_s`, whose sentence is `late_s` old."""
    moment = HOUR_9 + dt.timedelta(seconds=int(true_s) - late_s)
    payload = bytearray(position_packet(round(stamp_s * 1e6) % 3_600_000_000, moment, status))
    payload[202] = pps
    return [(posix_ns(HOUR_9) + round((true_s + capture_s) * 1e6) * 1000, frame(bytes(payload), 8308))]


def log_of(folder: Path, packets: Packets, **options: object) -> Readings:
    return read("velodyne_pcap", capture(folder / "a.pcap", packets), dict(options), clock=CLOCK)


def true_s(log: Readings) -> np.ndarray:
    """Seconds past nine of the first return of each packet."""
    return (log.epochs[::384] - HOUR_9_GPS) / 1e9


def said(log: Readings) -> dict[str, str]:
    return {one.witness: one.text for one in log.findings}


# --- steps of the sensor's clock ----------------------------------------------------------------------


@pytest.mark.parametrize("stamp_s", [5.0, 590.0, 599.0, 603.0, 640.0, 3_590.0])
def test_a_restart_forward_or_back_leaves_out_what_follows(tmp_path: Path, stamp_s: float) -> None:
    """The sensor starts anew a second later; GPRMC goes on and the PPS byte is 0."""
    packets = heard(600.0, 600.1) + piece(600.2, 600.2)
    packets += heard(601.0, stamp_s - 0.01, NO_PPS) + piece(601.0, stamp_s) + heard(602.0, stamp_s + 1, NO_PPS)
    log = log_of(tmp_path, packets)
    assert np.allclose(true_s(log), 600.2 + np.arange(100) * PERIOD / 1e6, atol=1e-6)
    assert log.rejected == 100
    assert "record 102" in said(log)["lidar_clock_step"]
    assert "lidar_gprmc" not in said(log)


@pytest.mark.parametrize("status", ["A", "V"])
def test_a_lock_that_is_found_midway_leaves_out_what_came_before(tmp_path: Path, status: str) -> None:
    packets = heard(600.0, 39.9, NO_PPS, status) + piece(600.0, 40.0)
    packets += heard(600.2, 600.2) + piece(600.2, 600.2)
    log = log_of(tmp_path, packets)
    assert np.allclose(true_s(log), 600.2 + np.arange(100) * PERIOD / 1e6, atol=1e-6)
    assert log.rejected == 100
    assert next(one for one in log.findings if one.witness == "lidar_clock_step").left_out == 100


def test_a_sensor_that_steps_and_finds_its_lock_again_loses_what_lies_between(tmp_path: Path) -> None:
    """Over the end of an hour."""
    packets = heard(3_598.0, 3_598.1) + piece(3_599.0, 3_599.0)
    packets += heard(3_600.0, 11.9, NO_PPS) + piece(3_600.0, 12.0, 150)
    packets += heard(3_600.9, 0.9) + piece(3_601.0, 1.0, 700) + heard(3_602.1, 2.1)
    log = log_of(tmp_path, packets)
    expected = [3_599.0 + np.arange(100) * PERIOD / 1e6, 3_601.0 + np.arange(700) * PERIOD / 1e6]
    assert np.allclose(true_s(log), np.concatenate(expected), atol=1e-6)
    assert log.rejected == 150


def test_a_step_of_less_than_a_second_is_left_out_unless_it_is_locked(tmp_path: Path) -> None:
    """PPS is lost, and the sensor's second slips by 0.6 s: GPRMC cannot say so, PPS can."""
    packets = heard(600.0, 600.1) + piece(600.2, 600.2)
    packets += heard(601.0, 601.7, NO_PPS) + piece(601.0, 601.6)
    log = log_of(tmp_path, packets)
    assert (true_s(log).size, log.rejected) == (100, 100)
    packets[-101:-100] = heard(601.0, 601.7, LOCKED)
    log = log_of(tmp_path, packets)
    assert (true_s(log).size, log.rejected) == (200, 0)
    assert "lidar_clock_step" in said(log)


@pytest.mark.slow
def test_a_step_in_a_long_capture_is_found_behind_its_beginning(tmp_path: Path) -> None:
    """The header has looked at 1,000 packets; the capture is looked through at the step."""
    packets = heard(600.0, 600.1) + piece(600.2, 600.2, 1_500) + heard(603.0, 7.9, NO_PPS) + piece(603.0, 8.0, 700)
    log = log_of(tmp_path, packets)
    assert (true_s(log).size, log.rejected) == (1_500, 700)
    # Only a later part is on GPS time, and what came before was taken: refused.
    packets = heard(600.0, 602.1, NO_PPS) + piece(600.2, 602.2, 1_500) + heard(603.0, 603.1) + piece(603.2, 603.2, 700)
    with pytest.raises(TimeSystemError, match="split the capture there"):
        log_of(tmp_path, packets)


def test_without_position_packets_a_step_is_relative(tmp_path: Path) -> None:
    """The part on the capture's own clock counts; the stated hour is that of the first packet."""
    back = piece(600.0, 600.0) + piece(601.0, 5.0)
    log = log_of(tmp_path, back, hour=9)
    assert (true_s(log)[0], log.rejected) == (600.0, 100)
    midway = piece(600.0, 40.0) + piece(600.2, 600.2)
    log = log_of(tmp_path, midway, hour=9)
    assert (true_s(log)[0], log.rejected) == (600.2, 100)
    # A computer whose clock is off by minutes says nothing but that it is a step: the first packet has the stated hour.
    off = piece(600.0, 600.0, capture_s=200.0) + piece(601.0, 5.0, capture_s=200.0)
    log = log_of(tmp_path, off, hour=9)
    assert (true_s(log)[0], log.rejected) == (600.0, 100)
    free = Clock(TimeSystem.FREE, offset_s=1.4e9)
    log = read("velodyne_pcap", tmp_path / "a.pcap", clock=free)
    assert log.rejected == 100


# --- what is no step ----------------------------------------------------------------------------------


def test_the_end_of_an_hour_is_no_step(tmp_path: Path) -> None:
    packets = heard(3_599.0, 3_599.1) + piece(3_599.9, 3_599.9, 1_400) + heard(3_602.1, 2.1)
    log = log_of(tmp_path, packets)
    assert np.allclose(true_s(log), 3_599.9 + np.arange(1_400) * PERIOD / 1e6, atol=1e-6)
    assert (log.rejected, log.findings) == (0, [])


@pytest.mark.parametrize("set_s", [-3_000.0, -15.0, 15.0, 3_000.0])
def test_the_captures_own_clock_is_set(tmp_path: Path, set_s: float) -> None:
    """NTP sets the computer: the packets go on evenly, or some are lost and GPRMC decides."""
    before, after = piece(600.2, 600.2), piece(600.2 + 100 * PERIOD / 1e6, 600.2 + 100 * PERIOD / 1e6, capture_s=set_s)
    packets = heard(600.0, 600.1) + before + after + heard(601.0, 601.1, capture_s=set_s)
    log = log_of(tmp_path, packets)
    assert (true_s(log).size, log.rejected) == (200, 0)
    assert "set by" in said(log)["lidar_clock_step"]
    lossy = heard(600.0, 600.1, NO_PPS) + before + piece(601.2, 601.2, capture_s=set_s)
    lossy += heard(602.0, 602.1, NO_PPS, capture_s=set_s)
    log = log_of(tmp_path, lossy)
    assert (true_s(log).size, log.rejected) == (200, 0)
    assert "the stamps are used" in said(log)["lidar_clock_step"]


def test_a_computer_that_stalls_is_no_step(tmp_path: Path) -> None:
    """It stops reading for 0.8 s: what the buffer holds is stamped late, the rest is lost."""
    packets = heard(600.0, 600.1) + piece(600.2, 600.2, 2_000, lost=frozenset(range(700, 1_000)))
    stalled = posix_ns(HOUR_9) + 601_500_000_000
    late = [(max(at, stalled) if 500 < k < 702 else at, content) for k, (at, content) in enumerate(packets)]
    log = log_of(tmp_path, late + heard(603.0, 603.1))
    assert (true_s(log).size, log.rejected, log.findings) == (1_700, 0, [])


def test_a_pause_of_the_capture_is_no_step(tmp_path: Path) -> None:
    packets = heard(600.0, 600.1) + piece(600.2, 600.2) + piece(1_700.0, 1_700.0) + heard(1_701.0, 1_701.2)
    log = log_of(tmp_path, packets)
    assert (true_s(log).size, log.rejected, log.findings) == (200, 0, [])


@pytest.mark.slow
def test_stamps_that_drift_are_named(tmp_path: Path) -> None:
    packets = heard(600.0, 600.1) + piece(600.2, 600.2, 700)
    for k in range(1, 40):
        packets += piece(600.2 + 2.0 * k, 600.2 + 2.002 * k, 100)
    log = log_of(tmp_path, packets)
    assert log.rejected == 0
    assert "+0.08 s" in said(log)["lidar_gprmc"]


@pytest.mark.witness("lidar_pps")
def test_a_capture_without_pps_is_named_and_used(tmp_path: Path) -> None:
    packets = heard(600.0, 600.1, NO_PPS) + piece(600.2, 600.2) + heard(601.0, 601.1, NO_PPS)
    log = log_of(tmp_path, packets)
    assert (true_s(log).size, log.rejected, list(said(log))) == (100, 0, ["lidar_pps"])


@pytest.mark.witness("lidar_gprmc")
@pytest.mark.parametrize("late_s", [-2, 2])
def test_sentences_that_are_whole_seconds_off_are_named(tmp_path: Path, late_s: int) -> None:
    packets = heard(600.0, 600.1, late_s=late_s) + piece(600.2, 600.2) + heard(601.0, 601.1, late_s=late_s)
    log = log_of(tmp_path, packets)
    assert (true_s(log).size, log.rejected, list(said(log))) == (100, 0, ["lidar_gprmc"])


# --- packets twice, out of order, lost ----------------------------------------------------------------


@pytest.mark.witness("lidar_packets_twice")
def test_packets_of_a_mirrored_port_count_once(tmp_path: Path) -> None:
    once = heard(600.0, 600.1) + piece(600.2, 600.2, 800)
    for behind in (1, 5):
        copies = [(at + 1_000_000 * behind, content) for at, content in once]
        both = sorted([*once, *copies], key=lambda one: one[0])
        log = log_of(tmp_path, both)
        assert np.allclose(true_s(log), 600.2 + np.arange(800) * PERIOD / 1e6, atol=1e-6)
        assert log.reasons == {"the packet stands twice in the capture"}
        assert log.rejected == 800


@pytest.mark.parametrize("count", [60, 100, 2_000])
def test_a_capture_that_is_joined_to_itself_counts_once(tmp_path: Path, count: int) -> None:
    once = heard(600.0, 600.1) + piece(600.2, 600.2, count)
    log = log_of(tmp_path, once + once)
    assert np.allclose(true_s(log), 600.2 + np.arange(count) * PERIOD / 1e6, atol=1e-6)
    assert log.rejected == count


def test_packets_out_of_order_are_put_in_order_and_named(tmp_path: Path) -> None:
    packets = heard(600.0, 600.1) + piece(600.2, 600.2, 300)
    packets[51], packets[52] = packets[52], packets[51]
    packets[151], packets[154] = packets[154], packets[151]
    log = log_of(tmp_path, packets)
    assert (np.diff(true_s(log)) > 0).all()
    assert log["sweep"].max() == (300 * 12 * 20 - 1) // 36_000
    assert "out of order" in said(log)["lidar_packets_twice"]


def test_lost_packets_cost_themselves(tmp_path: Path) -> None:
    packets = heard(600.0, 600.1) + piece(600.2, 600.2, 900, lost=frozenset({*range(20, 40), *range(500, 700)}))
    log = log_of(tmp_path, packets)
    assert (true_s(log).size, log.rejected, log.findings) == (680, 0, [])

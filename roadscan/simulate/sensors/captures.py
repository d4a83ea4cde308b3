"""Writes the lidar's capture: packets of its maker, with what belongs beside them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Final, TypeAlias

import numpy as np
import pyarrow.parquet as pq

from roadscan.core.gpstime import TimeSystem, utc_from_gps_ns
from roadscan.simulate.caster import World
from roadscan.simulate.drive import Drive
from roadscan.simulate.lidar_model import lidar_model
from roadscan.simulate.scene import Scene
from roadscan.simulate.sensors import hesai, lidar, ouster
from roadscan.simulate.sensors.clock import SensorClock
from roadscan.simulate.sensors.pcap import FILE_HEADER, PcapWriter

FILE: Final = "lidar.pcap"
FORMATS: Final = {"velodyne": "velodyne_pcap", "ouster": "ouster_pcap", "hesai": "hesai_pcap"}
"""Format that reads the packets of a maker."""
_Writer: TypeAlias = PcapWriter | ouster.OusterCapture | hesai.HesaiCapture


def write_capture(scene: Scene, world: World, drive: Drive, folder: Path, hits_file: Path | None) -> Iterator[int]:
    """Write the capture of one pass, a block of packets a step; yields the returns of each."""
    maker = _maker(scene)
    if maker == "ouster":
        ouster.write_metadata(scene, folder / ouster.METADATA)
    if maker == "hesai":
        hesai.write_angles(scene, folder / hesai.ANGLES)
    with ExitStack() as stack:
        hits = None
        if hits_file is not None:
            hits = stack.enter_context(pq.ParquetWriter(hits_file, lidar.HITS_SCHEMA, use_dictionary=False))
        writer: _Writer
        if maker == "velodyne":
            writer = stack.enter_context(PcapWriter(folder / FILE, scene, drive))
        else:
            stream = stack.enter_context((folder / FILE).open("wb"))
            stream.write(FILE_HEADER)
            clock = _clock(scene)
            is_ouster = maker == "ouster"
            writer = ouster.OusterCapture(stream, clock) if is_ouster else hesai.HesaiCapture(stream, clock, scene)
        for block in lidar.measure(scene, world, drive):
            writer.write(block)
            if hits is not None:
                hits.write_batch(lidar.hits_of(block))
            yield int(np.count_nonzero(block.ranges))


def stated(scene: Scene, drive: Drive) -> tuple[str, str, str | None]:
    """Return format, clock and options of the survey file's entry."""
    maker, first = _maker(scene), lidar.starts_gps_ns(drive)
    if maker == "ouster":
        return FORMATS[maker], _clock(scene).toml("ns", first), f'{{ metadata = "{ouster.METADATA}" }}'
    if maker == "hesai":
        return FORMATS[maker], _clock(scene).toml(None, first), f'{{ angles = "{hesai.ANGLES}" }}'
    clock = SensorClock.of(scene, scene.lidar.clock, TimeSystem.UTC_HOUR)
    hour = None
    if drive.earth.is_local:  # no GNSS receiver is attached that would give the hour
        hour = f"{{ hour = {utc_from_gps_ns(int(clock.shown_gps_ns(np.array([first]))[0])).hour} }}"
    return FORMATS[maker], clock.toml(None, first), hour


def _maker(scene: Scene) -> str:
    return lidar_model(scene.lidar.model).figures.capture or ""


def _clock(scene: Scene) -> SensorClock:
    """Return the clock of a sensor that PTP or a GNSS receiver sets to UTC."""
    return SensorClock.of(scene, scene.lidar.clock.model_copy(update={"system": None}), TimeSystem.UNIX_UTC)

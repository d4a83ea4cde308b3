"""The logs of one pass: what the sensors write, in which format, and what the survey file has to state of it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from roadscan.core.errors import ConfigError
from roadscan.core.gpstime import TimeSystem
from roadscan.simulate import trajectory
from roadscan.simulate.caster import World
from roadscan.simulate.drive import Drive
from roadscan.simulate.scene import ClockError, Scene
from roadscan.simulate.sensors import bag, captures, gnss, sick
from roadscan.simulate.sensors import clock as encoder
from roadscan.simulate.sensors.camera import write_camera
from roadscan.simulate.sensors.clock import SensorClock
from roadscan.simulate.sensors.picture import Studio
from roadscan.simulate.sensors.profiler import Head, heads, write_profiles
from roadscan.simulate.surface import Surface
from roadscan.simulate.things import Object

Content = Literal["poses", "readings", "returns", "other"]


@dataclass(frozen=True)
class SimulatedLog:
    """One log of a pass."""

    name: str
    """File or folder, relative to the run's folder."""
    write: Callable[[], Iterator[int]]
    """Writes the log, one piece per step; yields the records of each."""
    content: Content = "other"
    """Kind of its records, for the summary."""
    format: str = ""
    """Format that the survey file states; empty: the log is not listed there."""
    sensor: str | None = None
    """Sensor of the rig."""
    clock: str | None = None
    """Its clock as TOML."""
    crs: str | None = None
    """CRS of its positions."""
    options: str | None = None
    """The format's settings as TOML."""


@dataclass(frozen=True)
class Pass:
    """One pass with the folders of its logs and hits."""

    scene: Scene
    surface: Surface
    world: World | None
    """World of the rays; None where nothing on the rig casts any."""
    things: Sequence[Object]
    """Objects on and beside the road."""
    drive: Drive
    raw: Path
    """Folder of the logs."""
    true_trajectory: Path
    """File of the true poses."""
    true_camera: Callable[[str], Path]
    """Returns the file of a camera's true poses."""
    hits: Callable[[str], Path | None]
    """Returns the file of a sensor's hits; None where they are not requested."""

    def clock(self, sensor: str, usual: TimeSystem) -> SensorClock:
        """Return the clock of a sensor (a table of the scene) whose log usually has stamps of `usual`."""
        return SensorClock.of(self.scene, getattr(self.scene, sensor).clock, usual)

    def logs(self) -> list[SimulatedLog]:
        """Return all logs of the pass, the longest work first.

        Raises
        ------
        ConfigError
            where a sensor needs the Earth, and the scene lies in a local frame.
        """
        in_bag = (self._bag,) if self.scene.bag.on else (self._lidar, self._imus, self._gnss)
        makers = (self._camera, self._profilers, *in_bag, self._sick, self._trajectory, self._encoder)
        return [log for make in makers for log in make()]

    def _trajectory(self) -> Iterator[SimulatedLog]:
        scene, drive = self.scene, self.drive
        name = trajectory.file_name(drive)

        def write() -> Iterator[int]:
            return trajectory.write_trajectory(scene, drive, self.raw / name, self.true_trajectory)

        if drive.earth.is_local:
            clock, options = '{ system = "gps", unit = "ns" }', '{ axes = "frd" }'
            yield SimulatedLog(name, write, "poses", "pose_quaternions", None, clock, "local", options)
            return
        right = SensorClock.of(scene, ClockError(), TimeSystem.GPS_WEEK)
        if scene.bag.on and not scene.bag.trajectory:  # this one is for the truth
            yield SimulatedLog(name, write, "poses")
            return
        clock = right.toml(None, trajectory.first_gps_ns(scene, drive))
        companion = "trajectory.smrmsg"
        accuracy = f'{{ accuracy = "{companion}" }}' if scene.trajectory.accuracy else None
        yield SimulatedLog(name, write, "poses", "sbet", None, clock, drive.earth.geographic_crs, accuracy)
        if scene.trajectory.accuracy:
            yield SimulatedLog(companion, lambda: trajectory.write_accuracy(scene, drive, self.raw / companion))

    def _profilers(self) -> Iterator[SimulatedLog]:
        clock = self.clock("profilers", TimeSystem.GPS)
        plain = clock.error.is_right and clock.system is TimeSystem.GPS
        for head in heads(self.scene.profilers):
            name = f"{head.name}.parquet"

            def write(head: Head = head, name: str = name) -> Iterator[int]:
                hits = self.hits(head.name)
                return write_profiles(
                    self.scene, self.surface, self.drive, head, clock, self.raw / name, hits, self.things
                )

            stated = None if plain else clock.toml("ns", self.drive.start_gps_ns)
            yield SimulatedLog(name, write, "readings", "scans", head.name, stated)

    def _lidar(self) -> Iterator[SimulatedLog]:
        world = self.world
        if world is None or not self.scene.lidar.on:
            return

        def write() -> Iterator[int]:
            return captures.write_capture(self.scene, world, self.drive, self.raw, self.hits("lidar"))

        form, clock, options = captures.stated(self.scene, self.drive)
        yield SimulatedLog(captures.FILE, write, "returns", form, "lidar", clock, options=options)

    def _bag(self) -> Iterator[SimulatedLog]:
        scene, world = self.scene, self.world
        self._need_earth("bag", "its positions are latitude and longitude")
        name = bag.file_name(scene)
        stated = {
            bag.points_format(scene): ("lidar", scene.lidar.on, scene.lidar.clock, None),
            "ros_imu": ("imu", scene.imu.on, scene.imu.clock, None),
            "ros_gnss": ("gnss", scene.gnss.on, ClockError(), self.drive.earth.geographic_crs),
        }
        listed = [(form, *one) for form, one in stated.items() if one[1]]
        for form, sensor, _, error, crs in listed:
            clock = bag.bag_clock(scene, error)

            def write(is_first: bool = form == listed[0][0]) -> Iterator[int]:
                yield from (
                    bag.write_bag(scene, world, self.drive, self.raw / name, self.hits("lidar")) if is_first else ()
                )

            content: Content = "returns" if form == listed[0][0] else "other"
            yield SimulatedLog(name, write, content, form, sensor, clock.toml(None, self.drive.start_gps_ns), crs)

    def _sick(self) -> Iterator[SimulatedLog]:
        world = self.world
        if world is None or not self.scene.sick.on:
            return
        clock = self.clock("sick", TimeSystem.UNIX_UTC)
        name = "sick.lms"

        def write() -> Iterator[int]:
            return sick.write_sick(self.scene, world, self.drive, clock, self.raw / name, self.hits("sick"))

        stated = clock.toml("ns", self.drive.start_gps_ns)
        options = sick.Scanner(self.scene.sick).options()
        yield SimulatedLog(name, write, "other", "sick_lms", "sick", stated, None, options)

    def _camera(self) -> Iterator[SimulatedLog]:
        world = self.world
        if world is None:
            return
        for name, camera in self.scene.cameras.items():
            clock = SensorClock.of(self.scene, camera.clock, TimeSystem.UNIX_UTC)

            def write(name: str = name, clock: SensorClock = clock) -> Iterator[int]:
                return write_camera(Studio.of(world, name), self.drive, clock, self.raw / name, self.true_camera(name))

            yield SimulatedLog(name, write, "other", "images", name, clock.toml("ns", self.drive.start_gps_ns))

    def _imus(self) -> Iterator[SimulatedLog]:
        scene = self.scene
        on_rig = [(gnss.imu_of(scene), self.clock("imu", TimeSystem.GPS))] if scene.imu.on else []
        on_rig += [(one, self.clock("profilers", TimeSystem.GPS)) for one in gnss.head_imus(scene)]
        for one, clock in on_rig:
            name = f"{one.name}.csv"

            def write(one: gnss.ImuOnRig = one, clock: SensorClock = clock, name: str = name) -> Iterator[int]:
                return gnss.write_imu(scene, self.drive, one, clock, self.raw / name)

            stated = clock.toml("ns", gnss.first_gps_ns(self.drive, one))
            yield SimulatedLog(name, write, "other", "imu_csv", one.name, stated)

    def _gnss(self) -> Iterator[SimulatedLog]:
        if not self.scene.gnss.on:
            return
        self._need_earth("gnss", "its solutions are latitude and longitude")
        crs = self.drive.earth.geographic_crs

        def pos() -> Iterator[int]:
            return gnss.write_pos(gnss.solve(self.scene, self.drive), self.raw / "gnss.pos")

        def nmea() -> Iterator[int]:
            return gnss.write_nmea(gnss.solve(self.scene, self.drive), self.raw / "gnss.nmea")

        yield SimulatedLog("gnss.pos", pos, "other", "rtklib_pos", "gnss", None, crs)
        yield SimulatedLog("gnss.nmea", nmea)  # the same solutions again: if listed, they would count twice

    def _encoder(self) -> Iterator[SimulatedLog]:
        if not self.scene.encoder.on:
            return
        clock = self.clock("encoder", TimeSystem.GPS)

        def write() -> Iterator[int]:
            return encoder.write_encoder(self.scene, self.drive, clock, self.raw / "encoder.csv")

        stated = clock.toml("ns", self.drive.recorded_span_gps_ns[0])
        yield SimulatedLog(
            "encoder.csv", write, "other", "encoder_csv", "encoder", stated, None, '{ record = "total" }'
        )

    def _need_earth(self, sensor: str, why: str) -> None:
        if self.drive.earth.is_local:
            raise ConfigError(
                f'map.crs is "local" and {sensor}.on is true, but {why}',
                expected="a projected CRS",
                change=f"name one, or switch the sensor off ({sensor}.on = false)",
            )

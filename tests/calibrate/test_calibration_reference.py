"""Boresight against a reference scan: simulated lidar, known mounting, a reference from elsewhere with 5 mm noise."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import small_gicp
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from roadscan.calibrate.estimator import Prior, calibrate
from roadscan.calibrate.evidence import Known, Seen, Traverse
from roadscan.calibrate.reference import ReferenceOptions, Registration, register
from roadscan.calibrate.surfels import Surfels
from roadscan.core.errors import ConfigError
from roadscan.core.rig import Mounting, Rig
from roadscan.core.survey import ClockConfig
from roadscan.ingest.reading.format import Rows, format_named
from roadscan.poses.trajectory import Trajectory
from roadscan.simulate import Scene, simulate, truth
from tests.formats.log_reading import source_of

NOISE_M = 0.005
BOXES = [
    {"station_m": 12.0, "offset_m": 7.5, "length_m": 3.0, "width_m": 2.2, "height_m": 3.0, "heading_deg": 25.0},
    {"station_m": 26.0, "offset_m": -7.0, "length_m": 2.5, "width_m": 2.5, "height_m": 2.5, "heading_deg": -35.0},
    {"station_m": 3.0, "offset_m": -8.0, "length_m": 4.0, "width_m": 2.0, "height_m": 2.6, "heading_deg": 10.0},
]
CARS = [  # each drives in one of the two scans only
    {"station_m": 14.0, "offset_m": -3.0, "speed_m_per_s": 2.0, "passes": [1]},
    {"station_m": -9.0, "offset_m": 2.0, "speed_m_per_s": 1.0, "passes": [2]},
]
SITE = Scene().changed(
    length_m=3.0,
    map={"crs": "local"},
    road={"lanes": 2, "lane_width_m": 8.0},
    roadside={
        "boxes": BOXES,
        "facades": [{"offset_m": -14.0, "start_m": -10.0, "end_m": 45.0, "height_m": 7.0}],
        "moving_cars": CARS,
    },
    passes=[{"lane": 2, "speed_m_per_s": 4.0}, {"lane": 1, "speed_m_per_s": 4.0, "direction": "backward"}],
    vehicle={"speed_m_per_s": 4.0},
    profilers={"on": False},
    lidar={
        "range_max_m": 40.0,
        "mount": {
            "lever_arm_body_m": [-1.72, 0.06, -1.36],
            "roll_deg": 1.2,
            "pitch_deg": 18.0,
            "heading_deg": -2.5,
            "error": {
                "lever_arm_body_m": [0.05, -0.06, 0.04],
                "roll_deg": -0.9,
                "pitch_deg": 0.8,
                "heading_deg": 1.0,
            },
        },
    },
    trajectory={"accuracy": False},
    noise={"lidar_range_m": NOISE_M},
)


@dataclass(frozen=True)
class Site:
    """The simulated site: what the mobile lidar saw on its drive, and clouds of the other drive."""

    folder: Path
    mobile: Seen
    """Through the raw capture and its reader: noise, rounding and all; poses are true."""
    epochs_s: np.ndarray
    hits_m: np.ndarray
    """(n, 3) where the beams of the second drive truly hit."""
    true: Mounting
    nominal: Mounting

    def reference(self, seed: int, keep: Callable[[np.ndarray], np.ndarray] | None = None) -> np.ndarray:
        """A terrestrial scan: places that the other drive's beams hit, with noise on each coordinate."""
        rng = np.random.default_rng(seed)
        cloud = self.hits_m[np.sort(rng.permutation(len(self.hits_m))[:250_000])]
        cloud = cloud if keep is None else cloud[keep(cloud)]
        return cloud + NOISE_M * rng.standard_normal(cloud.shape)

    def moving(self, every: int = 8) -> Seen:
        """1.5 s of driving."""
        return chosen(self.mobile, np.flatnonzero(self.epochs_s < self.epochs_s[0] + 1.5)[::every])

    def standing(self, seed: int) -> Seen:
        """One turn of the lidar as if the vehicle had stood: exact hits seen from one pose, with new noise."""
        rng = np.random.default_rng(seed)
        one = chosen(self.mobile, np.flatnonzero((self.epochs_s > 0.5) & (self.epochs_s < 0.6)))
        rotation, lever = self.true.arrays()
        hits, _ = placed(one, self.true)
        exact = ((hits - one.position_world_m[0]) @ one.world_from_body[0] - lever) @ rotation
        distance = np.linalg.norm(exact, axis=1, keepdims=True)
        noisy = exact * (1.0 + NOISE_M * rng.standard_normal(distance.shape) / distance)
        n = len(noisy)
        return replace(
            one,
            point_sensor_m=noisy,
            position_world_m=np.repeat(one.position_world_m[:1], n, axis=0),
            world_from_body=np.repeat(one.world_from_body[:1], n, axis=0),
        )


def chosen(scan: Seen, index: np.ndarray) -> Seen:
    return Seen(
        scan.sensor,
        scan.point_sensor_m[index],
        scan.position_world_m[index],
        scan.world_from_body[index],
        scan.traverse[index],
    )


def placed(scan: Seen, mounting: Mounting) -> tuple[np.ndarray, np.ndarray]:
    rotation, lever = mounting.arrays()
    body = scan.point_sensor_m @ rotation.T + lever
    return scan.position_world_m + np.einsum("nij,nj->ni", scan.world_from_body, body), body - lever


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    made = simulate(SITE, tmp_path_factory.mktemp("reference") / "site", write_hits=True)
    known = truth.load(made.folder)
    (stated,) = [
        log for log in tomllib.loads(made.survey_file.read_text())["runs"][0]["logs"] if "lidar" in log["path"]
    ]
    sensor = Rig.load(made.rig_file).sensors["lidar"]
    # Without the Earth there is no GNSS sentence in the capture that would say the hour.
    clock = ClockConfig.parse({"system": "utc_hour", "date": SITE.start.date()}).clock()
    options = {"hour": SITE.start.hour}
    source = source_of(stated["format"], made.folder / stated["path"], options, sensor=sensor, clock=clock)
    capture = format_named(stated["format"])
    items = list(capture.read(source, capture.header(source)))
    log = pa.Table.from_batches([item.batch for item in items if isinstance(item, Rows)])
    epochs = log["epoch_gps_ns"].to_numpy()
    poses = pq.read_table(known.trajectory_file("run-1"))
    trajectory = Trajectory.of(
        "local",
        poses["epoch_gps_ns"].to_numpy(),
        np.stack([poses[f"{a}_world_m"].to_numpy() for a in "xyz"], axis=-1),
        np.stack([poses[a].to_numpy() for a in ("qw", "qx", "qy", "qz")], axis=-1),
    ).poses(epochs, strict=True)
    points = np.stack([log[f"{a}_sensor_m"].to_numpy() for a in "xyz"], axis=-1).astype(np.float64)
    seen = Seen(
        "lidar", points, trajectory.position_world_m, trajectory.world_from_body, np.zeros(len(points), np.int64)
    )
    hits = pq.read_table(known.hits_file("run-2", "lidar"))
    places = np.stack([hits[c].to_numpy() for c in ("easting_m", "northing_m", "height_m")], axis=-1)
    return Site(
        made.folder,
        seen,
        (epochs - epochs[0]) / 1e9,
        places,
        Rig.load(known.rig_file).sensors["lidar"].mounting(),
        sensor.mounting(),
    )


def off(mounting: Mounting, true: Mounting) -> np.ndarray:
    """(6,) error of a mounting: lever arm (m), rotation about the body's axes (rad)."""
    (rotation, lever), (r, t) = mounting.arrays(), true.arrays()
    return np.concatenate([lever - t, Rotation.from_matrix(rotation @ r.T).as_rotvec()])


def within_bar(error: np.ndarray) -> bool:
    return bool(np.abs(error[:3]).max() < 0.005 and np.degrees(np.abs(error[3:])).max() < 0.01)


def away(true: Mounting, degrees: float, metres: float, seed: int) -> Mounting:
    """A mounting this far from the true one, in a random direction."""
    rng = np.random.default_rng(seed)
    turn, shift = rng.standard_normal((2, 3))
    rotation, lever = true.arrays()
    turned = Rotation.from_rotvec(np.radians(degrees) * turn / np.linalg.norm(turn)).as_matrix() @ rotation
    return Mounting(tuple(lever + metres * shift / np.linalg.norm(shift)), tuple(map(tuple, turned)))


def solved(found: Registration) -> tuple[np.ndarray, np.ndarray, float]:
    """Correction (6,) of the mounting by the ties alone, its covariance, and their mean squared residual.

    Derivatives by differences of the ties' own definition (evidence.py), none of the code tested.
    """
    ties = found.ties
    assert isinstance(ties.second, Known)

    def residual(step: np.ndarray) -> np.ndarray:
        rotation, lever = found.mounting.arrays()
        turned = Rotation.from_rotvec(step[3:]).as_matrix() @ rotation
        place, _ = placed(ties.first, Mounting(tuple(lever + step[:3]), tuple(map(tuple, turned))))
        return np.einsum("nkj,nj->nk", ties.weight, place - ties.second.point_m).ravel()

    at = residual(np.zeros(6))
    rows = np.stack([(residual(1e-5 * e) - residual(-1e-5 * e)) / 2e-5 for e in np.eye(6)], axis=-1)
    covariance = np.linalg.inv(rows.T @ rows)
    return -covariance @ (rows.T @ at), covariance, float(at @ at / at.size)


EXACT = Traverse("run-1", 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), np.eye(3))
"""Poses without error, as the simulator's true ones are."""


def prior_sigma(prior: Prior) -> np.ndarray:
    return np.array([*prior.lever_arm_sigma_m, *prior.boresight_sigma_rad])


def rank(found: Registration) -> int:
    """How many directions of the mounting the ties determine better than 20 mm and 0.3 degrees."""
    information = np.linalg.inv(solved(found)[1] + np.diag([1e-18] * 6))
    scaled = information * np.outer([0.02] * 3 + [0.005] * 3, [0.02] * 3 + [0.005] * 3)
    return int((np.linalg.eigvalsh(scaled) > 1.0).sum())


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_driving_scan_from_its_nominal_mounting(site: Site, seed: int):
    assert np.degrees(np.linalg.norm(off(site.nominal, site.true)[3:])) > 1.5
    found = register(site.moving(), site.reference(seed), site.nominal)
    assert within_bar(off(found.mounting, site.true)), off(found.mounting, site.true)
    # Far better than the bar, in fact; a wrong sign or frame somewhere would not be.
    assert np.abs(off(found.mounting, site.true)[:3]).max() < 0.002
    assert found.range_sigma_m == pytest.approx(NOISE_M, rel=0.15)
    assert found.fates["tied"] == len(found.ties.weight) > 5_000


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 5, 6])
def test_a_standing_scan(site: Site, seed: int):
    found = register(site.standing(seed), site.reference(seed), away(site.true, 1.5, 0.08, seed))
    assert within_bar(off(found.mounting, site.true)), off(found.mounting, site.true)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["standing", "moving"])
@pytest.mark.parametrize("seed", [7])
def test_a_start_without_a_nominal_mounting(site: Site, seed: int, kind: str):
    scan = site.standing(seed) if kind == "standing" else site.moving()
    rough = ReferenceOptions(start_lever_sigma_m=0.3, start_boresight_sigma_deg=6.0)
    found = register(scan, site.reference(seed), away(site.true, 10.0, 0.5, seed), rough)
    assert within_bar(off(found.mounting, site.true)), off(found.mounting, site.true)


@pytest.mark.slow
def test_sigma_is_honest(site: Site):
    """Errors over their covariance: six degrees of freedom, mean of 5 seeds within its 99.9 % limits."""
    normalised = []
    for seed in range(5):
        found = register(site.standing(seed), site.reference(100 + seed), away(site.true, 1.0, 0.05, seed))
        step, covariance, _ = solved(found)
        error = off(found.mounting, site.true) + step
        normalised.append(error @ np.linalg.solve(covariance, error))
    assert chi2.ppf(0.0005, 30) / 5 < np.mean(normalised) < chi2.ppf(0.9995, 30) / 5


@pytest.mark.slow
def test_against_plain_small_gicp(site: Site):
    """Of a standing scan plain ICP finds the mounting too; of a driving one only the exact poses do."""
    reference = site.reference(9)
    origin = reference.mean(axis=0)

    def plain(scan: Seen) -> Mounting:
        middle = len(scan.point_sensor_m) // 2
        attitude, position = scan.world_from_body[middle], scan.position_world_m[middle] - origin
        rotation, lever = site.nominal.arrays()
        start = np.eye(4)
        start[:3, :3], start[:3, 3] = attitude @ rotation, position + attitude @ lever
        found = small_gicp.align(
            reference - origin, scan.point_sensor_m, start, "PLANE_ICP",
            downsampling_resolution=0.1, max_correspondence_distance=0.5, max_iterations=100,
        ).T_target_source  # fmt: skip
        turned = attitude.T @ found[:3, :3]
        return Mounting(tuple(attitude.T @ (found[:3, 3] - position)), tuple(map(tuple, turned)))

    def size(mounting: Mounting) -> float:
        error = off(mounting, site.true)
        return float(np.hypot(np.linalg.norm(error[:3]), 10.0 * np.linalg.norm(error[3:])))

    standing = site.standing(9)
    theirs, ours = size(plain(standing)), size(register(standing, reference, site.nominal).mounting)
    assert ours < 0.003 < theirs < 0.1
    assert size(plain(site.moving())) > 0.1 > 0.003 > size(register(site.moving(), reference, site.nominal).mounting)


@pytest.mark.slow
def test_half_the_reference_and_things_that_moved(site: Site):
    """The reference lacks half the site, and a wall and a car stand in it that the mobile scan never saw."""
    rng = np.random.default_rng(10)
    middle = np.median(site.hits_m[:, 0])
    cloud = site.reference(10, lambda p: p[:, 0] > middle)
    centre = site.mobile.position_world_m[len(site.mobile.position_world_m) // 2]
    board = np.stack([np.full(20_000, 3.0), rng.uniform(-2, 2, 20_000), rng.uniform(-1.5, 1.0, 20_000)], axis=-1)
    clean = register(site.moving(), cloud, site.nominal)
    # A board some centimetres before each of two boxes' sides would be met by wrong readings.
    shifted = cloud[(np.abs(cloud[:, 2] - centre[2]) < 2.0)][::4] + np.array([0.04, 0.03, 0.0])
    found = register(site.moving(), np.concatenate([cloud, centre + board, shifted]), site.nominal)
    assert clean.fates["no_plane"] > found.ties.weight.shape[0] * 0.5
    for one in (clean, found):
        assert within_bar(off(one.mounting, site.true)), off(one.mounting, site.true)


@pytest.mark.slow
def test_a_plane_alone_determines_three_directions(site: Site):
    """Flat ground: height, roll and pitch. Of the rest the ties hold nothing, and the mounting keeps what it was."""
    rng = np.random.default_rng(11)
    centre = site.mobile.position_world_m[0]
    flat = np.column_stack([rng.uniform(-20, 20, (180_000, 2)), np.full(180_000, -1.0)])
    ground = centre + flat + NOISE_M * rng.standard_normal(flat.shape)
    # Readings of that same plane from one pose.
    body = flat[rng.permutation(len(flat))[:20_000]] @ site.mobile.world_from_body[0]
    rotation, lever = site.true.arrays()
    n = len(body)
    exact = (body - lever) @ rotation
    distance = np.linalg.norm(exact, axis=1, keepdims=True)
    scan = Seen(
        "lidar",
        exact * (1.0 + NOISE_M * rng.standard_normal((n, 1)) / distance),
        np.repeat(centre[None], n, axis=0),
        np.repeat(site.mobile.world_from_body[:1], n, axis=0),
        np.zeros(n, np.int64),
    )
    found = register(scan, ground, site.nominal, ReferenceOptions(incidence_max_deg=85.0, cell_m=0.5))
    assert rank(found) == 3
    assert np.abs(off(found.mounting, site.nominal)[:2]).max() < 0.1
    # The estimator says so, and keeps what it was given; the vertical lever arm and roll and pitch it finds.
    prior = Prior(site.nominal, (0.05, 0.05, 0.05), (0.025, 0.025, 0.025))
    result = calibrate({"lidar": prior}, [found.ties], {0: EXACT}).sensors["lidar"]
    assert len(result.not_determined) == 3
    assert sorted({w.split(" of ")[0] for w in result.not_determined}) == [
        "forward lever arm", "heading", "right lever arm",
    ]  # fmt: skip
    assert np.abs(result.sigma[[0, 1, 5]] / prior_sigma(prior)[[0, 1, 5]]).min() > 0.9
    error = off(result.mounting, site.true)
    assert abs(error[2]) < 0.01
    full = register(site.moving(), site.reference(11), site.nominal)
    assert rank(full) == 6


@pytest.mark.slow
def test_the_estimator_takes_the_ties(site: Site):
    """What the estimator makes of them: the bar again, with its own covariance, nothing left open."""
    found = register(site.moving(), site.reference(16), site.nominal)
    prior = Prior(site.nominal, (0.05, 0.05, 0.05), (0.025, 0.025, 0.025))
    result = calibrate({"lidar": prior}, [found.ties], {0: EXACT}).sensors["lidar"]
    error = off(result.mounting, site.true)
    assert within_bar(error)
    assert result.not_determined == ()
    assert error @ np.linalg.solve(result.covariance, error) < 22.5  # 99.9 % of chi-squared with 6


@pytest.mark.slow
def test_scans_that_do_not_meet_are_refused(site: Site):
    with pytest.raises(ConfigError, match="one frame"):
        register(site.moving(), site.reference(12) + np.array([500.0, 0.0, 0.0]), site.nominal)
    with pytest.raises(ConfigError, match="no plane"):
        register(site.moving(), np.random.default_rng(0).uniform(-50, 50, (5_000, 3)), site.nominal)
    with pytest.raises(ConfigError, match="readings of 'lidar' lie beyond"):
        register(site.moving(), site.reference(12), site.nominal, ReferenceOptions(range_min_m=500.0))
    with pytest.raises(ConfigError, match="finite"):
        register(site.moving(), np.full((100, 3), np.nan), site.nominal)


def test_planes_and_their_own_uncertainty():
    """Many clouds of one tilted plane: the fitted planes scatter as they say."""
    rng = np.random.default_rng(13)
    normal = np.array([0.2, -0.3, 0.9]) / np.linalg.norm([0.2, -0.3, 0.9])
    place, errors, variances = np.array([[0.15, 0.1, 0.0]]), [], []
    for _ in range(200):
        flat = rng.uniform(0.0, 0.7, (60, 2))
        height = -(flat @ normal[:2]) / normal[2] + 0.2
        cloud = np.column_stack([flat, height]) + 0.004 * rng.standard_normal((60, 1)) * normal
        surfels = Surfels.of(cloud, 1.0)
        on_plane = place + np.array([0.0, 0.0, 1.0]) * (-(place[:, :2] @ normal[:2]) / normal[2] + 0.2)[:, None]
        patch, distance = surfels.nearest(on_plane, np.array([0.1]))
        errors.append(distance[0])
        variances.append(surfels.variance_m2(patch, on_plane)[0])
        assert abs(surfels.normal[patch[0]] @ normal) > np.cos(np.radians(2.0))
    assert np.std(errors) == pytest.approx(np.sqrt(np.mean(variances)), rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [20, 21])
def test_a_start_far_beyond_what_was_stated_is_not_silently_wrong(site: Site, seed: int):
    """Either the search gets there all the same, or it says that it did not."""
    try:
        found = register(site.moving(), site.reference(seed), away(site.true, 40.0, 3.0, seed))
    except ConfigError as error:
        assert "better mounting" in str(error) or "one frame" in str(error)
    else:
        assert within_bar(off(found.mounting, site.true)), found.fates

"""PostGIS: many people at once, roles, history, and a connection that is lost in the middle."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import shapely

from roadscan.core.errors import ConfigError, RoadscanError
from roadscan.inventory.home import FaultyEditsError, HomeError
from roadscan.inventory.homes.postgis import PostGis
from roadscan.inventory.inventory import Inventory
from tests.inventory import qgis_edits as person
from tests.inventory.postgres import server
from tests.inventory.streets import AUTUMN, EAST, NORTH, Everywhere, asset, found, inventory, poles

psycopg = pytest.importorskip("psycopg", reason="psycopg is not installed: `pip install 'roadscan[postgis]'`")


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with server() as running:
        yield running


@pytest.fixture
def street(tmp_path: Path, address: str) -> Iterator[Inventory]:
    """Six poles and a sign, published into a schema of its own."""
    made = inventory(tmp_path, Everywhere())
    made.home = PostGis(address, "street", 32632, project=tmp_path / "inventory-postgis.qgs")
    made.record(found([*poles(), asset("sign", (20.1, 4.0, 103.0), message='STOP, "all"\nway', width_m=0.6)]))
    made.publish()
    yield made
    execute(address, "DROP SCHEMA street CASCADE")


def execute(address: str, statement: str, role: str | None = None) -> list[Any]:
    with psycopg.connect(address) as connection:
        if role is not None:
            connection.execute(f"SET ROLE {role}")
        done = connection.execute(statement)
        return done.fetchall() if done.description else []


@pytest.mark.slow
def test_it_shows_what_was_found_and_takes_back_nothing(street: Inventory, address: str) -> None:
    rows = execute(address, "SELECT asset_id, asset_height_m, ST_Z(geom), ST_SRID(geom) FROM street.poles ORDER BY 2")
    assert [r[1:] for r in rows] == [(5.0 + 0.1 * n, 100.0 + n, 32632) for n in range(6)]
    assert execute(address, "SELECT message, parent FROM street.road_signs") == [('STOP, "all"\nway', rows[1][0])]
    assert street.pull().commit is None
    assert street.status().to_pull == 0


@pytest.mark.slow
def test_its_project_names_the_tables_and_no_password(street: Inventory, tmp_path: Path, address: str) -> None:
    text = (tmp_path / "inventory-postgis.qgs").read_text()
    layers = {
        layer.findtext("layername"): layer for layer in ElementTree.fromstring(text.split("\n", 1)[1]).iter("maplayer")
    }
    assert layers["Pole"].findtext("provider") == "postgres" and "Conflicts" in layers
    port = psycopg.conninfo.conninfo_to_dict(address)["port"]
    assert layers["Pole"].findtext("datasource") == (
        f"dbname='postgres' host='127.0.0.1' port='{port}' key='fid' srid=32632 table=\"street\".\"poles\" (geom)"
    )
    assert "secret" not in text and "admin" not in text


@pytest.mark.slow
def test_edits_of_several_people_are_taken_in_with_their_names(street: Inventory, address: str) -> None:
    execute(address, "CREATE ROLE eva LOGIN IN ROLE street_editor; CREATE ROLE max LOGIN IN ROLE street_editor")
    try:
        ids = [r[0] for r in execute(address, "SELECT asset_id FROM street.poles ORDER BY station_m")]
        eva, max_ = address.replace("admin:secret", "eva"), address.replace("admin:secret", "max")
        execute(eva, f"UPDATE street.poles SET condition = 3, comments = 'é, \"bent\"' WHERE asset_id = '{ids[0]}'")
        execute(eva, f"DELETE FROM street.poles WHERE asset_id = '{ids[1]}'")
        execute(max_, f"UPDATE street.poles_current SET condition = 8 WHERE asset_id = '{ids[2]}'")
        execute(max_, f"UPDATE street.poles SET diameter_m = 0.2 WHERE asset_id = '{ids[0]}'")
        point = f"ST_SetSRID(ST_MakePoint({EAST + 3}, {NORTH - 6}, 100), 32632)"
        execute(max_, f"INSERT INTO street.poles (comments, geom) VALUES ('new', {point})")
        done = street.pull(who="office")
        told = {(e.asset_id if e.action != "create" else "new", e.attribute, e.new, e.who) for e in done.edits}
        drawn = next(e.asset_id for e in done.edits if e.action == "create")
        wkb = shapely.to_wkb(shapely.Point(EAST + 3, NORTH - 6, 100.0), flavor="iso").hex()
        assert told == {
            (ids[0], "condition", "3", "eva"), (ids[0], "comments", '"é, \\"bent\\""', "eva"),
            (ids[0], "diameter_m", "0.2", "max"), (ids[1], "status", '"rejected"', "eva"),
            (ids[2], "condition", "8", "max"),
            ("new", "geometry", f'"{wkb}"', "max"), (drawn, "comments", '"new"', "max"),
        }  # fmt: skip
        assert street.pull().commit is None
        street.publish()
        assert execute(address, "SELECT count(*) FROM street.poles") == [(6,)]
        assert execute(address, "SELECT count(*) FROM street.history") == [(5,)]  # a publication is none
    finally:
        execute(address, "DROP OWNED BY eva, max; DROP ROLE eva, max")


@pytest.mark.slow
def test_an_edit_survives_a_new_epoch_and_conflicts_are_shown(street: Inventory, address: str) -> None:
    one = execute(address, "SELECT asset_id FROM street.poles ORDER BY station_m LIMIT 1")[0][0]
    execute(address, f"UPDATE street.poles SET asset_height_m = 7.5 WHERE asset_id = '{one}'")
    street.pull()
    street.record(found(poles(when=AUTUMN, asset_height_m=6.0), "autumn"))
    street.publish()
    assert execute(address, f"SELECT asset_height_m FROM street.poles WHERE asset_id = '{one}'") == [(7.5,)]
    assert execute(address, "SELECT asset_id, attribute, other FROM street.conflicts") == [
        (one, "asset_height_m", "6.0")
    ]
    execute(address, "UPDATE street.conflicts SET decision = 'evidence'", role="street_editor")
    street.pull()
    assert street.state().row(one)["asset_height_m"] == 6.0
    assert street.conflicts() == []


@pytest.mark.slow
def test_an_editor_of_a_copy_and_one_of_the_database(street: Inventory, tmp_path: Path, address: str) -> None:
    copy = inventory(tmp_path, Everywhere())
    copy.publish()
    first, second, third, *_ = list(street.assets("pole").sort_values("station_m")["asset_id"])
    for one, column, value in ((first, "condition", 3), (second, "condition", 4), (third, "comments", "copy")):
        person.edit(tmp_path / "inventory.gpkg", "poles", one, **{column: value})
    execute(address, f"UPDATE street.poles SET condition = 8 WHERE asset_id = '{first}'")
    execute(address, f"UPDATE street.poles SET comments = 'database' WHERE asset_id = '{second}'")
    street.pull(who="eva")
    street.pull(home=copy.home, who="max")
    rows = {one: street.state().row(one) for one in (first, second, third)}
    assert (rows[second]["condition"], rows[second]["comments"], rows[third]["comments"]) == (4, "database", "copy")
    (conflict,) = street.conflicts()
    assert (conflict.asset_id, conflict.reason, conflict.in_force, conflict.other) == (first, "edit", "8", "3")


@pytest.mark.slow
def test_readers_may_look_and_editors_may_not_change_the_history(street: Inventory, address: str) -> None:
    assert execute(address, "SELECT count(*) FROM street.poles", role="street_reader") == [(6,)]
    for role, statement in (
        ("street_reader", "UPDATE street.poles SET condition = 1"),
        ("street_editor", "DELETE FROM street.history"),
        ("street_editor", "INSERT INTO street.roadscan_inventory (token) VALUES ('x')"),
        ("street_editor", "TRUNCATE street.poles"),
    ):
        with pytest.raises(psycopg.errors.InsufficientPrivilege):
            execute(address, statement, role=role)
    with pytest.raises(psycopg.errors.CheckViolation):
        execute(address, "UPDATE street.poles SET condition = 11", role="street_editor")


@pytest.mark.slow
def test_every_administrator_publishes_and_no_editor_hides_a_change(street: Inventory, address: str) -> None:
    execute(address, "CREATE ROLE ada LOGIN IN ROLE street_admin; CREATE ROLE eva LOGIN IN ROLE street_editor")
    try:
        hidden = "SET roadscan.publishing = 'yes'; UPDATE street.poles SET condition = 3 WHERE fid = 1"
        execute(address.replace("admin:secret", "eva"), hidden)
        assert [e.who for e in street.pull().edits] == ["eva"]
        for user in ("ada", "admin:secret"):
            street.home = PostGis(address.replace("admin:secret", user), "street", 32632)
            assert street.publish().assets == 7
        street.home = PostGis(address.replace("admin:secret", "eva"), "street", 32632)
        with pytest.raises(HomeError, match="permission denied"):
            street.publish()
    finally:
        execute(address, "DROP ROLE ada; DROP ROLE eva")


@pytest.mark.slow
def test_a_faulty_row_is_named(street: Inventory, address: str) -> None:
    one = execute(address, "SELECT asset_id FROM street.poles LIMIT 1")[0][0]
    execute(address, f"UPDATE street.poles SET parent = 'pole-x' WHERE asset_id = '{one}'")
    with pytest.raises(FaultyEditsError, match=f"poles, {one}: its parent 'pole-x' is not known"):
        street.pull()


@pytest.mark.slow
def test_a_lost_connection_leaves_the_old_state_whole(
    street: Inventory, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = execute(address, "SELECT * FROM street.poles ORDER BY fid")
    street.record(found(poles(3, when=AUTUMN), "autumn"))
    fill = PostGis._fill

    def cut(self: PostGis, cursor: Any, kind: str, rows: Any) -> None:
        if kind == "sign":
            execute(address, f"SELECT pg_terminate_backend({cursor.connection.info.backend_pid})")
        fill(self, cursor, kind, rows)

    monkeypatch.setattr(PostGis, "_fill", cut)
    with pytest.raises(HomeError, match=r"the connection was lost.*it is as it was") as error:
        street.publish()
    assert "secret" not in str(error.value)
    assert execute(address, "SELECT * FROM street.poles ORDER BY fid") == before
    monkeypatch.undo()
    street.publish()
    assert execute(address, "SELECT count(*) FROM street.poles WHERE source = 'autumn'") == [(3,)]


@pytest.mark.slow
def test_an_edit_between_reading_and_publishing_is_not_overwritten(street: Inventory, address: str) -> None:
    read = street.home.read

    def edited_then() -> Any:
        content = read()
        execute(address, "UPDATE street.poles SET condition = 4")
        return content

    street.home.read = edited_then  # type: ignore[method-assign]
    with pytest.raises(HomeError, match="it was edited in this moment"):
        street.publish()
    assert execute(address, "SELECT DISTINCT condition FROM street.poles") == [(4,)]


@pytest.mark.slow
def test_two_programs_at_once_wait_for_one_another(street: Inventory, tmp_path: Path, address: str) -> None:
    street.record(found(poles(4, when=AUTUMN), "autumn"))
    others = [inventory(tmp_path, Everywhere()) for _ in range(3)]
    failures: list[Exception] = []

    def publish(one: Inventory) -> None:
        one.home = PostGis(address, "street", 32632)
        try:
            one.publish()
        except RoadscanError as error:
            failures.append(error)

    threads = [threading.Thread(target=publish, args=[one]) for one in others]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    assert execute(address, "SELECT count(*), count(DISTINCT asset_id) FROM street.poles") == [(6, 6)]


@pytest.mark.slow
def test_a_foreign_schema_and_a_server_that_is_not_there_are_named(tmp_path: Path, address: str) -> None:
    execute(address, "CREATE SCHEMA foreign_one")
    made = inventory(tmp_path)
    made.home = PostGis(address, "foreign_one", 32632)
    with pytest.raises(HomeError, match="the schema 'foreign_one' is that of another program"):
        made.publish()
    made.home = PostGis("postgresql://admin:secret@127.0.0.1:1/postgres", "street", 32632)
    with pytest.raises(HomeError, match="the database does not answer") as error:
        made.publish()
    assert "secret" not in str(error.value)
    with pytest.raises(ConfigError, match="the address of the PostGIS database is none") as wrong:
        PostGis("postgresql://admin:secret@[", "street")
    assert "secret" not in str(wrong.value)


@pytest.mark.slow
def test_a_table_that_was_altered_to_another_srid_is_brought_into_the_map(street: Inventory, address: str) -> None:
    execute(address, "DROP VIEW street.poles_current")
    execute(
        address,
        "ALTER TABLE street.poles ALTER COLUMN geom TYPE geometry(PointZ, 4326) USING ST_Transform(geom, 4326)",
    )
    assert street.pull().commit is None  # they are where they were
    statement = (
        "ALTER TABLE street.poles ALTER COLUMN geom TYPE geometry(PointZ, 31468) USING ST_Transform(geom, 31468)"
    )
    execute(address, statement)
    with pytest.raises(HomeError, match="the layer 'poles' is in EPSG:31468"):
        street.pull()

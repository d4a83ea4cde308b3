"""Objects as rows: their reference points against sums by hand, their names, and back again."""

from __future__ import annotations

import numpy as np
import pytest
import shapely

from roadscan.assets.kind import AssetObject, object_names, objects_of_table, reference_point, table_of_objects
from roadscan.store.asset_schema import asset_kind_names, asset_schema, asset_tables
from roadscan.store.schema import schema_names


def found(shape: shapely.Geometry, **attributes: object) -> AssetObject:
    return AssetObject(shape, 0.02, 0.01, 0.75, 12, 2, 10**18, 10**18 + 5, attributes)


@pytest.mark.parametrize(
    ("shape", "place"),
    [
        (shapely.Point(3.0, 4.0, 5.0), (3.0, 4.0, 5.0)),
        (shapely.LineString([(0, 0, 1), (6, 0, 1), (6, 2, 3)]), (4.0, 0.0, 1.0)),
        (shapely.Polygon([(0, 0, 2), (4, 0, 2), (4, 4, 4), (0, 4, 4)]), (2.0, 2.0, 3.0)),
        (shapely.Polygon([(0, 0, 0), (6, 0, 0), (6, 0, 9), (0, 0, 9)]), (3.0, 0.0, 4.5)),
        # a cut of the map left corners within straight sides
        (shapely.Polygon([(0, 0, 0), (1, 0, 0), (6, 0, 0), (6, 0, 9), (1, 0, 9), (0, 0, 9)]), (3.0, 0.0, 4.5)),
        (shapely.Polygon([(0, 0, 2), (1, 0, 2), (4, 0, 2), (4, 4, 4), (0, 4, 4)]), (2.0, 2.0, 3.0)),
    ],
)
def test_the_reference_point_is_on_the_shape(shape: shapely.Geometry, place: tuple[float, float, float]) -> None:
    assert reference_point(shape) == pytest.approx(place)


def test_names_follow_from_kind_and_place() -> None:
    places = np.array([[100.0, 200.0], [100.04, 200.04], [100.2, 200.0]])
    names = object_names("pole", places)
    assert len(set(names)) == 3
    assert object_names("pole", places[[0, 2]]) == [names[0], names[2]]
    assert object_names("pole", places[:1] + 0.01) == names[:1]
    assert set(names).isdisjoint(object_names("tree", places))


def test_objects_come_back_from_their_rows_in_the_order_of_their_places() -> None:
    schema = asset_schema("pole").arrow()
    objects = [
        found(shapely.Point(9, 1, 2), asset_height_m=4.0),
        found(shapely.Point(3, 1, 2), lean_deg=np.float32(1.5)),
    ]
    rows = table_of_objects("pole", objects, schema)
    assert rows.schema.equals(schema)
    assert rows["easting_m"].to_pylist() == [3.0, 9.0]
    assert rows["asset_height_m"].to_pylist() == [None, 4.0]
    assert rows["road"].to_pylist() == [None, None]
    assert table_of_objects("pole", objects[::-1], schema).equals(rows)
    back = objects_of_table(rows)
    assert [o.geometry for o in back] == [objects[1].geometry, objects[0].geometry]
    assert table_of_objects("pole", back, schema).equals(rows)


def test_an_attribute_that_the_schema_does_not_know_is_refused() -> None:
    with pytest.raises(KeyError, match="'weight_kg'"):
        table_of_objects("pole", [found(shapely.Point(0, 0, 0), weight_kg=3.0)], asset_schema("pole").arrow())


def test_tables_of_assets_have_names_of_their_own() -> None:
    assert len(asset_tables()) == len([kind for kind in asset_kind_names() if not asset_schema(kind).found_in])
    assert not set(asset_tables()) & set(schema_names())

"""What a person does to a GeoPackage, through OGR as QGIS does it: the layer is read, changed and written in place."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import geopandas
import pandas as pd
import pyogrio


def layer(file: Path, name: str) -> geopandas.GeoDataFrame:
    """Rows of a layer by the numbers of their features."""
    return pyogrio.read_dataframe(file, layer=name, fid_as_index=True)


def replace(file: Path, name: str, frame: geopandas.GeoDataFrame, geometry_type: str = "Point Z") -> None:
    """Write a layer anew; numbers of features are given again, from 1."""
    pyogrio.write_dataframe(
        frame, file, layer=name, driver="GPKG", append=False, geometry_type=geometry_type,
        layer_options={"GEOMETRY_NAME": "geom"},
    )  # fmt: skip


def edit(file: Path, name: str, asset_id: str, **values: Any) -> None:
    """Give an asset other values."""
    frame = layer(file, name)
    for column, value in values.items():
        if column == "geometry":
            frame.loc[frame["asset_id"] == asset_id, "geometry"] = geopandas.GeoSeries([value], crs=frame.crs).array
        else:
            if value is None or isinstance(value, str):
                frame[column] = frame[column].astype(object)
            frame.loc[frame["asset_id"] == asset_id, column] = value
    replace(file, name, frame)


def delete(file: Path, name: str, asset_id: str) -> None:
    """Delete an asset's row."""
    frame = layer(file, name)
    replace(file, name, frame[frame["asset_id"] != asset_id])


def draw(file: Path, name: str, geometry: Any, **values: Any) -> None:
    """Add a row without an id."""
    frame = layer(file, name)
    row = geopandas.GeoDataFrame([{**values}], geometry=[geometry], crs=frame.crs)
    pyogrio.write_dataframe(row, file, layer=name, driver="GPKG", append=True)


def ids(file: Path, name: str) -> list[str]:
    """Ids of a layer's rows."""
    return sorted(i for i in layer(file, name)["asset_id"] if pd.notna(i))

"""Packages that only some surveys need: they come with an extra, and what is missing is one sentence.

A module that needs one writes ``from roadscan.core.extras import cv2`` in place of ``import cv2``: the package is
imported when its first function is called, so that the module can be imported without it. What a survey file asks for
is checked with :func:`need` before a run.
"""

from __future__ import annotations

import importlib
import importlib.util
from types import ModuleType
from typing import TYPE_CHECKING, Any, Final

from roadscan.core.errors import ConfigError

__all__ = ["EXTRAS", "can_draw", "cv2", "is_installed", "missing", "need", "needed", "small_gicp"]

EXTRAS: Final = {
    "bokeh": ("bokeh", "dashboard"),
    "cv2": ("opencv-python-headless", "opencv"),
    "dask_gateway": ("dask-gateway", "gateway"),
    "geopandas": ("geopandas", "frames"),
    "kiss_icp.kiss_icp": ("kiss-icp", "odometry"),
    "matplotlib": ("matplotlib", "pictures"),
    "onnxruntime": ("onnxruntime", "onnx"),
    "opentelemetry.sdk.trace": ("opentelemetry-sdk", "otel"),
    "psycopg": ("psycopg", "postgis"),
    "rapidocr": ("rapidocr", "ocr"),
    "lz4.frame": ("lz4", "ros"),
    "rosbags.typesys": ("rosbags", "ros"),
    "s3fs": ("s3fs", "s3"),
    "small_gicp": ("small_gicp", "icp"),
    "xarray": ("xarray", "frames"),
    "zstandard": ("zstandard", "ros"),
}
"""Distribution and extra of each package that roadscan can do without, by the name that is imported."""


def is_installed(module: str) -> bool:
    """Whether a package can be imported; it is not."""
    try:
        return importlib.util.find_spec(module) is not None
    except (ImportError, ValueError):
        return False


def need(module: str, what: str) -> None:
    """Check that a package is installed; it is not imported.

    Parameters
    ----------
    module : one of `EXTRAS`.
    what : what needs it, as the error names it.

    Raises
    ------
    ConfigError
        where it is not: which package, and the extra that brings it.
    """
    if not is_installed(module):
        raise missing(module, what)


def needed(module: str, what: str) -> ModuleType:
    """A package of an extra, imported; raises as :func:`need`, also where it cannot be imported."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise missing(module, what) from error


def missing(module: str, what: str) -> ConfigError:
    """The error of a package that is not installed."""
    distribution, extra = EXTRAS[module]
    return ConfigError(f"{what} needs the package {distribution}", change=f'pip install "roadscan[{extra}]"')


def can_draw() -> bool:
    """Whether Matplotlib is installed; without it a run makes all but the pictures of figures."""
    return is_installed("matplotlib")


class _Late:
    """Stands for a package of an extra, which is imported when the first of its names is asked for."""

    def __init__(self, module: str, what: str) -> None:
        self._late = module, what

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        value = getattr(needed(*self._late), name)
        setattr(self, name, value)
        return value


if TYPE_CHECKING:
    import cv2
    import small_gicp
else:
    cv2 = _Late("cv2", "the work on images")
    small_gicp = _Late("small_gicp", "a calibration against a reference scan")

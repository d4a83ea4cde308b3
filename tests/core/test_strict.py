"""Configuration models: every fault is named where it stands in the file."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import pytest
from pydantic import Field, ValidationError, model_validator

from roadscan.core.errors import ConfigError
from roadscan.core.strict import Strict, load_toml, meanings


class Wheel(Strict):
    """A wheel."""

    radius_m: float = Field(gt=0)
    """Radius (m)."""
    side: Literal["left", "right"] = "left"
    """Side."""


class Steel(Wheel):
    """A wheel of its own."""

    alloy: str = ""


class Car(Strict):
    """A car."""

    wheels: list[Wheel] = []
    """Wheels in a row."""
    spare: Wheel | None = None
    """Spare wheel."""
    named: dict[str, Wheel] = {}
    """Wheels by name."""
    stock: Path | Wheel = Path("stock.toml")
    """A file, or the wheel itself."""

    @model_validator(mode="after")
    def _check(self) -> Car:
        if len(self.wheels) > 4:
            raise ValueError("more than four wheels")
        return self


GOOD = {"radius_m": 0.3}
BAD = {"radius_m": 0.3, "sid": "left"}


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"weels": []}, "unknown key 'weels' (did you mean 'wheels'?), expected one of: named, spare, stock, wheels"),
        ({"wheels": [GOOD, BAD]}, "unknown key 'wheels.1.sid' (did you mean 'side'?), expected one of: radius_m, side"),
        ({"spare": BAD}, "unknown key 'spare.sid' (did you mean 'side'?), expected one of: radius_m, side"),
        ({"named": {"x": BAD}}, "unknown key 'named.x.sid' (did you mean 'side'?), expected one of: radius_m, side"),
        # A name that happens to be a field's name.
        (
            {"named": {"side": BAD}},
            "unknown key 'named.side.sid' (did you mean 'side'?), expected one of: radius_m, side",
        ),
        ({"stock": BAD}, "unknown key 'stock.sid' (did you mean 'side'?), expected one of: radius_m, side"),
        ({"xyzzy": 1}, "unknown key 'xyzzy', expected one of: named, spare, stock, wheels"),
        ({"wheels": [{}]}, "key 'wheels.0.radius_m' is missing"),
        ({"spare": {"radius_m": -1}}, "'spare.radius_m' (got -1): expected a number above 0"),
        ({"spare": {"radius_m": "big"}}, "'spare.radius_m' (got 'big'): expected a number"),
        ({"wheels": [GOOD] * 5}, "more than four wheels"),
    ],
)
def test_faults(values: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Car.parse(values, file="car.toml")
    assert str(caught.value) == f"car.toml: {message}"


def test_all_faults_at_once() -> None:
    with pytest.raises(ConfigError) as caught:
        Car.parse({"weels": [], "spare": {"side": "top"}})
    for part in ("'weels'", "key 'spare.radius_m' is missing", "'spare.side' (got 'top')"):
        assert part in str(caught.value)


def test_values_cannot_be_changed_afterwards() -> None:
    wheel = Wheel.parse(GOOD)
    with pytest.raises(ValidationError, match="frozen"):
        wheel.radius_m = 2.0  # type: ignore[misc]


def test_docstrings_of_fields_are_found() -> None:
    assert list(meanings(Wheel)) == list(Wheel.model_fields)
    assert meanings(Wheel)["radius_m"] == "Radius (m)."
    assert meanings(Steel) == {**meanings(Wheel), "alloy": ""}


def test_toml_faults_name_file_and_line(tmp_path: Path) -> None:
    file = tmp_path / "a.toml"
    with pytest.raises(ConfigError, match="does not exist") as missing:
        load_toml(file)
    assert missing.value.file == str(file)
    file.write_text("a = 1\nb = = 2\n")
    with pytest.raises(ConfigError, match=r"not valid TOML.*line 2"):
        load_toml(file)
    file.write_bytes(b"a = '\xff'\n")
    with pytest.raises(ConfigError, match="not valid TOML"):
        load_toml(file)

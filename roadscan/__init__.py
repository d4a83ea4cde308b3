"""roadscan: raw logs of a road survey in, survey-grade pavement surfaces out.

Start with :func:`open_survey` (a survey file) or :func:`read_log` (one log, without a survey). Who has a profile of a
road as arrays asks :func:`iri` and :func:`mpd`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from roadscan.arrays import write_profiles, write_returns, write_trajectory
    from roadscan.condition.profiles.profile_files import read_profile, write_erd
    from roadscan.condition.profiles.spectrum import road_spectrum
    from roadscan.condition.profiles.straightedge import straightedge_mm
    from roadscan.condition.profiles.tables import iri, localised_roughness, mpd
    from roadscan.core.errors import RoadscanError
    from roadscan.door import LogTables, MadeProduct, OpenSurvey, open_survey, read_log

__all__ = [
    "LogTables",
    "MadeProduct",
    "OpenSurvey",
    "RoadscanError",
    "__version__",
    "iri",
    "localised_roughness",
    "mpd",
    "open_survey",
    "read_log",
    "read_profile",
    "road_spectrum",
    "straightedge_mm",
    "write_erd",
    "write_profiles",
    "write_returns",
    "write_trajectory",
]

_ELSEWHERE = {
    "RoadscanError": "roadscan.core.errors",
    **dict.fromkeys(("iri", "localised_roughness", "mpd"), "roadscan.condition.profiles.tables"),
    **dict.fromkeys(("read_profile", "write_erd"), "roadscan.condition.profiles.profile_files"),
    "road_spectrum": "roadscan.condition.profiles.spectrum",
    "straightedge_mm": "roadscan.condition.profiles.straightedge",
    **dict.fromkeys(("write_profiles", "write_returns", "write_trajectory"), "roadscan.arrays"),
}


def __getattr__(name: str) -> Any:
    """A public name, imported when it is asked for: `import roadscan` loads nothing heavy."""
    if name not in __all__:
        raise AttributeError(f"module 'roadscan' has no attribute '{name}'")
    import importlib

    return getattr(importlib.import_module(_ELSEWHERE.get(name, "roadscan.door")), name)


def __dir__() -> list[str]:
    """Names for completion."""
    return sorted(__all__)

"""roadscan: raw logs of a road survey in, survey-grade pavement surfaces out.

Start with :func:`open_survey` (a survey file) or :func:`read_log` (one log, without a survey). Who has a profile of a
road as arrays asks :func:`iri` and :func:`mpd`.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

_WIDE = {"NPY_DISABLE_CPU_FEATURES": "X86_V4", "ARROW_USER_SIMD_LEVEL": "AVX2", "OPENCV_CPU_DISABLE": "AVX512-SKX"}
"""Environment that keeps NumPy, Arrow and OpenCV from instructions of 512 bits: their functions (exp, log, sums) end in
other last bits with these."""
_SUMS = {"OPENBLAS_CORETYPE": "Haswell", "OPENBLAS_NUM_THREADS": "1"}
"""Environment with which OpenBLAS adds in one order, whatever the processor and the number of its cores."""


def _settle_arithmetic() -> None:
    """Let libraries compute the same last bits on each processor of x86-64 with AVX2; what the user set stays.

    They read the environment once, when they are loaded: NumPy must not be imported before roadscan.
    """
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as file:  # noqa: PTH123 — pathlib costs 10 ms
            flags = set(file.read(8192).partition("flags")[2].partition("\n")[0].split())
    except OSError:
        return
    wanted = (_SUMS if "avx2" in flags else {}) | (_WIDE if "avx512f" in flags else {})
    for name, value in wanted.items():
        os.environ.setdefault(name, value)


_settle_arithmetic()

if TYPE_CHECKING:
    from roadscan.arrays import write_profiles, write_returns, write_trajectory
    from roadscan.condition.profiles.profile_files import read_profile, write_erd
    from roadscan.condition.profiles.tables import iri, localised_roughness, mpd
    from roadscan.condition.profiles.unevenness import road_spectrum, straightedge_mm
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
    "road_spectrum": "roadscan.condition.profiles.unevenness",
    "straightedge_mm": "roadscan.condition.profiles.unevenness",
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

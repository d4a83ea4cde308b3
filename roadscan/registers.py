"""The processor that Numba compiles for; the kernels and the simulator's loops share it.

It is part of every compiled function's key, and settled when a process decorates its first one. So it has to be the
same whoever comes first: a process of another mind would compile all over again.
"""

from __future__ import annotations

import os

import llvmlite.binding
import numba


def use_whole_registers() -> None:
    """Let the compiler use all 512 bits of a register where there are that many; it prefers 256 for old machines."""
    host = llvmlite.binding.get_host_cpu_features()
    if host.get("avx512f") and "NUMBA_CPU_FEATURES" not in os.environ:
        os.environ.setdefault("NUMBA_CPU_NAME", llvmlite.binding.get_host_cpu_name())
        os.environ["NUMBA_CPU_FEATURES"] = host.flatten() + ",-prefer-256-bit"
        numba.config.reload_config()

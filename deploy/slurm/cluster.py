"""A Dask cluster of SLURM jobs, for as long as this program runs: docs/cluster.md.

Start it on a host that all compute nodes reach (a login node, or in a job of its own). It writes the scheduler's
address to a file, which `roadscan run --scheduler "$(cat scheduler)"` reads. Needs `pip install "roadscan[slurm]"`.
"""

import argparse
import signal
from pathlib import Path

import dask
from dask_jobqueue import SLURMCluster
from distributed import Security

# The scheduler: roadscan tries a task again itself, and Dask's log of messages holds whole tasks.
dask.config.set({"distributed.scheduler.allowed-failures": 0, "distributed.admin.low-level-log-length": 50})

# The workers: a block bounds their memory, so Dask neither spills nor pauses; they keep the memory that they touched.
PROLOGUE = [
    "export DASK_DISTRIBUTED__WORKER__MEMORY__TARGET=False",
    "export DASK_DISTRIBUTED__WORKER__MEMORY__SPILL=False",
    "export DASK_DISTRIBUTED__WORKER__MEMORY__PAUSE=False",
    "export MALLOC_TRIM_THRESHOLD_=1073741824 MALLOC_TOP_PAD_=67108864 MALLOC_MMAP_MAX_=0 MALLOC_ARENA_MAX=1",
    "export GLIBC_TUNABLES=glibc.malloc.hugetlb=1",
    # The same last bits on each processor: docs/scaling.md, "Without AVX-512".
    "export OPENBLAS_CORETYPE=Haswell OPENBLAS_NUM_THREADS=1 NPY_DISABLE_CPU_FEATURES=X86_V4",
    "export ARROW_USER_SIMD_LEVEL=AVX2 OPENCV_CPU_DISABLE=AVX512-SKX",
]


def cluster(jobs: int, processes: int, memory: str, walltime: str, port: int, folder: str) -> SLURMCluster:
    """A cluster of some jobs; each has a worker process with one thread a core."""
    made = SLURMCluster(
        cores=processes,
        processes=processes,
        memory=memory,
        walltime=walltime,
        local_directory=folder,
        protocol="tls",
        security=Security(),  # the certificates of Dask's configuration: distributed.comm.tls
        scheduler_options={"port": port, "dashboard": False},
        job_script_prologue=PROLOGUE,
        worker_extra_args=["--no-dashboard"],
    )
    made.scale(jobs=jobs)
    return made


if __name__ == "__main__":
    asked = argparse.ArgumentParser(description=__doc__)
    asked.add_argument("--jobs", type=int, default=2, help="jobs of SLURM")
    asked.add_argument("--processes", type=int, default=8, help="worker processes a job, one a core")
    asked.add_argument("--memory", default="32GiB", help="memory of a job")
    asked.add_argument("--walltime", default="08:00:00", help="time of a job")
    asked.add_argument("--port", type=int, default=8786, help="port of the scheduler")
    asked.add_argument("--folder", default="/tmp", help="folder of the workers' temporary files, on the compute node")
    asked.add_argument("--out", type=Path, default=Path("scheduler"), help="file for the scheduler's address")
    given = asked.parse_args()
    with cluster(given.jobs, given.processes, given.memory, given.walltime, given.port, given.folder) as open_cluster:
        given.out.write_text(open_cluster.scheduler_address)
        try:
            signal.sigwait({signal.SIGINT, signal.SIGTERM})
        finally:
            given.out.unlink(missing_ok=True)

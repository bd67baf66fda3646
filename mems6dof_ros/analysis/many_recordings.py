"""Many recordings, on the processes or machines of a Dask cluster; the same results as one after another."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mems6dof_ros.analysis.analyze import Progress, analyze, sha256_of
from mems6dof_ros.calibration.file import load_calibration
from mems6dof_ros.errors import InputError, Mems6dofError
from mems6dof_ros.localization.localizer import Localizer
from mems6dof_ros.pose.estimator import PoseEstimator
from mems6dof_ros.pose.settings import PoseSettings
from mems6dof_ros.sources.source import open_recording

if TYPE_CHECKING:
    from distributed import Client


@dataclass(frozen=True)
class Job:
    """What `mems6dof analyze` does with one recording: a bag, or images that tell their pixel size.

    The paths must mean the same wherever it runs. ``method`` None: what the calibration proposes.
    """

    input: Path
    calibration: Path
    out: Path
    body: str = "load_gear"
    method: str | None = None
    settings: PoseSettings = field(default_factory=PoseSettings)


@dataclass(frozen=True)
class Outcome:
    """Of a Job: how many ``frames`` and ``poses``, of which ``valid``; or why it failed, ``error``."""

    job: Job
    frames: int = 0
    poses: int = 0
    valid: int = 0
    error: str = ""


def analyze_one(job: Job) -> Outcome:
    """Do ``job``, in one thread."""
    try:
        calibration = load_calibration(job.calibration, job.method)
        summary = analyze(
            open_recording(job.input),
            Localizer(calibration.camera, calibration),
            [PoseEstimator(job.settings, job.body)],
            job.out,
            provenance={"input": job.input.name, "input_sha256": sha256_of(job.input)},
            attachments={"calibration.yaml": job.calibration.read_bytes()},
        )
    except (Mems6dofError, OSError) as error:  # the other recordings are worth having
        return Outcome(job, error=str(error))
    valid = sum(pose.valid for pose in summary.poses)
    return Outcome(job, summary.frames, len(summary.poses), valid)


def analyze_many(
    jobs: Sequence[Job], client: Client | None = None, progress: Progress = lambda done, total: None
) -> list[Outcome]:
    """Outcomes in the order of ``jobs``; on the cluster of ``client``, None: here, one after another.

    Raises InputError for two jobs that would write into one directory.
    """
    outs = [job.out for job in jobs]
    if twice := sorted({str(out) for out in outs if outs.count(out) > 1}):
        raise InputError("recordings", f"several that would be written into {twice[0]}", "different names")
    outcomes: dict[Path, Outcome] = {}
    for outcome in _outcomes(jobs, client):
        outcomes[outcome.job.out] = outcome
        progress(len(outcomes), len(jobs))
    return [outcomes[out] for out in outs]


def _outcomes(jobs: Sequence[Job], client: Client | None) -> Iterator[Outcome]:
    if client is None:
        yield from map(analyze_one, jobs)
        return
    from distributed import as_completed

    # Not pure: what a job writes is its result, and a second run must not be answered from memory.
    for future in as_completed(client.map(analyze_one, jobs, pure=False)):
        yield future.result()


@contextmanager
def cluster(scheduler: str = "", processes: int = 1) -> Iterator[Client | None]:
    """A client of the Dask ``scheduler`` at an address, else of so many ``processes`` here; None where there
    is only one. Raises InputError where Dask is not installed or does not answer."""
    if not scheduler and processes == 1:
        yield None
        return
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError("Dask", "not installed", "pip install 'mems6dof_ros[dask]'") from None
    try:
        client: Any = (
            Client(scheduler, timeout=10)
            if scheduler
            else Client(LocalCluster(n_workers=processes, threads_per_worker=1, dashboard_address=None))
        )
    except (OSError, ValueError) as error:
        raise InputError(f"Dask scheduler {scheduler}", str(error), "one that answers") from None
    with client:
        yield client
    if not scheduler:
        client.cluster.close()

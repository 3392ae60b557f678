"""Runs the jobs of a folder: in this process, in several, or on a Dask cluster; what is done already is not done again.

Every result is a line of `progress.jsonl` as soon as it is there. A run that was interrupted, or one with more images
or methods of the same files, takes the lines whose keys still hold (`Job.key`).
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

from tqdm import tqdm

from samsod.evaluation.data import DataError
from samsod.evaluation.saliency.scoring import Job, Result, score_image

PROGRESS = "progress.jsonl"


def read_progress(path: Path) -> dict[str, Result]:
    """Results of earlier runs by their keys; a line that was cut short is left out."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return {}
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: {error}") from error
    results = {}
    for line in lines:
        try:
            result = Result.from_json(line)
        except (ValueError, KeyError, TypeError):
            continue
        results[result.key] = result
    return results


def run_jobs(
    jobs: Sequence[Job],
    done: dict[str, Result],
    progress: Path | None,
    processes: int,
    cluster: str | None = None,
) -> list[Result]:
    """Runs the jobs that are not done, behind a progress bar.

    Args:
        jobs: one an image.
        done: results by the keys of their jobs.
        progress: file that gets a line for each; None keeps none.
        processes: at most so many at a time.
        cluster: address of a Dask scheduler, whose workers do the work; they must see the files under the same paths.

    Returns:
        a result for every job, in their order.

    Raises:
        DataError: the cluster cannot be reached.
        OSError: the file cannot be written.
    """
    results = {job.key: done[job.key] for job in jobs if job.key in done}
    rest = [job for job in jobs if job.key not in results]
    interval = 0.1 if sys.stderr.isatty() else 10.0
    bar = tqdm(total=len(jobs), initial=len(results), unit="image", file=sys.stderr, mininterval=interval)
    with bar:
        file = progress.open("w", encoding="utf-8") if progress else None
        try:
            if file:
                file.writelines(result.to_json() + "\n" for result in results.values())
                file.flush()
            for result in _results(rest, processes, cluster):
                results[result.key] = result
                if file:
                    file.write(result.to_json() + "\n")
                    file.flush()
                bar.update()
        finally:
            if file:
                file.close()
    return [results[job.key] for job in jobs]


def _results(jobs: Sequence[Job], processes: int, cluster: str | None) -> Iterable[Result]:
    if not jobs:
        return ()
    if cluster is not None:
        return _on_cluster(jobs, cluster)
    processes = min(processes, len(jobs))
    return map(score_image, jobs) if processes <= 1 else _in_processes(jobs, processes)


def _in_processes(jobs: Sequence[Job], processes: int) -> Iterator[Result]:
    # Not by fork: a copy of a process lacks the threads that its libraries count on.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context, initializer=one_thread) as pool:
        futures = [pool.submit(score_image, job) for job in jobs]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:
            # An interrupted run must not finish what has been queued.
            pool.shutdown(wait=True, cancel_futures=True)


def one_thread() -> None:
    """One thread for samsod in this process: the images are what is spread over the cores."""
    os.environ["RAYON_NUM_THREADS"] = "1"


def _on_cluster(jobs: Sequence[Job], address: str) -> Iterator[Result]:
    try:
        from distributed import Client
        from distributed import as_completed as completed
    except ImportError as error:
        raise DataError(f"{error}; --cluster needs Dask: pip install 'samsod[cluster]'") from error
    try:
        client: Any = Client(address, timeout="15s")  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise DataError(f"--cluster {address}: {error}") from error
    with client:
        if not client.scheduler_info()["workers"]:
            raise DataError(f"--cluster {address}: it has no workers")
        # Results of files are not pure: the same job may find other pixels.
        futures = client.map(score_image, jobs, pure=False)
        for future in completed(futures):  # type: ignore[no-untyped-call]
            result: Result = future.result()
            future.release()
            yield result


def available_processes() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

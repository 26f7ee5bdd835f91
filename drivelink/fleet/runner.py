"""A fleet run: submits recordings to Dask, a few ahead of the workers, and stores their results."""

from __future__ import annotations

import atexit
import logging
import math
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import islice, pairwise
from multiprocessing import resource_tracker
from types import FrameType
from typing import Any, Literal, cast

import dask
from dask.utils import parse_bytes
from distributed import Client, LocalCluster, as_completed
from distributed.comm.addressing import get_address_host_port
from distributed.deploy.spec import close_clusters
from distributed.scheduler import KilledWorker
from distributed.security import Security
from distributed.utils import LoopRunner

from drivelink import __version__
from drivelink.fleet.joints import Joints, carried_joint
from drivelink.fleet.storage import FleetError, Source, Store, fetched, one_line
from drivelink.fleet.table import FleetTable
from drivelink.fleet.task import Outcome, Task, broken_row, named_time, process, recorded_time

_LOST = ("cancelled", "lost")  # of a future
_AHEAD = 4  # recordings queued per worker thread
_CONNECT_S = 10.0
_EPOCH = datetime.fromtimestamp(0, UTC)


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """Settings of a run."""

    scheduler: str | None = None  # address of a running Dask scheduler, `tls://…`; None: a local cluster
    # accept a scheduler without TLS, where anybody who reaches it runs code as its workers' user
    insecure: bool = False
    workers: int | None = None  # processes of the local cluster; None: one a core
    # limit of each worker, e.g. "2GiB"; None: equal shares of the local memory, or the limits of the
    # scheduler's workers.
    memory: str | None = None
    since: datetime | None = None  # omit earlier recordings
    # "previous" validates on the joint's recording before; None: on held-out blocks
    validate: Literal["previous"] | None = None
    again: bool = False  # repeat recordings that are in the table

    @property
    def limit_bytes(self) -> float:
        """`memory` in bytes; 0: left to Dask.

        Raises:
            FleetError: not a size.
        """
        if self.memory is None:
            return 0.0
        try:
            size = float(parse_bytes(self.memory))
        except (ValueError, OverflowError):
            size = math.nan
        if not 0.0 < size < math.inf:
            raise FleetError(f'--memory: expected a size such as 2GiB, got "{self.memory}"')
        return size


@dataclass(slots=True)
class Counts:
    """Number of recordings by outcome."""

    found: int = 0
    done: int = 0
    known: int = 0
    early: int = 0
    broken: int = 0


def run(
    sources: list[Source],
    joints: Joints,
    store: Store,
    settings: Settings,
    progress: Callable[[Counts], None] = lambda _: None,
    say: Callable[[str], None] = lambda _: None,
) -> Counts:
    """Process all recordings that are not in the table yet.

    Finished work is in the table however the run ends.

    Raises:
        FleetError: the scheduler is not reached or lost, or results cannot be written.
        KeyboardInterrupt: Ctrl-C or SIGTERM.
    """
    counts = Counts(found=len(sources))
    with FleetTable(store) as table:
        wanted = [source for source in sources if _wanted(source, joints, table, settings, counts)]
        if not wanted:
            return counts
        with _interruptible() as go_on, _client(settings, len(wanted)) as client:
            if not client.scheduler_info(n_workers=-1)["workers"]:
                say(f"--scheduler {settings.scheduler}: no worker has connected to it yet: waits for one")
            shared = client.submit(Joints, joints.by_name, pure=False)
            before = _previous(sources, joints, shared, client) if settings.validate == "previous" else {}
            tasks = (_task(source, before.get(source.url), table, settings) for source in wanted)
            for task, outcome in _results(client, tasks, shared):
                _take(task, outcome, table, store, counts, say)
                progress(counts)
                go_on()
    return counts


def _wanted(source: Source, joints: Joints, table: FleetTable, settings: Settings, counts: Counts) -> bool:
    """Return whether a recording needs processing, by its listing."""
    latest = named_time(source) or source.modified
    if settings.since and latest and latest < settings.since:
        counts.early += 1
        return False
    known = table.at(source)
    if known is None or settings.again or known.version != __version__:
        return True
    if known.failed:  # retry if the joint or its model has changed
        now = joints.by_name.get(known.joint) if known.joint else None
        if known.joint is None or (now is not None and now.digest != known.accepted_model):
            return True
    counts.known += 1
    return False


def _task(source: Source, previous: Source | None, table: FleetTable, settings: Settings) -> Task:
    return Task(
        source=source,
        version=__version__,
        done=frozenset() if settings.again else table.contents(source.size, __version__),
        previous=previous,
        since=settings.since,
        limit_bytes=settings.limit_bytes if settings.scheduler else 0.0,
    )


def _results(client: Client, tasks: Iterable[Task], shared: Any) -> Iterator[tuple[Task, Outcome]]:
    """Outcomes in order of completion; at most a few tasks per worker are submitted."""
    tasks = iter(tasks)
    out: dict[str, Task] = {}
    finished = as_completed(loop=client.loop)

    def submit(more: Iterable[Task]) -> None:
        for task in more:
            future = client.submit(process, task, shared, pure=False)
            out[future.key] = task
            finished.add(future)

    submit(islice(tasks, _window(client)))
    for future in finished:
        task = out.pop(future.key)
        if future.status in _LOST and client.status == "running":  # a worker died with the result
            submit([task])
            continue
        yield task, _outcome(future, task)
        future.release()
        submit(islice(tasks, max(1, _window(client) - len(out))))


def _window(client: Client) -> int:
    workers = client.scheduler_info(n_workers=-1)["workers"].values()
    return max(2, _AHEAD * sum(int(worker["nthreads"]) for worker in workers))


def _outcome(future: Any, task: Task) -> Outcome:
    if future.status == "finished":
        return cast("Outcome", future.result())
    if future.status in _LOST:
        raise FleetError("the scheduler is gone; what was finished is in the table")
    error = future.exception()
    if isinstance(error, KilledWorker):
        line = f"ended {error.allowed_failures + 1} workers one after the other: out of memory, or a crash"
    else:
        line = " ".join(f"{type(error).__name__}: {error}".split())
    return Outcome("error", [broken_row(task, line)], [], [])


def _take(
    task: Task, outcome: Outcome, table: FleetTable, store: Store, counts: Counts, say: Callable[[str], None]
) -> None:
    for note in outcome.notes:
        say(note)
    if outcome.kind == "early":
        counts.early += 1
        return
    if outcome.kind == "known" or table.has_now(outcome.rows[0]["digest"], outcome.rows[0]["joint"]):
        counts.known += 1
        return
    for name, text in outcome.reports:  # before their row
        store.write(name, text.encode())
    table.append(outcome.rows)
    if outcome.kind == "error":
        counts.broken += 1
        say(f"{task.source.url}: {outcome.rows[0]['error']}")
    else:
        counts.done += 1


@contextmanager
def _client(settings: Settings, tasks: int) -> Iterator[Client]:
    """A client of the given scheduler, or of a local cluster that ends with it."""
    for name in ("distributed", "asyncio"):  # what matters of them is in a result
        logging.getLogger(name).setLevel(logging.CRITICAL)
    dask.config.set(
        {
            "distributed.comm.timeouts.connect": f"{_CONNECT_S:g}s",
            "distributed.worker.profile.enabled": False,  # a hundred looks a second at every worker's stack
            "distributed.scheduler.http.routes": [],  # logs and stacks: for nobody
            "distributed.worker.http.routes": [],
        }
    )
    if settings.scheduler is None:
        with _local(settings, tasks) as client:
            yield client
        return
    with _remote(settings.scheduler, settings.insecure) as client:
        _check_workers(client, settings.scheduler)
        yield client


@contextmanager
def _local(settings: Settings, tasks: int) -> Iterator[Client]:
    """A cluster on loopback, only for this run: whoever reaches a port of Dask and is let in runs code."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    with (
        tempfile.TemporaryDirectory(prefix="drivelink-dask-") as folder,
        _started(
            n_workers=min(settings.workers or cores, tasks),
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            security=Security.temporary(),  # in memory, valid for this run
            local_directory=folder,
            memory_limit=settings.limit_bytes or "auto",
            dashboard_address="127.0.0.1:0",  # any port; without routes
            silence_logs=logging.CRITICAL,
            preload=["drivelink.fleet.task"],
        ) as cluster,
        Client(cluster, set_as_default=False) as client,
    ):
        yield client


def _started(**how: Any) -> LocalCluster:
    """Return a cluster whose processes Ctrl-C in the terminal does not reach: this one ends them.

    Raises:
        KeyboardInterrupt: before all have started; they end with this process.
        FleetError: they do not start.
    """
    loop = LoopRunner()
    resource_tracker.ensure_running()  # else the first process lifts the mask to start it
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        loop.start()  # its thread, and what that starts, inherit the mask
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        return LocalCluster(loop=loop.loop, **how)
    except KeyboardInterrupt:
        atexit.unregister(close_clusters)  # it refuses those that have not started, with a traceback
        raise
    except RuntimeError as error:  # one was killed meanwhile, for want of memory say
        raise FleetError(f"its processes do not start: {one_line(error)}") from error


def _remote(address: str, insecure: bool) -> Client:
    """Return a client of a running scheduler; certificates are those of Dask's configuration.

    Raises:
        FleetError: without TLS and not `insecure`, without certificates, or not reached.
    """
    if not address.startswith("tls://") and not insecure:
        raise FleetError(
            f"--scheduler {address}: expected tls://HOST:PORT: without TLS anybody who reaches the scheduler "
            "runs code on its workers (docs/how-to/fleet.md shows how; --insecure accepts it)"
        )
    security = Security()
    if address.startswith("tls://") and not (security.tls_ca_file and security.tls_client_cert):
        raise FleetError(
            f"--scheduler {address}: expected certificates in Dask's configuration: "
            "distributed.comm.tls.ca-file, .client.cert and .client.key"
        )
    for file in (security.tls_ca_file, security.tls_client_cert, security.tls_client_key):
        if file and "\n" not in file and not os.access(file, os.R_OK):  # else the certificate itself
            raise FleetError(f"--scheduler {address}: {file} of Dask's configuration: cannot be read")
    try:
        get_address_host_port(address)  # before there is a client, which would have to be closed
        return Client(address, security=security, timeout=f"{_CONNECT_S:g}s", set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise FleetError(f"--scheduler {address}: cannot be reached: {one_line(error)}") from error


def _check_workers(client: Client, address: str) -> None:
    """Check that all present workers have this version; later ones are checked per task."""
    try:
        versions = client.run(_worker_version)
    except Exception as error:  # whatever a worker of another version raises
        why = f"its workers need drivelink {__version__}: {one_line(error)}"
        raise FleetError(f"--scheduler {address}: {why}") from error
    for worker, version in versions.items():
        if version != __version__:
            has = f"worker {worker} has drivelink {version}"
            raise FleetError(f"--scheduler {address}: {has}, not {__version__}")


def _worker_version() -> str:
    from drivelink import __version__ as version

    return version


def _previous(sources: list[Source], joints: Joints, shared: Any, client: Client) -> dict[str, Source]:
    """Return the previous recording of the same joint, by address.

    Workers read joint and time of MCAP files; others are known by name and date.
    """
    carrying = [s for s in sources if _carries(s)]
    known = dict(_identified(s, joints) for s in sources if not _carries(s))
    known |= dict(client.gather(client.map(_identified, carrying, joints=shared, pure=False)))
    order: dict[str, list[tuple[datetime, str, Source]]] = {}
    for source in sources:
        joint, when = known[source.url]
        if joint is not None:
            order.setdefault(joint, []).append((when or _EPOCH, source.url, source))
    before: dict[str, Source] = {}
    for entries in order.values():
        entries.sort(key=lambda entry: entry[:2])
        before.update((later[1], earlier[2]) for earlier, later in pairwise(entries))
    return before


def _carries(source: Source) -> bool:
    return source.name.lower().endswith(".mcap")


def _identified(source: Source, joints: Joints) -> tuple[str, tuple[str | None, datetime | None]]:
    try:
        if not _carries(source):
            return source.url, (joints.named(source.url).name, named_time(source) or source.modified)
        with fetched(source) as (path, _):
            joint = carried_joint(path)
            name = joint.name if joint else joints.named(source.url).name
            return source.url, (name, recorded_time(path, source))
    except Exception:  # noqa: BLE001 - the task itself says what is wrong
        return source.url, (None, None)


@contextmanager
def _interruptible() -> Iterator[Callable[[], None]]:
    """End a run by SIGTERM as by Ctrl-C.

    Yields:
        A check that raises KeyboardInterrupt where a finaliser has discarded that of a signal.
    """
    stopped = False

    def stop(number: int, frame: FrameType | None) -> None:
        nonlocal stopped
        stopped = True
        raise KeyboardInterrupt

    def go_on() -> None:
        if stopped:
            raise KeyboardInterrupt

    def discarded(unraisable: sys.UnraisableHookArgs) -> None:
        if not isinstance(unraisable.exc_value, KeyboardInterrupt):  # of that one `go_on` says so
            say(unraisable)

    before, say = {}, sys.unraisablehook
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            if signal.getsignal(number) != signal.SIG_IGN:
                before[number] = signal.signal(number, stop)
    except ValueError:  # not in the main thread
        yield go_on
        return
    sys.unraisablehook = discarded
    try:
        yield go_on
    finally:
        sys.unraisablehook = say
        for number, handler in before.items():
            signal.signal(number, handler)

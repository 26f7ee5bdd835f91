"""The fleet: what it finds, what it costs, and what survives.

    python benchmarks/fleet.py changes [--joints 40] [--nights 25] [--seconds 10]
    python benchmarks/fleet.py throughput [--recordings 40]      one worker, two workers
    python benchmarks/fleet.py cpu [--recordings 5]              beside fit and diagnose
    python benchmarks/fleet.py table [--rows 10000]              appended and reported
    python benchmarks/fleet.py statistics [--fleets 200]         the tests alone, on many fleets
    python benchmarks/fleet.py memory                            of fit and diagnose, by size

`changes` starts a Dask scheduler and two workers on loopback, hands the simulated fleet of `fleet_world.py`
to `drivelink fleet --scheduler`, ends one worker process by SIGKILL when half is done, and compares table and
report with the truth. Each prints one JSON object last. Sizes are arguments.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import dask
import fleet_world
import numpy as np
import psutil
from distributed import Client

from drivelink import __version__, cli
from drivelink.fleet.changes import q_values, series_test
from drivelink.fleet.joints import Joints
from drivelink.fleet.storage import Store, find
from drivelink.fleet.table import FleetTable, read_rows
from drivelink.fleet.task import Task, process

BIN = Path(sys.executable).parent


def prepared(args: argparse.Namespace) -> Path:
    """The fleet's folder; made if it is not there."""
    folder: Path = args.folder or Path(tempfile.mkdtemp(prefix="drivelink-fleet-"))
    if not (folder / "truth.json").exists():
        fleet_world.make(folder, args.joints, args.nights, args.seconds, args.seed)
    return folder


def _certified(folder: Path) -> None:
    """A certificate for scheduler, workers and clients, as docs/how-to/fleet.md makes it."""
    key, certificate = folder / "fleet.key", folder / "fleet.pem"
    new = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-subj", "/CN=fleet"]
    command = ["openssl", "req", "-x509", *new, "-keyout", str(key), "-out", str(certificate)]
    subprocess.run(command, check=True, capture_output=True)
    roles = {role: {"cert": str(certificate), "key": str(key)} for role in ("scheduler", "worker", "client")}
    tls = {"ca-file": str(certificate), **roles}
    config = {"distributed": {"comm": {"require-encryption": True, "tls": tls}}}
    (folder / "dask.json").write_text(json.dumps(config), encoding="utf-8")
    os.environ["DASK_CONFIG"] = str(folder / "dask.json")
    dask.config.update(dask.config.config, config)


@contextlib.contextmanager
def cluster(folder: Path, workers: int) -> Iterator[str]:
    """A scheduler and workers, each a process of its own, on loopback; yields its address."""
    file = folder / f"scheduler-{os.getpid()}.json"
    file.unlink(missing_ok=True)
    _certified(folder)
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    begin = [BIN / "dask", "scheduler", "--protocol", "tls", "--host", "127.0.0.1", "--port", "0"]
    processes = [subprocess.Popen([*begin, "--no-dashboard", "--scheduler-file", file], **quiet)]
    try:
        while not file.exists():
            time.sleep(0.1)
        work = ["--nworkers", "1", "--nthreads", "1", "--memory-limit", "2GiB", "--no-dashboard"]
        for _ in range(workers):
            command = [BIN / "dask", "worker", "--scheduler-file", file, "--host", "127.0.0.1", *work]
            processes.append(subprocess.Popen(command, cwd=folder, **quiet))
        with Client(scheduler_file=str(file)) as client:
            client.wait_for_workers(workers, timeout=60)
        yield json.loads(file.read_text())["address"]
    finally:
        for process_ in reversed(processes):
            process_.send_signal(signal.SIGINT)
        for process_ in processes:
            try:
                process_.wait(timeout=15)
            except subprocess.TimeoutExpired:
                process_.kill()


def worker_pids(address: str) -> list[int]:
    with Client(address) as client:
        return list(client.run(os.getpid).values())


class Memory(threading.Thread):
    """Resident memory of the client and of each worker, every two seconds."""

    def __init__(self, client_pid: int, address: str) -> None:
        super().__init__(daemon=True)
        self.client: list[float] = []
        self.workers: list[float] = []
        self._pid, self._address, self._over = client_pid, address, threading.Event()

    def run(self) -> None:
        with Client(self._address) as client:
            while not self._over.wait(2.0):
                with contextlib.suppress(Exception):
                    self.workers.append(max(client.run(_rss).values()))
                    self.client.append(psutil.Process(self._pid).memory_info().rss / 2**20)

    def stop(self) -> dict[str, float]:
        self._over.set()
        self.join(timeout=20)
        result = {}
        for name, values in (("client", self.client), ("worker", self.workers)):
            third = max(1, len(values) // 3)
            result[f"{name}_middle_third_mib"] = round(statistics.median(values[third : 2 * third] or [0]), 1)
            result[f"{name}_last_third_mib"] = round(statistics.median(values[-third:] or [0]), 1)
            result[f"{name}_peak_mib"] = round(max(values, default=0.0), 1)
        return result


def _rss() -> float:
    return psutil.Process().memory_info().rss / 2**20


def size_of(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def run_changes(args: argparse.Namespace) -> dict[str, Any]:
    folder = prepared(args)
    out = folder / f"out-{os.getpid()}"
    total = len(list((folder / "recordings").iterdir()))
    begin = time.monotonic()
    with cluster(folder, 2) as address:
        command = [BIN / "drivelink", "fleet", folder / "recordings", "--joints", folder / "joints"]
        run = subprocess.Popen([*command, "--out", out, "--scheduler", address], stdout=sys.stderr)
        memory = Memory(run.pid, address)
        memory.start()
        killed = 0
        while run.poll() is None:
            time.sleep(1.0)
            if not killed and len(list(out.glob("diagnoses/*/*/report.json"))) >= total // 2:
                killed = worker_pids(address)[0]
                os.kill(killed, signal.SIGKILL)
        used = memory.stop()
        seconds = time.monotonic() - begin
        again = subprocess.run(
            [*command, "--out", out, "--scheduler", address], capture_output=True, text=True
        )
    rows = read_rows(Store(str(out)))
    keys = [(row["recording"], row["transmission"]) for row in rows]
    return {
        "recordings": total,
        "exit": run.returncode,
        "killed": bool(killed),
        "rows": len(rows),
        "lost": total - len({row["recording"] for row in rows}),
        "twice": len(keys) - len(set(keys)),
        "broken": sum(row["status"] != "done" for row in rows),
        "second_run": again.stdout.splitlines()[0] if again.stdout else again.stderr,
        "seconds": round(seconds, 1),
        "cpu_s_a_recording": round(statistics.mean(row["cpu_s"] for row in rows), 3),
        "bytes_a_recording": size_of(folder / "recordings") // total,
        "report_bytes_a_recording": size_of(out / "diagnoses") // total,
        **used,
        **judged(folder, json.loads((out / "fleet.json").read_text())),
        "out": str(out),
    }


def judged(folder: Path, report: dict[str, Any]) -> dict[str, Any]:
    """What the report says against what is true."""
    joints = {one["joint"]: one for one in report["joints"]}
    truth = json.loads((folder / "truth.json").read_text())
    found: dict[str, list[int]] = {"drift": [], "step": [], "effect": []}
    places, when, called, false = [], [], 0, 0
    for true in truth:
        said = joints[true["name"]]
        moved = [c for t in said["transmissions"] for c in t["changes"]]
        appeared = [e for e in said["effects"] if e["significant"]]
        called += bool(moved or appeared)
        false += bool(moved or appeared) and true["kind"] == "healthy"
        if true["kind"] in ("drift", "step"):
            found[true["kind"]].append(bool(moved))
        if true["kind"] == "step" and moved:
            at = [(datetime.fromisoformat(c["since"]).date() - fleet_world.FIRST_NIGHT).days for c in moved]
            when.append(min(abs(day - true["since_night"]) for day in at))
        if true["kind"] == "effect":
            hit = [e for e in appeared if set(e["names"]) & fleet_world.NAMES[true["effect"]]]
            found["effect"].append(bool(hit))
        places.append((true["kind"], said["state"]))
    result = {f"found_{kind}": f"{sum(hits)} of {len(hits)}" for kind, hits in found.items()}
    result["called_changing"], result["false"] = called, false
    result["false_share"] = round(false / max(called, 1), 4)
    result["step_nights_off_max"] = max(when, default=0)
    return result


def run_throughput(args: argparse.Namespace) -> dict[str, Any]:
    """Recordings a second on one worker and on two, in turns; and the share of the time the workers worked.

    The ratio is that of this machine: with other work on its cores it falls. The share of work does not.
    """
    folder = prepared(args)
    files = [str(path) for path in sorted((folder / "recordings").iterdir())[: args.recordings]]
    rate: dict[int, list[float]] = {1: [], 2: []}
    busy: dict[int, list[float]] = {1: [], 2: []}
    base = ["--joints", str(folder / "joints")]
    for round_ in range(args.rounds):
        for workers in (1, 2):
            out = folder / f"throughput-{os.getpid()}-{round_}-{workers}"
            with cluster(folder, workers) as address, contextlib.redirect_stdout(io.StringIO()):
                where = ["--scheduler", address]
                assert cli.main(["fleet", *files[:4], *base, "--out", f"{out}-warm", *where]) == 0
                begin = time.monotonic()
                assert cli.main(["fleet", *files, *base, "--out", str(out), *where]) == 0
                seconds = time.monotonic() - begin
            rate[workers].append(len(files) / seconds)
            worked = sum(row["wall_s"] for row in read_rows(Store(str(out))))
            busy[workers].append(worked / (workers * seconds))
    one, two = (statistics.median(rate[k]) for k in (1, 2))
    return {
        "recordings": len(files), "one_a_s": one, "two_a_s": two, "ratio": two / one,
        "busy_one": statistics.median(busy[1]), "busy_two": statistics.median(busy[2]),
        "load": os.getloadavg()[0],
    }  # fmt: skip


def run_cpu(args: argparse.Namespace) -> dict[str, Any]:
    """CPU of one recording as a task, over that of the two verbs, in turns in one process."""
    folder = prepared(args)
    joints = Joints.load(folder / "joints")
    sources, _ = find([str(folder / "recordings")])
    alone, fleet = [], []
    with tempfile.TemporaryDirectory() as out, contextlib.redirect_stdout(io.StringIO()):
        for k, source in enumerate(sources[: args.recordings + 1]):
            file = joints.named(source.url).where
            begin = time.process_time()
            for verb in ("fit", "diagnose"):
                assert cli.main([verb, source.url, "--joint", file, "--out", out]) == 0
            middle = time.process_time()
            assert process(Task(source=source, version=__version__), joints).kind == "done"
            if k:  # the first one warms up
                alone.append(middle - begin)
                fleet.append(time.process_time() - middle)
    ratio = sum(fleet) / sum(alone)
    return {"recordings": len(alone), "verbs_s": sum(alone), "fleet_s": sum(fleet), "ratio": ratio}


def run_table(args: argparse.Namespace) -> dict[str, Any]:
    """Rows appended one recording at a time, then the report: 250 nights of 40 joints."""
    rng, joints = np.random.default_rng(args.seed), 40
    with tempfile.TemporaryDirectory() as folder:
        store = Store(folder)
        begin = time.monotonic()
        with FleetTable(store) as table:
            for k in range(args.rows):
                table.append([_row(k // joints, k % joints, rng)])
        appended = time.monotonic() - begin
        begin = time.monotonic()
        with contextlib.redirect_stdout(io.StringIO()):
            assert cli.main(["fleet", "report", folder]) == 0
        reported = time.monotonic() - begin
        size = sum(path.stat().st_size for path in Path(folder, "table").iterdir())
        page = Path(folder, "fleet.html").stat().st_size
        parts = len(list(Path(folder, "table").glob("*.parquet")))
    return {
        "rows": args.rows, "append_s": appended, "report_s": reported, "table_bytes_a_row": size / args.rows,
        "parts": parts, "page_mb": page / 1e6,
    }  # fmt: skip


def _row(night: int, joint: int, rng: np.random.Generator) -> dict[str, Any]:
    stiffness = 150.0 * (1.0 + 0.002 * rng.standard_normal())
    name, std = f"axis{joint:03d}", 0.1
    return {
        "id": f"{night}-{joint}", "joint": name, "transmission": 1, "part": 1, "parts": 1,
        "time": datetime(2026, 1, 5, tzinfo=UTC) + timedelta(days=night), "recording": f"{name}-{night}.csv",
        "digest": f"{night:08d}{joint:08d}", "size_bytes": 1000, "stamp": "", "status": "done", "error": None,
        "verdict": "sufficient", "sentence": "The model is sufficient.", "effects": [], "details": "{}",
        "error_before_relative": 0.01, "error_after_relative": 0.01, "model": "linear",
        "parameters": json.dumps({"k_nm_rad": stiffness}), "covariance": [std**2], "excited": True,
        "deflection_middle_rad": 0.02, "stiffness_middle_nm_rad": stiffness,
        "stiffness_std_middle_nm_rad": std, "cpu_s": 0.0, "version": __version__,
        "report": f"diagnoses/{name}/{night}/report.html", "accepted_model": "0",
    }  # fmt: skip


def run_statistics(args: argparse.Namespace) -> dict[str, Any]:
    """False discovery rate and power over many fleets, for several kinds of scatter from night to night."""
    rng, result = np.random.default_rng(args.seed), {}
    time_s = np.arange(args.nights) * 86400.0
    for name, draw in NOISES.items():
        for scatter in (0.003, 0.006):
            rates, power = [], []
            for _ in range(args.fleets):
                kinds = rng.permutation(args.joints) < 0.4 * args.joints
                p = []
                for drifting in kinds:
                    noise = scatter * draw(rng, args.nights)
                    level = 1.0 - fleet_world.DRIFT * drifting * time_s / time_s[-1]
                    stated = np.full(args.nights, 0.5 * scatter)
                    p.append(series_test(time_s, level + noise, stated).p_value)
                called = q_values(np.array(p)) <= args.fdr
                rates.append((called & ~kinds).sum() / max(called.sum(), 1))
                power.append((called & kinds).sum() / kinds.sum())
            key = f"{name}, scatter {scatter:.1%}"
            result[key] = {"false_discovery_rate": float(np.mean(rates)), "found": float(np.mean(power))}
    return result


def _correlated(rng: np.random.Generator, n: int) -> np.ndarray:
    noise = rng.standard_normal(n)
    for k in range(1, n):
        noise[k] = 0.3 * noise[k - 1] + np.sqrt(1 - 0.3**2) * noise[k]
    return noise


def _spiked(rng: np.random.Generator, n: int) -> np.ndarray:
    return np.asarray(rng.standard_normal(n) + 8.0 * (rng.random(n) < 0.04))


NOISES = {
    "normal": lambda rng, n: rng.standard_normal(n),
    "Student t, 3 degrees of freedom": lambda rng, n: rng.standard_t(3, n) / np.sqrt(3.0),
    "lag-1 correlation 0.3": _correlated,
    "4 % of the nights 8 sigma off": _spiked,
}


def run_memory(args: argparse.Namespace) -> dict[str, Any]:
    """Peak memory of fit and diagnose of a small and of a large recording, each in a process of its own.

    Its rise over that of the file's size is what `drivelink/fleet/pieces.py` plans with.
    """
    sizes, peaks = [], []
    for seconds in (50.0, 400.0):
        with tempfile.TemporaryDirectory() as folder:
            fleet_world.make(Path(folder), 1, 1, seconds, args.seed)
            (path,) = (Path(folder) / "recordings").iterdir()
            joint = Path(folder) / "joints" / "axis000.toml"
            code = (
                "import sys, resource; from drivelink import cli;"
                "[cli.main([v, sys.argv[1], '--joint', sys.argv[2], '--out', sys.argv[3]]) for v in "
                "('fit', 'diagnose')]; print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)"
            )
            command = [sys.executable, "-c", code, path, joint, folder]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            sizes.append(path.stat().st_size)
            peaks.append(int(done.stdout.split()[-1]))
    rise = (peaks[1] - peaks[0]) / (sizes[1] - sizes[0])
    return {"file_mb": [s / 1e6 for s in sizes], "peak_mib": [p / 2**20 for p in peaks], "bytes_a_byte": rise}


RUNS = {
    "changes": run_changes, "throughput": run_throughput, "cpu": run_cpu, "table": run_table,
    "statistics": run_statistics, "memory": run_memory,
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("what", choices=RUNS)
    parser.add_argument(
        "--folder", type=Path, metavar="DIR", help="of the simulated fleet; made if it is missing"
    )
    parser.add_argument("--joints", type=int, default=40)
    parser.add_argument("--nights", type=int, default=25)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each recording")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--recordings", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--rows", type=int, default=10_000)
    parser.add_argument("--fleets", type=int, default=200)
    parser.add_argument("--fdr", type=float, default=0.05)
    parser.add_argument("--json", type=Path, help="also write the numbers there")
    args = parser.parse_args()
    text = json.dumps(RUNS[args.what](args), indent=1)
    print(text)
    if args.json:
        args.json.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

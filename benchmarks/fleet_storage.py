"""The fleet's storages, for real: local files, an SFTP server, an S3-compatible server on loopback.

    apt-get install openssh-server; pip install "moto[server]"
    python benchmarks/fleet_storage.py [--joints 2] [--nights 3] [--seconds 4]

Each storage is read from and written to by the same `drivelink fleet`, and must give the rows that local
files give. A storage whose server is not installed is left out, saying so. Servers listen on 127.0.0.1 and
end with the run.
"""

from __future__ import annotations

import argparse
import contextlib
import getpass
import importlib.util
import io
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fleet_world
import fsspec

from drivelink import cli
from drivelink.fleet.storage import Store
from drivelink.fleet.table import read_rows

SAME = ("joint", "transmission", "digest", "verdict", "parameters", "stiffness_middle_nm_rad", "status")


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def wait_for(port: int) -> None:
    for _ in range(100):
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1.0):
            return
        time.sleep(0.1)
    raise TimeoutError(f"no server on port {port}")


@contextlib.contextmanager
def sftp(folder: Path) -> Iterator[str]:
    """An OpenSSH server with keys of its own; yields the URL of a folder."""
    sshd, port = shutil.which("sshd", path=f"{os.environ['PATH']}:/usr/sbin") or "", free_port()
    home = folder / "sftp"
    home.mkdir(mode=0o700)
    for name in ("host", "user"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", home / name], check=True)
    shutil.copy(home / "user.pub", home / "authorized_keys")
    config = (
        f"ListenAddress 127.0.0.1\nPort {port}\nHostKey {home}/host\n"
        f"AuthorizedKeysFile {home}/authorized_keys\n"
        f"PidFile {home}/pid\nStrictModes no\nPasswordAuthentication no\nSubsystem sftp internal-sftp\n"
        "PermitRootLogin prohibit-password\n"
    )
    (home / "config").write_text(config)
    Path("/run/sshd").mkdir(exist_ok=True)
    server = subprocess.Popen([sshd, "-D", "-f", home / "config", "-E", home / "log"])
    os.environ["FSSPEC_SFTP_KEY_FILENAME"] = str(home / "user")
    fsspec.config.set_conf_env(fsspec.config.conf)
    try:
        wait_for(port)
        yield f"sftp://{getpass.getuser()}@127.0.0.1:{port}{home}/data"
    finally:
        server.terminate()
        server.wait(timeout=10)


@contextlib.contextmanager
def s3(folder: Path) -> Iterator[str]:
    """moto's server; yields the URL of a bucket."""
    port = free_port()
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=folder)
    names = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ACCESS_KEY_ID": "k",
        "AWS_SECRET_ACCESS_KEY": "s",
    }
    os.environ |= names | {"AWS_DEFAULT_REGION": "us-east-1"}
    try:
        wait_for(port)
        fsspec.filesystem("s3").mkdir("plant")
        yield "s3://plant/data"
    finally:
        server.terminate()
        server.wait(timeout=10)


def lacking(name: str) -> str | None:
    """What is not installed."""
    if name == "sftp" and shutil.which("sshd", path=f"{os.environ['PATH']}:/usr/sbin") is None:
        return "openssh-server"
    if name == "s3" and importlib.util.find_spec("moto") is None:
        return "moto[server]"
    return None


def upload(folder: Path, url: str) -> None:
    fs, root = fsspec.core.url_to_fs(url)
    for path in (folder / "recordings").iterdir():
        fs.makedirs(f"{root}/recordings", exist_ok=True)
        fs.put_file(str(path), f"{root}/recordings/{path.name}")


def run(folder: Path, url: str) -> dict[str, Any]:
    """From and to a storage, twice; what it took and what the table says."""
    command = ["fleet", f"{url}/recordings/*.csv", "--joints", str(folder / "joints"), "--out", f"{url}/out"]
    said = io.StringIO()
    begin = time.monotonic()
    with contextlib.redirect_stdout(said):
        assert cli.main([*command, "--workers", "2"]) == 0
        seconds = time.monotonic() - begin
        assert cli.main(command) == 0
    lines = [line for line in said.getvalue().splitlines() if " recordings: " in line]
    store = Store(f"{url}/out")
    rows = read_rows(store)
    return {
        "seconds": round(seconds, 1),
        "first": lines[0],
        "second": lines[1],
        "rows": sorted((tuple(row[name] for name in SAME) for row in rows), key=str),
        "page_bytes": len(store.read("fleet.html")),
        "diagnoses": sum(bool(store.read(row["report"])) for row in rows),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--joints", type=int, default=2)
    parser.add_argument("--nights", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=4.0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="drivelink-storage-") as name:
        folder = Path(name)
        fleet_world.make(folder, args.joints, args.nights, args.seconds, 0)
        local = run(folder, str(folder))
        result: dict[str, Any] = {"local": local}
        for storage, server in (("sftp", sftp), ("s3", s3)):
            if missing := lacking(storage):
                result[storage] = f"left out: {missing} is not installed"
                continue
            with server(folder) as url:
                upload(folder, url)
                result[storage] = one = run(folder, url)
                one["same_rows_as_local"] = one["rows"] == local["rows"]
    for one in result.values():
        if isinstance(one, dict):
            one["rows"] = len(one["rows"])
    print(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()

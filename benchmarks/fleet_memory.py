"""Peak memory of `fit` and `diagnose` by the size of a recording, each size in a process of its own.

    python benchmarks/fleet_memory.py [--seconds S,S]

The rise over that of the file's size is what `drivelink/fleet/task.py` plans with.
"""

import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import scene
from scene import diagnosiskit, fleetkit, joints

CODE = """
import resource, sys
from drivelink import cli
for verb in ("fit", "diagnose"):
    cli.main([verb, sys.argv[1], "--joint", sys.argv[2], "--out", sys.argv[3]])
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10)
"""


def rows(args) -> Iterator[scene.Row]:
    """One row a size; "rise" is over the row before, bytes of memory a byte of the file."""
    before: tuple[int, int] | None = None
    for seconds in map(float, args.seconds):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (record,) = diagnosiskit.World([{}], seconds=seconds).run()
            path, joint = joints.write_csv(record, folder / "elbow.csv", 9), folder / "elbow.toml"
            joint.write_text(fleetkit.JOINT.format(name="elbow"), encoding="utf-8")
            command = [sys.executable, "-c", CODE, path, joint, folder]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            size, peak = path.stat().st_size, int(done.stdout.split()[-1])
        rise = (peak - before[1]) / (size - before[0]) if before else None
        before = size, peak
        yield {"seconds": seconds, "file_mb": size / 1e6, "peak_mib": peak / 2**20, "rise": rise}


if __name__ == "__main__":
    columns = {"recording, s": "{seconds:g}", "file, MB": "{file_mb:.1f}", "peak, MiB": "{peak_mib:.0f}"}
    scene.main(__doc__, rows, columns | {"rise, B/B": "{rise:.1f}"}, scene.Option("--seconds", ["25", "200"]))

"""What is written: whole or not at all, never in the place of what was read, nothing replaced unasked."""

import errno
import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import zenohkit

from drivelink import cli
from drivelink import files as written
from drivelink.errors import RecordingError, UsageError
from drivelink.files import NewFile, check_target, read_regular, write_whole
from drivelink.jointfile import parse
from drivelink.recording.formats import open_sink
from estimator.sample import Sample

JOINT = 'name = "elbow"\n[[motor]]\ninertia_kg_m2 = 0.5\n[motor.transmission]\nmodel = "linear"\n'


@pytest.fixture
def folder(tmp_path):
    """A folder in which nothing unfinished may be left."""
    yield tmp_path
    assert not list(tmp_path.rglob(".*.tmp"))


def test_a_file_is_written_in_one_step_and_keeps_its_mode_and_its_links(folder):
    path, link = folder / "a.txt", folder / "link.txt"
    write_whole(path, "first")
    path.chmod(0o640)
    link.symlink_to(path)
    before = path.stat().st_ino
    write_whole(link, b"second", force=True)
    assert path.read_text() == "second" and link.is_symlink() and stat.S_IMODE(path.stat().st_mode) == 0o640
    assert path.stat().st_ino != before  # another file took its place: nobody saw it grow


def test_without_force_an_existing_file_stays_even_one_that_came_meanwhile(folder):
    path = folder / "a.txt"
    file = NewFile(path)
    os.write(file.fd, b"mine")
    path.write_text("somebody else's")
    with pytest.raises(FileExistsError):
        file.place()
    file.close()
    assert path.read_text() == "somebody else's"
    with pytest.raises(FileExistsError):
        write_whole(path, "mine")


def test_a_file_system_without_hard_links_is_written_too(folder, monkeypatch):
    def refused(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    write_whole(folder / "a.txt", "whole")
    assert (folder / "a.txt").read_text() == "whole"
    with pytest.raises(FileExistsError):
        write_whole(folder / "a.txt", "another")


def test_the_disk_has_the_file_before_its_name_and_the_folder_after(folder, monkeypatch):
    done, replace = [], Path.replace
    kind = lambda fd: "folder" if stat.S_ISDIR(os.fstat(fd).st_mode) else "file"  # noqa: E731
    monkeypatch.setattr(os, "fsync", lambda fd: done.append(kind(fd)))
    monkeypatch.setattr(Path, "replace", lambda self, target: (done.append("name"), replace(self, target))[1])
    write_whole(folder / "a.txt", "whole", force=True)
    assert done == ["file", "name", "folder"]


def test_a_write_protected_file_is_not_replaced(folder):
    path = folder / "a.txt"
    path.write_text("kept")
    path.chmod(0o444)
    if os.access(path, os.W_OK):
        pytest.skip("this user may write everything")
    with pytest.raises(PermissionError):
        write_whole(path, "new", force=True)


def test_a_folder_that_cannot_be_written_to_is_said_before_any_work(folder, monkeypatch):
    (folder / "there.txt").write_text("kept")
    monkeypatch.setattr(os, "access", lambda path, _mode: path != folder)  # what a read-only medium says
    for path in (folder / "new.txt", folder / "there.txt", folder / "sub" / "new.txt"):
        with pytest.raises(UsageError, match=f"the folder {folder} cannot be written to"):
            check_target(path, force=True, makes_folder=True)
    check_target(Path("/dev/null"), force=True)


FULL = """
import resource, signal, sys
from pathlib import Path
from drivelink.files import write_whole
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (1000, 1000))
try:
    write_whole(Path(sys.argv[1]), b"x" * 5000, force=True)
except OSError as error:
    print(error.filename, error.strerror)
"""
AGAIN = """
import sys
from pathlib import Path
from drivelink.files import write_whole
print("ready", flush=True)
while True:
    for letter in "ab":
        write_whole(Path(sys.argv[1]), letter * 200_000, force=True)
"""


def test_a_full_disk_leaves_what_was_there(folder):
    """The limit of a file's size stands for a full disk: writing fails half-way."""
    path = folder / "a.txt"
    path.write_text("kept")
    done = subprocess.run([sys.executable, "-c", FULL, str(path)], capture_output=True, text=True)
    assert done.stdout == f"{path} {os.strerror(errno.EFBIG)}\n", done.stderr
    assert path.read_text() == "kept"


def test_a_kill_at_any_moment_leaves_the_old_file_or_the_new_one(tmp_path):
    path, rng = tmp_path / "a.txt", np.random.default_rng(1)
    path.write_text("a" * 200_000)
    for _ in range(3):
        with zenohkit.python("-c", AGAIN, path) as process:
            assert process.stdout.readline()
            time.sleep(rng.uniform(0.0, 0.02))
        assert path.read_text() in ("a" * 200_000, "b" * 200_000)


# Recordings grow in their place


def test_a_recording_takes_the_place_of_another_one_with_its_first_block(folder):
    path, joint = folder / "r.csv", parse(JOINT)
    path.write_text("an older recording")
    with pytest.raises(RecordingError, match="File exists"):
        open_sink(path, joint)
    open_sink(folder / "none.csv", joint).abandon()  # never began: it leaves nothing
    open_sink(path, joint, force=True).abandon()
    assert list(folder.iterdir()) == [path] and path.read_text() == "an older recording"
    sink = open_sink(path, joint, force=True)
    for k in range(2):
        sink.sample(Sample(k, (0.0,), (0.0,), (0.0,), 0.0), 0)
        assert k or path.read_text() == "an older recording"
        sink.flush()
        assert path.read_text().startswith("time_s,") and path.read_text().count("\n") == 2 + k
    sink.close()


# The commands


@pytest.fixture
def files(folder, fleet):
    recording, joint = folder / "r.csv", folder / "elbow.toml"
    recording.write_bytes((fleet / "recordings" / "elbow-2026-01-05.csv").read_bytes())
    text = (fleet / "joints" / "elbow.toml").read_text()
    joint.write_text(text.partition("[link.dynamics]")[0] + "# my own remark\n")
    return recording, joint


READ = "{r} --joint {j}"


@pytest.mark.parametrize(
    "command",
    [
        *(f"replay {READ} --out {out}" for out in ("{r}", "{link}", "{hard}", "{j}")),
        *(f"fit {READ} --write {out}" for out in ("{r}", "{link}")),
        f"diagnose {READ} --write {{r}} --out {{d}}",
        f"diagnose {READ} --validate {{v}} --write {{v}} --out {{d}}",
        "record {j} --out {j}",
    ],
)
def test_no_command_replaces_what_it_reads(command, files, capsys):
    recording, joint = files
    names = {name: recording.with_name(name) for name in ("link", "hard", "v", "d")}
    names["link"].symlink_to(recording)
    os.link(recording, names["hard"])
    names["v"].write_bytes(recording.read_bytes())
    before = {path: path.read_bytes() for path in (recording, joint, names["v"])}
    for force in ([], ["--force"]):
        assert cli.main([*command.format(r=recording, j=joint, **names).split(), *force]) == 2
        err = capsys.readouterr().err
        assert "is read here and must not be replaced" in err and err.count("\n") == 1
        assert {path: path.read_bytes() for path in before} == before


@pytest.mark.parametrize(
    "command", [f"replay {READ} --out {{out}}", f"fit {READ} --write {{out}}", "new {out} --case constant"]
)
def test_a_named_file_is_replaced_with_force_only(command, files, capsys):
    recording, joint = files
    out = recording.with_name("out.x")
    out.write_text("kept")
    verb, *rest = command.format(r=recording, j=joint, out=out).split()
    assert cli.main([verb, *rest]) == 2
    assert capsys.readouterr().err == f"drivelink {verb}: {out}: exists already; --force replaces it\n"
    assert out.read_text() == "kept"
    with pytest.raises(UsageError, match="exists already; force=True replaces it"):  # in Python
        check_target(out, [], force=False)
    assert cli.main([verb, *rest, "--force"]) == 0
    assert out.read_text() != "kept"


def test_fit_brings_its_own_joint_file_up_to_date_in_one_step(files, monkeypatch, capsys):
    recording, joint = files
    arguments = ["fit", str(recording), "--joint", str(joint), "--write", str(joint)]
    assert cli.main(arguments) == 2 and "--force replaces it" in capsys.readouterr().err
    before = joint.read_text()

    def killed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(written, "put_in_place", killed)
        assert cli.main([*arguments, "--force"]) == 130
    assert joint.read_text() == before
    out = recording.parent / "fit"  # results: what the last run found
    for more in ([], ["--plots"]):  # and again, from what it wrote
        assert cli.main([*arguments, "--force", "--out", str(out), *more]) == 0
        assert "# my own remark" in joint.read_text()
    assert sorted(path.name for path in out.iterdir()) == ["fit.json", "fit.png"]


def test_a_file_beyond_its_limit_is_not_read(tmp_path):
    (path := tmp_path / "a").write_bytes(bytes(2049))
    assert read_regular(path, 2049) == bytes(2049)
    with pytest.raises(OSError, match="expected at most 2 KiB, got more"):
        read_regular(path, 2048)

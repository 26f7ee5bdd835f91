"""`drivelink replay FILE --joint JOINT`: a recording through the same code as live data."""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path

from drivelink.cli import add_map, add_number, recording_path, warn
from drivelink.files import check_target
from drivelink.jointfile import JointFile
from drivelink.output.progress import Meter
from drivelink.plaintext import clean_text
from drivelink.pubsub.publisher import JointPublisher
from drivelink.pubsub.session import close_session, open_session
from drivelink.recording import read
from drivelink.recording.canframes import is_frame_log
from drivelink.recording.columns import parse_column_map
from drivelink.recording.corrections import Gathered, gate
from drivelink.recording.formats import FORMATS
from drivelink.recording.mapping import joint_of
from drivelink.recording.playback import EstimatesFile, Playback, Played, Publication, Summary, open_playback

Sink = Callable[[Played], None]

_INTERRUPTED = 130
_METER_EVERY = 512
_SUBSCRIBER_S = 1.5

EPILOG = f"""\
formats: {", ".join(FORMATS)}

examples:
  drivelink replay run.csv --joint elbow.toml --out estimates.csv --plots plots/
  drivelink replay run.mcap --publish --speed 1         a recording of drivelink contains its joint file
  drivelink replay candump.log --joint elbow.toml --channel can1
  drivelink replay rig.csv --joint elbow.toml --map t=time_s:ms --map q_link=link_position_rad:deg
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("file", type=recording_path, metavar="FILE", help="the recording")
    parser.add_argument("--joint", type=Path, metavar="JOINT", help="joint file it was made with")
    parser.add_argument("--out", type=Path, metavar="CSV", help="write the estimates, a row for each cycle")
    parser.add_argument("--force", action="store_true", help="replace the CSV of --out if it exists")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="write plots of the estimates")
    parser.add_argument("--publish", action="store_true", help="put samples and estimates on zenoh")
    about = "X times the speed of the recording (default: as fast as it goes)"
    add_number(parser, "--speed", metavar="X", help=about)
    about = "refuse what has wrong units, signs or gears; else only warn"
    parser.add_argument("--strict", action="store_true", help=about)
    about = "of an MCAP file, decode the raw CAN frames, not the samples"
    parser.add_argument("--frames", action="store_true", help=about)
    parser.add_argument("--channel", help="of a raw CAN log with several, the one the joint is on")
    add_map(parser)
    parser.add_argument("--json", action="store_true", help="print the result as one JSON object")


def run(args: argparse.Namespace) -> int:
    """Run the verb; return the exit status."""
    source = joint_of(args.file, args.joint)
    joint, base_dir = source.joint, source.folder
    names = parse_column_map(args.map)
    if args.strict:
        record = read(args.file, joint, base_dir=base_dir, channel=args.channel, names=names)
        gate(args.file, joint, record, strict=True)
    inputs = [args.file, *([args.joint] if args.joint else [])]
    if args.out is not None:
        check_target(args.out, inputs, force=args.force)
    if args.plots is not None:
        check_target(args.plots / "time.png", inputs, force=True, makes_folder=True)
    playback = open_playback(
        args.file, joint, base_dir, frames=True if args.frames else None, channel=args.channel, names=names
    )
    summary = Summary(playback.motors, playback.pipeline.estimator, keep=args.plots is not None)
    begin = time.perf_counter()
    gathered = Gathered(joint, playback.period_s)
    with ExitStack() as stack:
        sinks: list[Sink] = [summary.write, gathered.write]
        if args.out is not None:
            linked = joint.link.dynamics is not None
            estimator = playback.pipeline.estimator
            rows = EstimatesFile(args.out, playback.motors, estimator, linked=linked, force=args.force)
            stack.callback(rows.close)
            sinks.append(rows.write)
        if args.publish or args.speed is not None:
            publication = _publication(args, joint, base_dir, playback, stack)
            sinks.append(publication.write)
        interrupted = _play(playback, sinks, f"replay {args.file.name}")
    took_s = time.perf_counter() - begin
    live = is_frame_log(args.file, True if args.frames else None)
    warnings = [] if args.strict or interrupted else gathered.remarks(live=live)
    _report(args, joint.name, summary, warnings, took_s, interrupted)
    return _INTERRUPTED if interrupted else 0


def _report(
    args: argparse.Namespace,
    joint: str,
    summary: Summary,
    warnings: Sequence[str],
    took_s: float,
    interrupted: bool,
) -> None:
    """Print the result, and draw what is asked for; in this order, as a full disk then loses none."""
    warn(args.file, warnings)

    def plots() -> list[Path]:
        return summary.plot(args.plots, f"{joint}: {args.file.name}") if args.plots and summary.count else []

    if args.json:
        document = {
            "recording": str(args.file),
            "joint": joint,
            **summary.document(),
            "estimates": str(args.out) if args.out else None,
            "plots": [str(path) for path in plots()],
            "warnings": list(warnings),
            "took_s": round(took_s, 3),
            "interrupted": interrupted,
        }
        print(json.dumps(document))
        return
    lines = [f"{args.file}: {summary.text(took_s)}"]
    lines += [f"  not valid in {line}" for line in summary.reasons()]
    if args.out is not None:
        lines.append(f"estimates: {args.out}" + (" (up to the interruption)" if interrupted else ""))
    for line in lines:
        print(clean_text(line))
    for path in plots():
        print(clean_text(f"plot: {path}"))


def _play(playback: Playback, sinks: Sequence[Sink], title: str) -> bool:
    """Write every cycle to the sinks; return whether Ctrl-C ended it."""
    try:
        with Meter(title, playback.total) as meter:
            for count, played in enumerate(playback, 1):
                for write in sinks:
                    write(played)
                if not count % _METER_EVERY:
                    meter.update(count)
    except KeyboardInterrupt:
        return True
    return False


def _publication(
    args: argparse.Namespace, joint: JointFile, base_dir: Path, playback: Playback, stack: ExitStack
) -> Publication:
    """Pacing and, on request, the keys on zenoh; both end with the stack."""
    publisher = None
    if args.publish:
        session = open_session(joint.zenoh, base_dir)
        stack.callback(close_session, session)
        publisher = JointPublisher(session, joint, lossless=args.speed is None)
        stack.callback(publisher.close)
        end = time.monotonic() + _SUBSCRIBER_S
        while not publisher.subscribed and time.monotonic() < end:
            time.sleep(0.01)  # a subscriber that is connecting receives the beginning
    about = {"joint": joint.name, "recording": args.file.name, "period_s": playback.period_s}
    publication = Publication(publisher, args.speed, about)
    stack.callback(publication.close)
    return publication

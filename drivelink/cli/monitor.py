"""`drivelink monitor [JOINT]`: what daemons publish, live in the terminal or in a browser."""

import argparse
import json
import re
import signal
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import zenoh
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.text import Text

from drivelink import jointfile
from drivelink.cli import add_number, add_seconds, handling
from drivelink.errors import UsageError, ZenohError
from drivelink.loop.finding import folder_of
from drivelink.monitor.legend import joints_legend
from drivelink.monitor.statuslines import shape
from drivelink.monitor.terminal import Keys, can_draw, joints_table
from drivelink.monitor.watcher import Watcher
from drivelink.monitor.web import WebView, document
from drivelink.monitor.webaccept import WebAcceptance
from drivelink.monitor.webday import WebDay
from drivelink.plaintext import stamped
from drivelink.pubsub.clientbase import PATIENCE_S
from drivelink.pubsub.session import ENDPOINT, answers, close_session, open_client

_POLL_S = 0.02
_ABSENT_S = 10.0  # without a daemon, until plain lines end
_FRAME_S = 0.1

EPILOG = """\
examples:
  drivelink monitor                    every joint on this machine
  drivelink monitor elbow              one joint, with its curve
  drivelink monitor --web              the same in a browser, with plots
  drivelink monitor elbow.toml --foxglove
  drivelink monitor elbow | tee log    without a terminal: a plain line a second

Without a terminal a line that says nothing new is not repeated, and the command fails where no daemon is
there for 10 s.
"""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.add_argument("joint", nargs="?", metavar="JOINT", help="name of a joint, or its joint file")
    parser.add_argument("--web", action="store_true", help="serve a page with live plots on this machine")
    parser.add_argument(
        "--foxglove", action="store_true", help="serve JOINT's messages to Foxglove Studio and PlotJuggler"
    )
    add_number(
        parser,
        "--port",
        least=0,
        most=65535,
        whole=True,
        default=8765,
        help="port of the page (default %(default)s, 0: any)",
    )
    add_seconds(parser)
    add_number(
        parser, "--every", default=1.0, metavar="S", help="interval of the plain lines (default: %(default)s)"
    )
    parser.add_argument(
        "--allow-accept",
        action="store_true",
        help="with --web and a joint file: the page may accept a finding into it, and undo that",
    )
    add_zenoh(parser)
    parser.add_argument(
        "--json", action="store_true", help="print one JSON object per joint instead of each plain line"
    )


def add_zenoh(parser: argparse.ArgumentParser) -> None:
    """Add where the daemons are."""
    parser.add_argument("--endpoint", help=f"where a daemon or router listens (default {ENDPOINT})")
    parser.add_argument("--config", type=Path, help="zenoh configuration file (JSON5) instead")
    parser.add_argument("--prefix", help='first part of every key (default "drivelink")')


def run(args: argparse.Namespace) -> int:
    """Run the verb; return the exit status."""
    if args.web and args.json:
        raise UsageError("expected either --web or --json")
    acceptance = None
    if args.allow_accept:
        if not args.web or args.joint is None or not _is_file(args.joint):
            raise UsageError("--allow-accept: expected --web and the joint file that may be changed")
        acceptance = WebAcceptance(Path(args.joint))
    if args.foxglove and (args.web or args.json or args.joint is None or not _is_file(args.joint)):
        raise UsageError("--foxglove: expected a joint file, and neither --web nor --json")
    name, endpoint, config, prefix = _where(args)
    end = time.monotonic() + args.seconds if args.seconds else float("inf")
    with ExitStack() as stack:
        session = open_client(endpoint, config)
        stack.callback(close_session, session)
        if args.foxglove:
            _foxglove(session, args, end)
            return 0
        watcher = Watcher(session, prefix, name)
        stack.callback(watcher.close)
        stack.enter_context(suppress(KeyboardInterrupt))
        stack.enter_context(handling(signal.default_int_handler))
        if args.web:
            _serve(watcher, args, end, acceptance)
        elif not args.json and can_draw(console := Console()):
            _show(watcher, console, end, f"{prefix}/{name or '*'} at {config or endpoint}")
        else:
            _print(watcher, end, args, lambda: nobody(prefix, config or endpoint))
    return 0


def _foxglove(session: zenoh.Session, args: argparse.Namespace, end: float) -> None:
    """Serve a joint's messages until the end or Ctrl-C."""
    from drivelink.recording.foxglove import FoxgloveSink
    from drivelink.recording.recorder import Recorder, ZenohTap

    joint = jointfile.load(Path(args.joint))
    sink = FoxgloveSink(joint, args.port)
    with Recorder(sink, []) as recorder, closing(ZenohTap(session, joint, sink)) as tap:
        recorder.taps.append(tap)
        print(f"open a connection to ws://127.0.0.1:{sink.port}   (Ctrl-C ends)", flush=True)
        with suppress(KeyboardInterrupt), handling(signal.default_int_handler):
            recorder.run(lambda: time.monotonic() >= end)


def _where(args: argparse.Namespace) -> tuple[str | None, str, Path | None, str]:
    """Joint, endpoint, configuration and prefix, from options and joint file."""
    name, endpoint, config, prefix = args.joint, ENDPOINT, None, "drivelink"
    if name is not None and _is_file(name):
        source = jointfile.load_text(name)
        name, endpoint, prefix = source.joint.name, source.joint.zenoh.endpoint, source.joint.zenoh.prefix
        config = source.zenoh_config
    return name, args.endpoint or endpoint, args.config or config, args.prefix or prefix


def _is_file(name: str) -> bool:
    """Return whether a joint is named by its file."""
    return name.endswith(".toml") or "/" in name


def _show(watcher: Watcher, console: Console, end: float, where: str) -> None:
    """The view in the terminal, until the end, `q` or Ctrl-C; `?` shows what the lines mean."""
    begin = time.monotonic()
    helping = False
    with Keys() as keys, Live(console=console, screen=True, auto_refresh=False, transient=True) as live:
        while time.monotonic() < end:
            frame_end = time.monotonic() + _FRAME_S
            while (left := frame_end - time.monotonic()) > 0:
                watcher.poll()
                for key in keys.pressed():
                    if key in "qQ":
                        return
                    helping = helping != (key in "?hH")
                time.sleep(max(0.0, min(_POLL_S, left)))
            live.update(_picture(watcher, console, where, time.monotonic() - begin, helping), refresh=True)


def _picture(
    watcher: Watcher, console: Console, where: str, waited_s: float, helping: bool = False
) -> RenderableType:
    views = watcher.views
    if not views or not any(view.history.latest for view in views.values()):
        hint = "".join(f"\n\n{view.hint}" for view in views.values())
        if not views and waited_s > PATIENCE_S:
            hint = "\n\nIs a daemon running?   drivelink run JOINT   or   drivelink demo"
        return Text(f"waiting for {where} …{hint}\n\nq ends", style="dim")
    for view in views.values():
        view.help, view.footer = helping, f"? {'back' if helping else 'legend'} · q ends"
    if len(views) == 1:
        return next(iter(views.values()))
    if helping:
        return Group(joints_legend(), Text("\n? back · q ends", style="dim"))
    wrong = {name: shape(view.status or {}).look_here for name, view in views.items() if view.live}
    alarms = [Text(f"{name}: {text}", "bold red", no_wrap=True, overflow="ellipsis")
              for name, text in wrong.items() if text][: console.size.height // 3]  # fmt: skip
    footer = Text(
        "± is half the 95 % interval · drivelink monitor NAME: one joint with its curves · ? legend · q ends"
    )
    footer.stylize("dim")
    room = max(1, console.size.height - len(alarms) - 5)
    shown = views if len(views) <= room else dict(sorted(views.items(), key=lambda v: v[1].well)[:room])
    more = len(views) - len(shown)
    rest = Text(
        f"and {more} more: a higher terminal shows them; what needs a look comes first" if more else ""
    )
    return Group(joints_table(shown, console.size.width), rest, *alarms, footer)


def nobody(prefix: str, where: Path | str) -> str:
    """Say that no daemon is there, or not even who would know of one."""
    if isinstance(where, str) and re.match(r"(?:tcp|tls)/", where) and not answers(where):
        return f"nothing answers at {where}: drivelink run JOINT starts a daemon; or a router is missing"
    of = "" if prefix == "drivelink" else f" of prefix {prefix!r}"
    return f"no joint{of} at {where}: drivelink run JOINT starts a daemon"


def _print(watcher: Watcher, end: float, args: argparse.Namespace, absent: Callable[[], str]) -> None:
    """Print a line or JSON object per joint at each interval; a line only if it says something new.

    Raises:
        ZenohError: no daemon is there, for a while or in all the time that was asked for.
    """
    there, seen = time.monotonic(), False
    due, said = there + args.every, {"": ""}
    while (now := time.monotonic()) < end:
        watcher.poll()
        if watcher.alive:
            there, seen = now, True
        elif now - there > _ABSENT_S:
            seen = False
            break
        if now >= due:
            due += args.every
            views = list(watcher.views.items())
            for name, view in views:
                if args.json:
                    print(json.dumps(document(view), allow_nan=False), flush=True)
                elif (line := view.line()) != said.get(name):
                    print(stamped(line, sys.stdout), flush=True)
                    said[name] = line
            if not views and not args.json and "" in said:
                print("no joint yet", flush=True)
                said.clear()
        time.sleep(_POLL_S)
    if not seen:
        hint = next((view.hint for view in watcher.views.values() if view.hint), "") or absent()
        raise ZenohError(f"{hint} (waited {now - there:.0f} s)")


def _serve(watcher: Watcher, args: argparse.Namespace, end: float, acceptance: WebAcceptance | None) -> None:
    """Serve the page until the end or Ctrl-C."""
    day = None
    if args.joint is not None and _is_file(args.joint):
        source = jointfile.load_text(Path(args.joint))
        if source.joint.recording.folder is not None:
            day = WebDay(folder_of(source), source.joint.name)
    web = WebView(watcher, args.port, acceptance, day)
    print(f"live view: {web.url}   (Ctrl-C ends)", flush=True)
    try:
        while time.monotonic() < end:
            web.poll()
            time.sleep(_POLL_S)
    finally:
        web.close()

"""Draws every picture of the documentation anew, from the programs themselves: `python docs/pictures.py`.

Takes some minutes and needs Chromium. `--only demo web` draws some of them.
"""

import argparse
import fcntl
import io
import json
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pyte
from rich.console import Console
from rich.style import Style
from rich.text import Text

ROOT = Path(__file__).parent.parent
PICTURES = ROOT / "docs" / "pictures"
sys.path.insert(0, str(ROOT / "tests"))

from chromium import EXECUTABLE, Chromium  # noqa: E402

COLUMNS, LINES = 80, 24
BEGIN_S = 120.0  # until a program shows what is to be drawn, on any machine
PAUSE_S = 0.03  # without output: a view that draws ten times a second has drawn it whole
DRIVELINK = (sys.executable, "-m", "drivelink")
# rich's own template, without the web fonts it loads from another host.
SVG = """\
<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}">
<style>
.{unique_id}-matrix {{ font-family: ui-monospace, Menlo, Consolas, "DejaVu Sans Mono", monospace;
  font-size: {char_height}px; line-height: {line_height}px }}
.{unique_id}-title {{ font-size: 18px; font-weight: bold; font-family: system-ui, sans-serif }}
{styles}
</style>
<defs><clipPath id="{unique_id}-clip-terminal">
<rect x="0" y="0" width="{terminal_width}" height="{terminal_height}"/></clipPath>{lines}</defs>
{chrome}
<g transform="translate({terminal_x}, {terminal_y})" clip-path="url(#{unique_id}-clip-terminal)">
{backgrounds}<g class="{unique_id}-matrix">{matrix}</g></g>
</svg>
"""


def terminal(
    command: tuple[str, ...],
    seconds: float,
    title: str,
    path: Path,
    *,
    shows: str,
    columns: int = COLUMNS,
    lines: int = LINES,
    interrupt: bool = True,
) -> str:
    """Run a command in a terminal, and draw what it shows so many seconds after it shows a word.

    Return what it leaves there, at its own end or after Ctrl-C.
    """
    screen = pyte.Screen(columns, lines)
    stream = pyte.ByteStream(screen)
    master, slave = pty.openpty()
    fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
    environment = {k: v for k, v in os.environ.items() if k not in ("NO_COLOR", "COLORTERM", "CI")}
    environment |= {"TERM": "xterm-256color"}
    process = subprocess.Popen(
        command, stdin=slave, stdout=slave, stderr=subprocess.DEVNULL, env=environment, start_new_session=True
    )
    os.close(slave)
    begun, end = False, time.monotonic() + BEGIN_S
    while (left := end - time.monotonic()) > 0 or select.select([master], [], [], PAUSE_S)[0]:
        if select.select([master], [], [], max(left, 0.0))[0]:
            try:
                stream.feed(os.read(master, 65536))
            except OSError:  # it has ended
                break
        if not begun and any(shows in row for row in screen.display):
            begun, end = True, time.monotonic() + seconds
    text = picture(screen)
    if interrupt or not begun:
        process.send_signal(signal.SIGINT)
    while process.poll() is None or select.select([master], [], [], 0.0)[0]:
        if select.select([master], [], [], 0.2)[0]:
            try:
                stream.feed(os.read(master, 65536))
            except OSError:  # the other end is closed
                break
    process.wait(timeout=30)
    os.close(master)
    if not begun:
        raise SystemExit(f"{title}: expected it to show {shows!r}; is another daemon of this joint running?")
    console = Console(record=True, width=columns, file=io.StringIO(), force_terminal=True)
    console.print(text, end="")
    path.write_text(console.export_svg(title=title, code_format=SVG, unique_id=path.stem), encoding="utf-8")
    return "\n".join(row.rstrip() for row in screen.display).strip("\n")


def picture(screen: pyte.Screen) -> Text:
    """What a terminal shows, without its empty last lines."""
    text = Text()
    used = [k for k in range(screen.lines) if any(c.data.strip() for c in screen.buffer[k].values())]
    for row in range(max(used, default=0) + 1):
        for column in range(screen.columns):
            char = screen.buffer[row][column]
            text.append(char.data, Style(color=colour(char.fg), bold=char.bold, reverse=char.reverse))
        text.append("\n")
    return text


def colour(name: str) -> str | None:
    """A colour of pyte's by its name in rich."""
    if name == "default":
        return None
    if re.fullmatch("[0-9a-f]{6}", name):
        return f"#{name}"
    name = name.replace("brown", "yellow")
    return re.sub("^bright", "bright_", name)


@contextmanager
def running(*arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A command of drivelink beside this one."""
    process = subprocess.Popen([*DRIVELINK, *arguments], stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=30)


def pages(url: str, name: str, below: str, wait_s: float = 1.0) -> None:
    """A page in light and in dark mode, from its top to the end of the element that `below` selects."""
    with tempfile.TemporaryDirectory() as profile, Chromium(Path(profile)) as browser:
        browser.resize(1200, 900)
        browser.open(url)
        browser.evaluate("document.documentElement.style.scrollbarWidth = 'none'")
        time.sleep(wait_s)
        end = f"document.querySelector({json.dumps(below)}).getBoundingClientRect().bottom"
        browser.resize(1200, round(browser.evaluate(end)) + 16)
        for dark in (False, True):
            browser.prefer(dark=dark)
            time.sleep(1.0)
            browser.screenshot(PICTURES / f"{name}{'-dark' if dark else ''}.png")


def demo(_: Path) -> None:
    """`drivelink demo` in a terminal, and in README how the same run ends."""
    path, title = PICTURES / "demo.svg", "drivelink demo"
    said = terminal((*DRIVELINK, "demo"), 7.0, title, path, shows="observable", interrupt=False)
    readme = ROOT / "README.md"
    begin, _, rest = readme.read_text(encoding="utf-8").partition("```text\n")
    readme.write_text(f"{begin}```text\n{said}\n```{rest.partition('```')[2]}", encoding="utf-8")


def closed(_: Path) -> None:
    """`drivelink demo --case friction` in a terminal, at its end."""
    command = (*DRIVELINK, "demo", "--case", "friction", "--yes")
    title = "drivelink demo --case friction"
    terminal(command, 120.0, title, PICTURES / "loop.svg", shows="stiffness", columns=110, lines=64)


def views(_: Path) -> None:
    """`drivelink monitor` in the terminal and in the browser, beside a demo."""
    with (
        running("demo", "--seconds", "300", "--headless"),
        running("monitor", "vsa-ii", "--web", "--port", "0") as web,
    ):
        assert web.stdout is not None
        address = re.search(r"http://\S+", web.stdout.readline())
        assert address is not None
        command = (*DRIVELINK, "monitor", "vsa-ii")
        terminal(command, 25.0, "drivelink monitor vsa-ii", PICTURES / "monitor.svg", shows="observable")
        pages(address[0], "web", "section:has(#stiffnessplot)", wait_s=35.0)


def loop(folder: Path) -> None:
    """What `fit` and `diagnose` draw, from the example that closes the loop."""
    script = ROOT / "examples" / "close_the_loop.py"
    subprocess.run([sys.executable, str(script), str(folder)], check=True, stdout=subprocess.DEVNULL)
    (PICTURES / "fit.png").write_bytes((folder / "fit.png").read_bytes())
    pages(f"file://{folder}/report.html", "report", "figure")


DRAWN: dict[str, Callable[[Path], None]] = {"demo": demo, "closed": closed, "views": views, "loop": loop}


def main() -> None:
    """Draw all, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=DRAWN, default=list(DRAWN), help="these only")
    if EXECUTABLE is None:
        raise SystemExit("docs/pictures.py: expected Chromium on the PATH: apt install chromium")
    PICTURES.mkdir(exist_ok=True)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job would ignore Ctrl-C
    with tempfile.TemporaryDirectory() as folder:
        for name in parser.parse_args().only:
            print(f"{name} …", flush=True)
            DRAWN[name](Path(folder))


if __name__ == "__main__":
    main()

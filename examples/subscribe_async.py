"""Several joints in one asyncio program: one task a joint, and the daemon's own status beside it.

python examples/subscribe_async.py [JOINT,JOINT… [ENDPOINT [SECONDS]]]
"""

import asyncio
import signal
import sys

import drivelink
from drivelink.errors import DrivelinkError


async def follow(joint: str, endpoint: str) -> None:
    async with drivelink.subscribe_async(joint, endpoint=endpoint) as subscription:
        async for estimate in subscription.cycles(timeout_s=0.5):
            if estimate is None:
                print(f"{joint}: nothing for half a second, the daemon is {subscription.state}")
            elif estimate.sequence % 500 == 0:
                state = (subscription.status or {}).get("state")
                print(f"{joint}: cycle {estimate.sequence}, {estimate.stiffness_nm_rad:.4g} N·m/rad, {state}")


async def main(joints: str = "elbow", endpoint: str = "tcp/127.0.0.1:7447", seconds: str = "10") -> None:
    tasks = [asyncio.create_task(follow(joint, endpoint)) for joint in joints.split(",")]
    ended, running = await asyncio.wait(tasks, timeout=float(seconds), return_when=asyncio.FIRST_EXCEPTION)
    for task in running:
        task.cancel()
    await asyncio.gather(*running, return_exceptions=True)
    for task in ended:
        task.result()  # raises what ended it


if __name__ == "__main__":
    if {"-h", "--help"} & set(sys.argv):
        sys.exit(print(__doc__))
    sys.stdout.reconfigure(line_buffering=True)  # a pipe or a file has every line, however it ends
    for ending in (signal.SIGINT, signal.SIGPIPE):  # Ctrl-C and `| head` end it without a traceback
        signal.signal(ending, signal.SIG_DFL)
    try:
        asyncio.run(main(*sys.argv[1:]))
    except (DrivelinkError, ValueError) as error:
        sys.exit(f"{error}\n{__doc__}")

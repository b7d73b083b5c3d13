# SPDX-License-Identifier: Apache-2.0
"""The process of one matcher: shut in first, then the plugin is imported; it answers one query after the other."""

import os
import socket
import sys
from typing import Any

from sasgeo_bench.run import sandbox, wire


def main() -> None:
    """Serve the runner at the other end of the socket whose number is the only argument."""
    channel = socket.socket(fileno=int(sys.argv[1]))
    start, _ = wire.receive(channel)
    policy = start["policy"]
    isolation = sandbox.enter(sandbox.Policy(**policy)) if policy else None
    os.chdir(start["scratch"])
    sys.path[:] = dict.fromkeys((*start["paths"], *sys.path))
    said = isolation.to_dict() if isolation else {}
    wire.send(channel, {"kind": "shut in", "isolation": said, "pid": os.getpid()})
    _serve(channel, start)


def _serve(channel: socket.socket, start: dict[str, Any]) -> None:
    """Load the plugin and answer; numpy and all that brings threads is imported from here on."""
    from sasgeo_bench.run.serve import Server  # noqa: PLC0415

    Server(channel, spec=start["spec"]).run()


if __name__ == "__main__":
    main()

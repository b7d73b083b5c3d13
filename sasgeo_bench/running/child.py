# SPDX-License-Identifier: Apache-2.0
"""The process of one plugin, shut in already: the plugin is imported, and answers one question after the other."""

import gc
import os
import socket
import sys
from typing import Any

from sasgeo_bench.running import wire


def main() -> None:
    """Serve the runner at the other end of the socket whose number is the only argument."""
    gc.disable()  # until our own is imported, of which nothing is garbage: an eighth of what a process takes to start
    channel = socket.socket(fileno=int(sys.argv[1]))
    start, luggage = wire.receive(channel)
    os.chdir(start["scratch"])
    sys.path[:] = dict.fromkeys((*start["paths"], *sys.path))
    _serve(channel, start, luggage if start["has_luggage"] else None)


def _serve(channel: socket.socket, start: dict[str, Any], luggage: bytes | None) -> None:
    """Load the plugin and answer; what is imported from here on comes from the runner's import path."""
    if start["door"] == "segmenter":
        from sasgeo_bench.running.serve_segmenter import SegmenterServer  # noqa: PLC0415

        gc.enable()
        SegmenterServer(channel, spec=start["spec"], luggage=luggage).run()
        return
    from sasgeo_bench.running.serve import Server  # noqa: PLC0415

    gc.enable()
    Server(channel, spec=start["spec"]).run()


if __name__ == "__main__":
    main()

# SPDX-License-Identifier: Apache-2.0
"""The process of one plugin, shut in already: the plugin is imported, and answers one question after the other."""

import gc
import os
import socket
import sys

from sasgeo_bench.running import wire


def main() -> None:
    """Serve the runner at the other end of the socket whose number is the only argument."""
    gc.disable()  # until our own is imported, of which nothing is garbage: an eighth of what a process takes to start
    channel = socket.socket(fileno=int(sys.argv[1]))
    start, luggage = wire.receive(channel)
    serve(channel, luggage, **start)


def serve(
    channel: socket.socket, luggage: bytes, *, door: str, spec: str, scratch: str, paths: list[str], has_luggage: bool
) -> None:
    """Load the plugin and answer; what is imported from here on comes from the runner's import path."""
    os.chdir(scratch)
    sys.path[:] = dict.fromkeys((*paths, *sys.path))
    if door == "segmenter":
        from sasgeo_bench.running.serve_segmenter import SegmenterServer  # noqa: PLC0415

        gc.enable()
        SegmenterServer(channel, spec=spec, luggage=luggage if has_luggage else None).run()
        return
    from sasgeo_bench.running.serve import Server  # noqa: PLC0415

    gc.enable()
    Server(channel, spec=spec).run()


if __name__ == "__main__":
    main()

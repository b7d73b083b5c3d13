# SPDX-License-Identifier: Apache-2.0
"""The process of one plugin, shut in already: the plugin is imported, and answers one question after the other."""

import gc
import os
import socket
import sys
from importlib import import_module
from importlib.util import LazyLoader, find_spec, module_from_spec

from sasgeo_bench.running import wire
from sasgeo_bench.running.channel import far_end


def main() -> None:
    """Serve the runner at the other end of the socket that the only argument names."""
    gc.disable()  # until our own is imported, of which nothing is garbage: an eighth of what a process takes to start
    channel = far_end(sys.argv[1])
    start, luggage = wire.receive(channel)
    serve(channel, luggage, **start)


def serve(channel: socket.socket, luggage: bytes, *, door: str, spec: str, scratch: str, paths: list[str]) -> None:
    """Load the plugin and answer; what is imported from here on comes from the runner's import path."""
    # SciPy takes all names of NumPy, and with them a compiler of Fortran and a library of tests: 60 ms of each start.
    _import_when_used("numpy", "f2py", "testing")
    os.chdir(scratch)
    sys.path[:] = dict.fromkeys((*paths, *sys.path))
    server = import_module(f"sasgeo_bench.running.{'serve_segmenter' if door == 'segmenter' else 'serve'}").Server
    gc.enable()
    server(channel, spec=spec, luggage=luggage).run()


def _import_when_used(package: str, *names: str) -> None:
    """Let modules of a package be imported when something in them is asked for, and not before."""
    parent = import_module(package)
    for name in names:
        spec = find_spec(f"{package}.{name}")
        if spec is not None and spec.loader is not None and spec.name not in sys.modules:
            spec.loader = LazyLoader(spec.loader)
            module = sys.modules[spec.name] = module_from_spec(spec)
            spec.loader.exec_module(module)
            setattr(parent, name, module)


if __name__ == "__main__":
    main()

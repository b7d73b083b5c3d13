# SPDX-License-Identifier: Apache-2.0
"""Shut a process in, then start the program that answers within: nothing of the old one can be reached from there."""

import os
import socket
import sys
from typing import Final

from sasgeo_bench.running import sandbox, wire

# Run by a bare interpreter, which finds only the standard library: it starts fast, and reads no file of the user's.
PROGRAM: Final = "import sys; sys.path.append(sys.argv.pop(1)); from sasgeo_bench.running.launch import main; main()"


def main() -> None:
    """Enter under the policy that comes through the socket whose number is the last argument, and start Python anew."""
    channel = socket.socket(fileno=int(sys.argv[-1]))
    policy, _ = wire.receive(channel)
    isolation = sandbox.enter(sandbox.Policy(**policy))
    wire.send(channel, {"kind": "shut in", "isolation": isolation.to_dict()})
    os.execv(sys.executable, [sys.executable, *sys.argv[1:]])  # noqa: S606 - our own module, by our own interpreter

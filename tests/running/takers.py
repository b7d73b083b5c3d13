# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: ARG001, PTH123, SIM115 - programs that take what they can, run by a test in a process that is shut in
"""Matchers' processes that take too much, or leave somebody behind; they know no map and answer no query."""

import fcntl
import mmap
import os
import socket
import sys
import time

from sasgeo_bench.running import wire

TAKEN = 400 * 2**20  # the tests allow 300 MB
CHUNK = b"x" * 2**22
HELD = []


def fill(file, count=TAKEN):
    """Write so many bytes, bit by bit."""
    for _ in range(0, count, len(CHUNK)):
        file.write(CHUNK)
    file.flush()
    HELD.append(file)


def answer(channel, words):
    """Answer what was asked first."""
    wire.send(channel, {"status": "refused", "message": words, "nonce": ASKED.get("nonce")})


def sleep():
    """Wait for the end."""
    while True:
        time.sleep(1000)


def holds(channel):
    HELD.append(CHUNK * (TAKEN // len(CHUNK)))
    sleep()


def dribbles(channel):
    """Begin an answer, and hold the memory while the rest of it comes byte by byte."""
    channel.sendall((10**6).to_bytes(4, "big") + bytes(4))
    HELD.append(CHUNK * (TAKEN // len(CHUNK)))
    while True:
        channel.sendall(b" ")
        time.sleep(0.01)


def memory_file(channel):
    fill(os.fdopen(os.memfd_create("hidden"), "wb"))
    sleep()


def shared_mapping(channel):
    fill(mmap.mmap(-1, TAKEN))
    sleep()


def scratch(channel):
    for at in range(10):
        fill(open(f"taken-{at}", "wb"), TAKEN // 10)
        HELD.pop().close()
    sleep()


def children(channel):
    """No process of them takes too much, all together do."""
    for _ in range(5):
        if os.fork() == 0:
            HELD.append(CHUNK * (TAKEN // 5 // len(CHUNK)))
            sleep()
    sleep()


def shares(channel):
    """Less than is allowed, seen by five processes, in memory of their own and in a file in memory."""
    HELD.append(CHUNK * 25)
    file = os.memfd_create("open")
    os.truncate(file, 50 * 2**20)
    view = mmap.mmap(file, 50 * 2**20)
    for at in range(0, len(view), 4096):
        view[at] = 1
    for _ in range(4):
        ready, tell = os.pipe()
        if os.fork() == 0:
            sum(view[::4096])
            os.write(tell, b"x")
            sleep()
        os.read(ready, 1)
    answer(channel, "ready")
    sleep()


def daemon(channel, lock):
    """Leave somebody behind who has no parent and no session of ours, and holds a lock."""
    ready, tell = os.pipe()
    if os.fork() == 0:
        os.setsid()
        if os.fork() == 0:
            channel.close()
            fcntl.flock(os.open(lock, os.O_RDONLY), fcntl.LOCK_SH)
            os.write(tell, b"x")
            sleep()
        os._exit(0)
    os.wait()
    os.read(ready, 1)
    answer(channel, "ready")
    sleep()


def forks(channel):
    """As many processes as it gets, a hundred at most."""
    count = 0
    try:
        for _ in range(100):
            if os.fork() == 0:
                sleep()
            count += 1
    except OSError:
        pass
    answer(channel, str(count))
    sleep()


if __name__ == "__main__":
    link = socket.socket(fileno=int(sys.argv[-1]))
    start, _ = wire.receive(link)
    os.chdir(start["scratch"])
    ASKED, _ = wire.receive(link)
    name, *arguments = start["spec"].split()
    globals()[name](link, *arguments)

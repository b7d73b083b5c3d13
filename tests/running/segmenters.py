# SPDX-License-Identifier: Apache-2.0
# ruff: noqa: ARG002 - the door has its arguments
"""Segmenters, good, faulty and hostile; each is run by a test, none is installed."""

import json
import os
import signal
import socket
import sys
import time
from pathlib import Path

import numpy as np

from sasgeo_bench.matching.segmenter import SegmenterCard
from sasgeo_bench.sensing.segmentation import Segmentation

SAID = {"version": "1", "title": "Test", "source": "original", "ours": "all", "licence": "Apache-2.0"}


class Good:
    """Tells roofs by red, silent where a picture is dark."""

    card = SegmenterCard(name="good", classes=("building", "green"), **SAID)

    def segment(self, image, *, learned):
        red, green, _ = np.moveaxis(image.rgb.astype(np.float64), 2, 0)
        total = np.maximum(image.rgb.sum(axis=2), 1)
        found = np.stack([red / total, green / total])
        found[:, total < 90] = np.nan
        return Segmentation.of_probabilities(self.card.classes, found)


class Learns(Good):
    """Learns the mean red of roofs."""

    card = SegmenterCard(name="learns", **SAID)

    def learn(self, training):
        at = training.classes.index("building")
        shades = [each.image.rgb[each.labels[at] == 1].mean(axis=0).tolist() for each in training.images]
        return json.dumps(
            {"shade": np.mean(shades, axis=0).tolist(), "places": sorted({x.place for x in training.images})}
        )

    def segment(self, image, *, learned):
        shade = [150.0, 90.0, 80.0] if learned is None else json.loads(learned)["shade"]
        away = np.abs(image.rgb - np.array(shade)).max(axis=2)
        return Segmentation.of_probabilities(("building",), np.exp(-away / 20)[None])


class CountsLabels(Learns):
    """Learns how many labelled images it can read beside those that it was given."""

    def learn(self, training):
        given, count = {str(path) for path in training.images.paths}, 0
        for path in filter(None, sys.path[:2]):
            for file in Path(path).rglob("*.labelled"):
                try:
                    count += bool(file.read_bytes()) and str(file) not in given
                except OSError:
                    continue
        return f"{count} beside {len(given)}"


class NeedsTraining(Learns):
    card = SegmenterCard(name="needs-training", needs=("training",), **SAID)

    def segment(self, image, *, learned):
        json.loads(learned)
        return super().segment(image, learned=learned)


class NeedsWhatItCannotLearn(Good):
    card = SegmenterCard(name="needs-more", needs=("training",), **SAID)


class CannotWithout(NeedsTraining):
    card = SegmenterCard(name="cannot-without", **SAID)


class LearnsNothing(Learns):
    def learn(self, training):
        raise ValueError("too few roofs")


class LearnsTooMuch(Learns):
    def learn(self, training):
        return "x" * (2**25 + 1)


class Forgets(Learns):
    def learn(self, training):
        return 7


class Fickle(Good):
    def __init__(self):
        self.asked = 0

    def segment(self, image, *, learned):
        self.asked += 1
        return super().segment(image, learned=None).with_shares({"building": 0.1 * (1 + self.asked % 2)})


class LooksBack(Good):
    """Remembers the brightness of the picture before, not of the same one."""

    def __init__(self):
        self.last = self.before = None

    def segment(self, image, *, learned):
        key = image.rgb.tobytes()
        if key != self.last:
            self.before, self.last = self.last, key
        share = 0.3 if self.before is None else 0.36
        return super().segment(image, learned=None).with_shares({"building": share})


class SeesTheFrame(Good):
    """Takes the upper half of every picture for roofs."""

    def segment(self, image, *, learned):
        rows, cols = image.shape
        upper = np.repeat(np.arange(rows)[:, None] < rows / 2, cols, axis=1)
        return Segmentation.of_probabilities(self.card.classes, np.stack([upper, ~upper]).astype(float))


class OtherClasses(Good):
    def segment(self, image, *, learned):
        found = super().segment(image, learned=None)
        at = int(image.rgb.sum()) % 2
        return Segmentation(classes=(self.card.classes[at],), probability_bytes=found.probability_bytes[at : at + 1])


class WantsRoom(Good):
    def segment(self, image, *, learned):
        if min(image.shape) < 8:
            raise ValueError("the picture is smaller than the filter")
        return super().segment(image, learned=None)


class WrongShape(Good):
    def segment(self, image, *, learned):
        return Segmentation(classes=("building",), probability_bytes=np.zeros((1, 4, 4), dtype=np.uint8))


class UnknownClass(Good):
    card = SegmenterCard(name="unknown-class", **SAID)

    def segment(self, image, *, learned):
        return Segmentation(classes=("volcano",), probability_bytes=np.zeros((1, *image.shape), dtype=np.uint8))


class NotOnItsCard(Good):
    def segment(self, image, *, learned):
        return Segmentation(classes=("water",), probability_bytes=np.zeros((1, *image.shape), dtype=np.uint8))


class ReturnsAnArray(Good):
    def segment(self, image, *, learned):
        return np.zeros((1, *image.shape))


class PaintsOver(Good):
    """Paints on the picture that it was given, whose lock it opens."""

    def segment(self, image, *, learned):
        found = super().segment(image, learned=None)
        own = np.lib.stride_tricks.as_strided(image.rgb, writeable=False)
        address, _ = own.__array_interface__["data"]
        import ctypes  # noqa: PLC0415

        ctypes.memset(address, 7, image.rgb.size)
        return found


class SaysNothing(Good):
    def segment(self, image, *, learned):
        return Segmentation(classes=("building",), probability_bytes=np.full((1, *image.shape), 255, dtype=np.uint8))


class Hangs(Good):
    def segment(self, image, *, learned):
        time.sleep(1000)


class Exits(Good):
    """Leaves its process at dark pictures."""

    def segment(self, image, *, learned):
        if image.rgb.mean() < 20:
            print("last words")  # noqa: T201
            sys.stdout.flush()
            os._exit(3)
        return super().segment(image, learned=None)


class Segfaults(Good):
    def segment(self, image, *, learned):
        os.kill(os.getpid(), signal.SIGSEGV)
        time.sleep(5)


class Connects(Good):
    def segment(self, image, *, learned):
        with socket.socket() as link:
            link.settimeout(1)
            link.connect(("192.0.2.1", 80))
        return super().segment(image, learned=None)


class LooksForLabels(Good):
    """Says by its bytes how many labelled images it can read beside its code and below the working folder."""

    def segment(self, image, *, learned):
        count = 0
        for path in filter(None, sys.path[:2]):
            for file in Path(path).rglob("*.labelled"):
                try:
                    count += bool(file.read_bytes())
                except OSError:
                    continue
        found = np.full((1, *image.shape), count, dtype=np.uint8)
        return Segmentation(classes=("building",), probability_bytes=found)


def write_past_the_server(content, data):
    """Answer the question that was asked last in place of the server."""
    frame = sys._getframe()
    while not (isinstance(frame.f_locals.get("message"), dict) and "self" in frame.f_locals):
        frame = frame.f_back
    text = json.dumps(content | {"nonce": frame.f_locals["message"]["nonce"]}).encode()
    head = len(text).to_bytes(4, "big") + len(data).to_bytes(4, "big")
    frame.f_locals["self"].channel.sendall(head + text + data)
    time.sleep(1000)


OK = {"status": "ok", "seconds": 0.1, "cpu_s": 0.1}


class AnswersGarbage(Good):
    def segment(self, image, *, learned):
        write_past_the_server(OK, b"garbage" * 9)


class AnswersAnotherShape(Good):
    def segment(self, image, *, learned):
        found = Segmentation(classes=("building",), probability_bytes=np.zeros((1, 2000, 2000), dtype=np.uint8))
        write_past_the_server(OK, found.to_bytes())


class AnswersAnotherClass(Good):
    def segment(self, image, *, learned):
        found = Segmentation(classes=("volcano",), probability_bytes=np.zeros((1, *image.shape), dtype=np.uint8))
        write_past_the_server(OK, found.to_bytes())


class AnswersWithoutEnd(Good):
    def segment(self, image, *, learned):
        write_past_the_server(OK, bytes(2 * 10**7))


class NoCard(Good):
    card = None


class NoVerb:
    card = Good.card


class Imitates(Good):
    card = SegmenterCard(name="oracle_segmenter", **SAID)

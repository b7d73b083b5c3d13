# SPDX-License-Identifier: Apache-2.0
"""Description of a submission: the card that its author writes, and `submission.json`."""

from collections.abc import Mapping
from typing import Annotated, Final

from pydantic import BeforeValidator, Field, field_validator

from sasgeo_bench.core.config import Document, Line, Short
from sasgeo_bench.core.texts import FOLDER, NAME, VERSION
from sasgeo_bench.matching.matcher import Need
from sasgeo_bench.tasks.query import Track
from sasgeo_bench.tasks.split import HALVES, Half

SCHEMA_VERSION: Final = 1
NEWER: Final = "install a sasgeo-bench that knows it"
API: Final = 1  # version of the doors: what a plugin of it is given, and answers, stays as it is
NONE: Final = "none"  # `trained_on` of a method that was not trained on any place of the split
MOST_PLACES: Final = 1000
_SHORT: Final = 60  # characters

_EXAMPLE_BY_HALF: Final = '{ a = ["munich"], b = ["porto"] }'


def _trained(given: object) -> object:
    """Refuse anything but "none", a list of places, or a list for each half."""
    lists = list(given.values()) if isinstance(given, Mapping) and set(given) == set(HALVES) else [given]
    is_sound = all(
        isinstance(item, list) and len(item) <= MOST_PLACES and all(isinstance(name, str) for name in item)
        for item in lists
    )
    if given != NONE and (not is_sound or given == []):
        raise ValueError(
            f'trained_on must be "{NONE}", places of the split as in ["porto"], or for each half of a cross-fit the '
            f"training places of the answers about it, as in {_EXAMPLE_BY_HALF}; got {repr(given)[:_SHORT]}"
        )
    return given


Name = Annotated[str, Field(pattern=NAME)]
Version = Annotated[str, Field(pattern=VERSION)]
Identifier = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,99}$")]  # of a board or a split
Folder = Annotated[str, Field(pattern=FOLDER)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Count = Annotated[int, Field(ge=0)]
Address = Annotated[str, Field(pattern=r"^https://[A-Za-z0-9][A-Za-z0-9.:/_~%?=&#@+-]{0,250}$")]
TrainedOn = Annotated[str | list[str] | dict[str, list[str]], BeforeValidator(_trained)]


class Card(Document):
    """Author's description of a method: `card.toml`, and shown on the board as text.

    A class has the same fields as its `MatcherCard`, by `cards.read_card`, and needs `tracks`. `trained_on` is
    "none", or places of the split; by halves, "a" lists the training places of the answers about half a.
    `trained_elsewhere` describes other training in a line. `api` is the version of the doors that it was written for.
    `uses` lists inputs besides the query and the map, as in
    "imagery"; `authors`, `contact` and `code` name the authors, a way to reach them, and the address of the code.
    """

    api: Annotated[int, Field(exclude=True)] = API  # stands in no submission and no board: it is of the file alone
    name: Name
    version: Version
    title: Line
    source: Line
    ours: Line
    licence: Short
    trained_on: TrainedOn
    trained_elsewhere: Line | None = None
    tracks: list[Track] = []
    needs: list[Need] = []
    uses: Annotated[list[Short], Field(max_length=20)] = []
    limits: Line | None = None
    authors: Annotated[list[Short], Field(max_length=100)] = []
    contact: Line | None = None
    code: Address | None = None

    @field_validator("api")
    @classmethod
    def _known_api(cls, api: int) -> int:
        if api != API:
            raise ValueError(f"api must be {API}, got {api}: {NEWER}")
        return api

    @property
    def is_by_half(self) -> bool:
        """True if the two halves of a cross-fit were answered after different training."""
        return isinstance(self.trained_on, dict)

    @property
    def places(self) -> tuple[str, ...]:
        """Names of all training places."""
        return tuple(sorted({place for half in HALVES for place in self.taught(half)}))

    def taught(self, half: Half | None) -> tuple[str, ...]:
        """Return the training places of the answers about a half; of None, where a split has no halves, all of them."""
        given = self.trained_on
        if isinstance(given, dict):
            return self.places if half is None else tuple(given[half])
        return tuple(given) if isinstance(given, list) else ()


class SubmittedFile(Document):
    """Hash and size of a file."""

    sha256: Sha256
    bytes: Count


class AnsweredTask(Document):
    """A task that was answered: its queries, by the hash of their file, and how many of them have a row."""

    suite: Folder
    region: Folder
    queries_sha256: Sha256
    queries: Count
    answered: Count


class Submission(Document):
    """`submission.json`: the card, the board it is for, versions, the tasks it answers and the hashes of its files."""

    schema_version: int
    card: Card
    board: Identifier
    split: Identifier | None
    task_version: int
    data_version: int
    scorer_version: int
    made_by: Short
    tasks: Annotated[list[AnsweredTask], Field(min_length=1, max_length=100_000)]
    files: Annotated[dict[str, SubmittedFile], Field(max_length=100)]
    licence: Short
    attribution: Line


def example_card(name: str = "my-matcher") -> str:
    """Return an example of a card, as TOML: that of a new matcher."""
    return EXAMPLE.format(name=name, title=name.replace("_", " ").replace("-", " ").capitalize())


EXAMPLE: Final = f"""\
# What the board says of your method, one line each (docs/howto/matcher.md); the class and a submission read it.
api = {API}                  # version of the doors that it is written for
name = "{{name}}"
version = "0.1.0"        # raise it whenever answers change
title = "{{title}}"
source = "original"      # or the paper it comes from
ours = "all of it"       # what of it is your own
licence = "MIT"          # SPDX name, of the code

tracks = ["retrieval", "localization"]  # what it answers
needs = ["position"]     # what a query must tell: position, yaw, scale, vectors, image, imagery, training
uses = []                # what it looks at besides query and map, as in "imagery"
limits = "looks at a coarse lattice of places, with the heading of the prior alone"

# Places of the split that taught it: "none", or a list. Answers of a file may have one for those about each half of a
# cross-fit: trained_on = {_EXAMPLE_BY_HALF.replace("{", "{{").replace("}", "}}")}
trained_on = "none"
# trained_elsewhere = "10,000 views of Zurich"    # what else taught it

# authors = ["A. Author"]
# contact = "a.author@example.org"
# code = "https://example.org/{{name}}"
"""

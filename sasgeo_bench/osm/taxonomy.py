# SPDX-License-Identifier: Apache-2.0
"""The semantic classes: the OSM tag rules that define them, and all that the program asks of each.

The data is in `taxonomy.toml`. Lists of classes are derived from it, so that a new class is a new block there.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources
from typing import Annotated, Final, Literal, Self

from pydantic import Field, StringConstraints, model_validator

from sasgeo_bench.core.config import Document, parse_toml

Kind = Literal["line", "area"]
Part = Literal["road", "rail", "water", "building", "area", "none"]
Cover = Literal["land", "water", "none"]
Trait = Literal[
    "street",
    "through",
    "drawn",
    "compared",
    "built",
    "roofed",
    "open",
    "blocks_areas",
    "blocks_lines",
    "clears",
]
Season = Literal["leaf_on", "snow", "low_water", "harvest"]
Name = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z_]*$")]
Colour = Annotated[str, StringConstraints(pattern=r"^#[0-9a-f]{6}$")]
WidthM = Annotated[float, Field(gt=0, le=100)]
Share = Annotated[float, Field(ge=0, le=1)]
ANY: Final = "*"
NONE: Final = "none"


class Persistence(Document):
    """Hand-set prior (dimensionless) and yearly rates (1/year) of one class (SASGeo paper, Eq. 5)."""

    prior: Share
    vanish_per_year: Annotated[float, Field(ge=0)]
    appear_per_year: Annotated[float, Field(ge=0)]


class Rule(Document):
    """One OSM key and the exact values of it that define a class; "*" is every value but those of `besides`."""

    key: str
    geometry: Kind
    values: list[str] = []
    besides: list[str] = []
    widths: dict[str, WidthM] = {}
    multipolygon: Literal["outline", "filled"] = "outline"
    keeps_width: list[str] = [ANY]
    fills_to: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _has_values(self) -> Self:
        if bool(self.values) == bool(self.widths):
            raise ValueError(
                f"a rule needs either values or widths, got values={self.values!r} and widths={self.widths!r}"
            )
        return self

    def takes(self, value: str) -> bool:
        """Return whether a tag value belongs to the class."""
        return value in self.widths or value in self.values or (ANY in self.values and value not in self.besides)


class Outline(Document):
    """Areas whose outline is drawn as a line of the class: parcel edges as field boundaries."""

    key: str
    values: list[str]
    width_m: WidthM


class ClassErrors(Document):
    """Errors of a detector on one class, in its domain, pixel by pixel; for line classes with a cell of tolerance."""

    recall: float
    precision: float
    confused_with: Name | None = None
    confused: float = 0.0  # fraction of the lost cells that become that class; the others become absent
    dropped: float = 0.4  # of areas, fractions of the lost cells lost as whole objects and, `frayed`, at edges;
    frayed: float = 0.4  # the others are lost in patches
    usual_share: float = 0.01  # of a usual view that the class covers; sets the false alarms in views without it
    width_m: float = 3.0  # of a false line

    @property
    def lost(self) -> float:
        """Return the fraction of the class's cells that is missed."""
        return 1 - self.recall

    @property
    def gained(self) -> float:
        """Return the false alarms, as a fraction of the class's cells."""
        return self.recall / self.precision * (1 - self.precision)


class MeasuredErrors(Document):
    """Errors on one class, in its own domain, pixel by pixel; for line classes with a cell of tolerance.

    `called` holds the fractions of the class that are seen as other classes; the rest of 1 - `recall` is seen as
    nothing. `of_yards` is the fraction of the empty ground beside roads and buildings that is seen as this one; where
    it is given, the precision follows from it and from the view, and `precision` is what towns come near. Else false
    alarms follow from `precision`, besides those that other classes are called. `small_m2` is the area at which an
    object is half as likely to be missed as a tiny one; they are `small_share` of the lost cells at most. `outline` is
    the fraction of the false alarms that continue the outline of something seen, with bulges about `bulge_m` deep.
    `alarms_on` names where the others lie. `is_ground`: the class is ground that shows nothing, on which false
    buildings and roads lie as on ground without any class.

    A measured profile (`perception_profile`) has two further rates: `of_ground` is the fraction of all empty ground
    that is seen as the class, in place of `of_yards`; `also` holds the fractions of the class that are seen as other
    classes besides.
    """

    recall: float
    precision: float
    called: dict[Name, float] = {}
    of_yards: float | None = None
    small_m2: float = 20.0
    small_share: float = 0.6
    outline: float = 0.6
    bulge_m: float = 1.5
    width_m: float = 3.0  # of a false line
    alarms_on: Literal["ground", "roads"] = "ground"
    is_ground: bool = False
    of_ground: float | None = None
    also: dict[Name, float] = {}


class SemanticClass(Document):
    """One semantic class; the head of `taxonomy.toml` says what each key means."""

    id: Annotated[int, Field(ge=0)]
    name: Name
    title: str
    kind: Kind
    colour: Colour
    persistence: Persistence
    paint: int
    graph: Part
    group: Name
    cover: Cover
    look: Name
    narrowest_m: Annotated[float, Field(gt=0)]
    standing_m: Annotated[float, Field(ge=0)]
    volatile: Annotated[int, Field(ge=0, le=6)]
    traits: list[Trait]
    seasons: dict[Season, Literal["lost", "unknown", "changed"]]
    seen_share: dict[Season, Share]
    published: ClassErrors
    measured: MeasuredErrors
    rules: list[Rule]
    outline_of: Outline | None = None
    covered_by: Name | None = None


class Taxonomy(Document):
    """All classes in the order of their ids, which is the band order of every layer stack."""

    classes: list[SemanticClass] = Field(alias="class")

    @model_validator(mode="after")
    def _ids_count_up(self) -> Self:
        ids = [item.id for item in self.classes]
        if ids != list(range(len(ids))):
            raise ValueError(f"class ids must count up from 0 without a gap, got {ids!r}")
        if len(set(self.names)) != len(ids):
            raise ValueError(f"class names must be unique, got {self.names!r}")
        if len({item.paint for item in self.classes}) != len(ids):
            raise ValueError(f"paint is a rank of each class, got {[item.paint for item in self.classes]!r}")
        for key, named in (
            ("covered_by", [item.covered_by for item in self.classes]),
            ("look", [item.look for item in self.classes if item.look != NONE]),
            ("confused_with", [item.published.confused_with for item in self.classes]),
            ("called", [name for item in self.classes for name in (*item.measured.called, *item.measured.also)]),
        ):
            if strange := [name for name in named if name not in (None, *self.names)]:
                raise ValueError(f"{key} names a class, got {strange!r}")
        return self

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Return class names in id order."""
        return tuple(item.name for item in self.classes)

    def __getitem__(self, name: str) -> SemanticClass:
        """Return the class of that name; `KeyError` if there is none."""
        return {item.name: item for item in self.classes}[name]

    @cached_property
    def covers(self) -> dict[str, str]:
        """Return the classes whose cells another class covers, each with that other one."""
        return {item.name: item.covered_by for item in self.classes if item.covered_by is not None}

    def having(self, trait: Trait) -> tuple[str, ...]:
        """Return the classes with a trait, in id order."""
        return tuple(item.name for item in self.classes if trait in item.traits)

    def of_graph(self, *parts: Part) -> tuple[str, ...]:
        """Return the classes with one of these parts in the graph of a map, in id order."""
        return tuple(item.name for item in self.classes if item.graph in parts)

    def covering(self, *covers: Cover) -> tuple[str, ...]:
        """Return the classes that are ground cover of these kinds, in id order."""
        return tuple(item.name for item in self.classes if item.cover in covers)

    def touched_by(self, season: Season, *effects: str) -> tuple[str, ...]:
        """Return the classes to which a season does one of these, or anything, in id order."""
        named = [item for item in self.classes if season in item.seasons]
        return tuple(item.name for item in named if not effects or item.seasons[season] in effects)

    @cached_property
    def lines(self) -> tuple[str, ...]:
        """Return the classes that are drawn as lines, in id order."""
        return tuple(item.name for item in self.classes if item.kind == "line")

    @cached_property
    def painted(self) -> tuple[str, ...]:
        """Return all classes in the order in which previews paint them."""
        return tuple(item.name for item in sorted(self.classes, key=lambda item: item.paint))

    @cached_property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """Return the classes of each group of descriptors, in the order of their first classes."""
        found = dict.fromkeys(item.group for item in self.classes if item.group != NONE)
        return {group: tuple(item.name for item in self.classes if item.group == group) for group in found}

    def of_maps(self) -> Mapping[str, object]:
        """Return what decides the layers and features of a map, as plain JSON: part of the hash of its inputs."""
        keys = ("id", "name", "title", "kind", "colour", "persistence", "rules", "outline_of", "covered_by")
        return self.model_dump(mode="json", include={"classes": {"__all__": set(keys)}})

    @cached_property
    def keys(self) -> tuple[str, ...]:
        """Return OSM keys that any rule reads, in order of first use."""
        return tuple(dict.fromkeys(rule.key for item in self.classes for rule in item.rules))

    def keys_of(self, geometry: Kind) -> tuple[str, ...]:
        """Return OSM keys that line rules (or area rules) read, in order of first use."""
        rules = (rule for item in self.classes for rule in item.rules)
        return tuple(dict.fromkeys(rule.key for rule in rules if rule.geometry == geometry))


@dataclass(frozen=True, slots=True, kw_only=True)
class Label:
    """One class of an object; `width_m` is None for areas and where the width of the carrying way counts.

    `is_outline`: the edge of an area is drawn, not the area; `is_filled`: a multipolygon of a line rule is an area;
    `keeps_width`: a tagged width overrides `width_m`; `fills_to_m`: an area that is wider anywhere is an outline.
    """

    class_name: str
    width_m: float | None
    is_outline: bool = False
    is_filled: bool = False
    keeps_width: bool = False
    fills_to_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Classification:
    """Labels of one object as a line and as an area, and the tags without a rule."""

    line: tuple[Label, ...]
    area: tuple[Label, ...]
    unknown: tuple[str, ...]


def classify(tags: Mapping[str, str], taxonomy: Taxonomy) -> Classification:
    """Apply every rule to the tags of one object; only keys of the taxonomy matter.

    Labels come in class order. A line rule labels areas too (filled or by their outline); the reader decides whether
    the object is a line or an area. `unknown` lists "key=value" of taxonomy keys without a rule.

    >>> found = classify({"highway": "primary", "bridge": "yes"}, load_taxonomy())
    >>> [(label.class_name, label.width_m) for label in found.line]
    [('road_major', 8.0), ('bridge', None)]
    >>> classify({"highway": "proposed"}, load_taxonomy()).unknown
    ('highway=proposed',)
    """
    line: list[Label] = []
    area: list[Label] = []
    known: set[str] = set()
    for item in taxonomy.classes:
        for rule in item.rules:
            value = tags.get(rule.key)
            if value is None or not rule.takes(value):
                continue
            known.add(rule.key)
            target, width_m = line if rule.geometry == "line" else area, rule.widths.get(value)
            target.append(
                Label(
                    class_name=item.name,
                    width_m=width_m,
                    fills_to_m=None if rule.fills_to is None or width_m is None else rule.fills_to * width_m,
                    is_filled=rule.multipolygon == "filled",
                    keeps_width=not {ANY, value}.isdisjoint(rule.keeps_width),
                )
            )
        outline = item.outline_of
        if outline is not None and tags.get(outline.key) in outline.values:
            area.append(Label(class_name=item.name, width_m=outline.width_m, is_outline=True))
    unknown = tuple(f"{key}={tags[key]}" for key in taxonomy.keys if key in tags and key not in known)
    return Classification(line=_unique(line), area=_unique(area), unknown=unknown)


def _unique(labels: list[Label]) -> tuple[Label, ...]:
    """Keep one label per class: that of the first rule."""
    return tuple({label.class_name: label for label in reversed(labels)}.values())[::-1]


@cache
def load_taxonomy() -> Taxonomy:
    """Return the taxonomy of the package."""
    text = resources.files("sasgeo_bench.osm").joinpath("taxonomy.toml").read_text(encoding="utf-8")
    return parse_toml(text, Taxonomy, source="taxonomy.toml")

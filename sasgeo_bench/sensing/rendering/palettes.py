# SPDX-License-Identifier: Apache-2.0
"""Families of colours and materials: places for training, calibration and testing never share one."""

from dataclasses import dataclass
from typing import Final, Literal

from sasgeo_bench.sensing.rendering.seasons import Colour

Family = Literal["train", "calibration", "test", "shifted"]
Cover = Literal["tiles", "slates", "sheets", "membrane", "gravel", "thatch"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Roofing:
    """One kind of roof: how often it is met, its colour, and how uneven it is in brightness (standard deviation).

    `rust` is the share of its sheets that may turn to rust.
    """

    cover: Cover
    colour: Colour
    weight: float
    spread: float = 0.1
    rust: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Palette:
    """Colours (sRGB, 0-255) and shares of one family of places.

    `yards` are weights of lawn, bare soil, paving and garden beds; `paved_share` is that of minor roads; `flat_share`
    is that of small buildings with a flat roof; `tree_density` and `cars` multiply the numbers of trees and cars;
    `bare` is the colour of rock and of sand; `patchwork` says how much unmapped open ground falls into plots of
    different use.
    """

    family: Family
    pitched: tuple[Roofing, ...]
    flat: tuple[Roofing, ...]
    walls: tuple[Colour, ...]
    asphalt: Colour
    paving: Colour
    track: Colour
    soil: tuple[Colour, Colour]
    bare: tuple[Colour, Colour]
    grass: tuple[Colour, Colour]
    crowns: tuple[Colour, ...]
    crops: tuple[Colour, ...]
    ripe: tuple[Colour, ...]
    water: tuple[Colour, Colour]
    yards: tuple[float, float, float, float]
    paved_share: float
    flat_share: float
    conifer_share: float
    palm_share: float
    tree_density: float
    markings: float
    roof_pitch: tuple[float, float]
    storey_m: float
    unevenness: float
    cars: float
    patchwork: float


PALETTES: Final[dict[Family, Palette]] = {
    # Clay tiles and slates, lawns, asphalt: the middle of Europe.
    "train": Palette(
        family="train",
        pitched=(
            Roofing(cover="tiles", colour=(158, 92, 70), weight=4.0, spread=0.13),
            Roofing(cover="tiles", colour=(126, 78, 64), weight=3.0, spread=0.12),
            Roofing(cover="tiles", colour=(104, 76, 66), weight=2.0, spread=0.12),
            Roofing(cover="slates", colour=(88, 88, 94), weight=2.0, spread=0.1),
            Roofing(cover="sheets", colour=(150, 154, 158), weight=0.8, spread=0.12, rust=0.05),
        ),
        flat=(
            Roofing(cover="gravel", colour=(146, 142, 134), weight=4.0, spread=0.12),
            Roofing(cover="membrane", colour=(186, 188, 190), weight=2.0, spread=0.12),
            Roofing(cover="membrane", colour=(92, 94, 98), weight=1.5, spread=0.12),
            Roofing(cover="sheets", colour=(164, 168, 172), weight=2.0, spread=0.1, rust=0.03),
            Roofing(cover="gravel", colour=(120, 132, 88), weight=0.6, spread=0.15),
        ),
        walls=((214, 206, 190), (198, 186, 164), (226, 224, 218), (178, 150, 122), (204, 196, 196)),
        asphalt=(116, 116, 118),
        paving=(162, 156, 148),
        track=(158, 144, 118),
        soil=((146, 124, 96), (172, 154, 124)),
        bare=((150, 146, 138), (196, 182, 150)),
        grass=((92, 116, 58), (126, 134, 80)),
        crowns=((62, 86, 40), (76, 100, 48), (52, 76, 40), (92, 108, 52)),
        crops=((94, 122, 56), (120, 138, 66), (82, 108, 60), (138, 142, 70)),
        ripe=((188, 168, 106), (202, 182, 124), (176, 156, 92)),
        water=((58, 80, 78), (96, 112, 96)),
        yards=(6.0, 1.0, 2.5, 1.5),
        paved_share=0.97,
        flat_share=0.12,
        conifer_share=0.25,
        palm_share=0.0,
        tree_density=1.0,
        markings=0.9,
        roof_pitch=(0.45, 0.95),
        storey_m=2.9,
        unevenness=1.0,
        cars=1.0,
        patchwork=0.5,
    ),
    # Shingles in grey and brown, white flat roofs, wide concrete: North America.
    "calibration": Palette(
        family="calibration",
        pitched=(
            Roofing(cover="slates", colour=(122, 114, 106), weight=4.0, spread=0.14),
            Roofing(cover="slates", colour=(146, 130, 112), weight=3.0, spread=0.13),
            Roofing(cover="slates", colour=(96, 92, 92), weight=2.5, spread=0.12),
            Roofing(cover="tiles", colour=(176, 130, 104), weight=0.8, spread=0.12),
        ),
        flat=(
            Roofing(cover="membrane", colour=(222, 222, 218), weight=4.0, spread=0.08),
            Roofing(cover="gravel", colour=(168, 160, 146), weight=3.0, spread=0.12),
            Roofing(cover="membrane", colour=(126, 124, 122), weight=2.0, spread=0.12),
        ),
        walls=((222, 214, 200), (170, 130, 110), (190, 188, 182), (156, 148, 140)),
        asphalt=(132, 130, 126),
        paving=(188, 182, 170),
        track=(178, 162, 134),
        soil=((162, 140, 110), (188, 170, 140)),
        bare=((160, 148, 134), (208, 192, 158)),
        grass=((104, 118, 66), (152, 146, 98)),
        crowns=((66, 84, 46), (82, 96, 54), (58, 74, 44), (104, 110, 64)),
        crops=((88, 118, 62), (108, 128, 68), (132, 138, 78)),
        ripe=((194, 174, 120), (182, 162, 110), (206, 188, 140)),
        water=((66, 84, 90), (110, 116, 100)),
        yards=(6.0, 0.8, 3.5, 0.6),
        paved_share=0.99,
        flat_share=0.15,
        conifer_share=0.2,
        palm_share=0.03,
        tree_density=1.2,
        markings=1.0,
        roof_pitch=(0.3, 0.6),
        storey_m=3.0,
        unevenness=0.9,
        cars=1.2,
        patchwork=0.35,
    ),
    # Concrete slabs, painted sheets, dusty ground: much of Asia.
    "test": Palette(
        family="test",
        pitched=(
            Roofing(cover="sheets", colour=(108, 132, 160), weight=2.5, spread=0.14, rust=0.1),
            Roofing(cover="sheets", colour=(166, 170, 172), weight=3.0, spread=0.14, rust=0.2),
            Roofing(cover="sheets", colour=(106, 140, 116), weight=1.2, spread=0.12, rust=0.1),
            Roofing(cover="tiles", colour=(142, 98, 80), weight=1.5, spread=0.13),
            Roofing(cover="sheets", colour=(164, 86, 76), weight=1.2, spread=0.12, rust=0.1),
        ),
        flat=(
            Roofing(cover="membrane", colour=(176, 170, 160), weight=5.0, spread=0.14),
            Roofing(cover="membrane", colour=(146, 140, 132), weight=3.0, spread=0.14),
            Roofing(cover="tiles", colour=(176, 122, 98), weight=1.5, spread=0.12),
            Roofing(cover="sheets", colour=(170, 176, 182), weight=1.5, spread=0.12, rust=0.15),
        ),
        walls=((206, 186, 160), (186, 122, 96), (222, 206, 186), (176, 172, 166), (196, 200, 186)),
        asphalt=(128, 124, 120),
        paving=(170, 160, 146),
        track=(178, 156, 126),
        soil=((164, 136, 104), (190, 166, 134)),
        bare=((138, 132, 124), (190, 172, 138)),
        grass=((100, 116, 64), (144, 138, 88)),
        crowns=((58, 82, 42), (72, 94, 46), (84, 104, 54), (54, 72, 44)),
        crops=((96, 128, 58), (78, 112, 58), (124, 144, 72)),
        ripe=((188, 166, 100), (174, 150, 96)),
        water=((76, 92, 82), (124, 120, 94)),
        yards=(2.0, 3.5, 3.0, 2.5),
        paved_share=0.7,
        flat_share=0.6,
        conifer_share=0.08,
        palm_share=0.04,
        tree_density=0.8,
        markings=0.4,
        roof_pitch=(0.2, 0.5),
        storey_m=3.0,
        unevenness=1.2,
        cars=0.8,
        patchwork=0.7,
    ),
    # Sheets with rust, thatch, red ground, few paved roads: villages of the tropics.
    "shifted": Palette(
        family="shifted",
        pitched=(
            Roofing(cover="sheets", colour=(196, 204, 208), weight=5.0, spread=0.1, rust=0.25),
            Roofing(cover="sheets", colour=(164, 170, 172), weight=2.5, spread=0.14, rust=0.5),
            Roofing(cover="sheets", colour=(146, 92, 74), weight=1.2, spread=0.16, rust=0.9),
            Roofing(cover="thatch", colour=(132, 124, 112), weight=1.2, spread=0.12),
        ),
        flat=(
            Roofing(cover="sheets", colour=(188, 196, 200), weight=4.0, spread=0.12, rust=0.2),
            Roofing(cover="membrane", colour=(168, 162, 150), weight=1.5, spread=0.14),
        ),
        walls=((196, 182, 158), (176, 150, 118), (208, 206, 196), (158, 132, 104)),
        asphalt=(136, 132, 124),
        paving=(184, 168, 142),
        track=(190, 164, 126),
        soil=((164, 134, 98), (192, 166, 128)),
        bare=((176, 150, 122), (216, 194, 152)),
        grass=((92, 114, 58), (136, 136, 82)),
        crowns=((54, 84, 36), (72, 106, 42), (46, 70, 36), (94, 120, 52)),
        crops=((108, 126, 66), (130, 132, 84), (92, 112, 60)),
        ripe=((182, 158, 110), (168, 146, 104)),
        water=((88, 98, 80), (134, 124, 94)),
        yards=(1.5, 5.0, 0.3, 2.5),
        paved_share=0.15,
        flat_share=0.06,
        conifer_share=0.0,
        palm_share=0.2,
        tree_density=1.7,
        markings=0.4,
        roof_pitch=(0.2, 0.4),
        storey_m=2.8,
        unevenness=1.5,
        cars=0.3,
        patchwork=1.0,
    ),
}

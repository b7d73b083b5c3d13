# SPDX-License-Identifier: Apache-2.0
"""OSM files that are drawn in metres from 9 E, 47 N, the middle of a UTM zone."""


def place(x, y):
    """Longitude and latitude of a place."""
    return 9 + x / 76_030, 47 + y / 111_175


def tagged(tags):
    return "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())


def bounds(west, south, east, north):
    """The box of a header."""
    (west, south), (east, north) = place(west, south), place(east, north)
    return f'<bounds minlat="{south:.7f}" minlon="{west:.7f}" maxlat="{north:.7f}" maxlon="{east:.7f}"/>'


def osm(path, *ways, relations=(), head="", first=1, meta='version="1"'):
    """Write ways (tags, corners), numbered from `first`, and relations (members, tags); equal corners are one node."""
    refs, lines = {}, []
    for number, (tags, corners) in enumerate(ways, first):
        nds = "".join(f'<nd ref="{refs.setdefault(corner, len(refs) + 1)}"/>' for corner in corners)
        lines.append(f'<way id="{number}" {meta}>{nds}{tagged(tags)}</way>')
    for number, (members, tags) in enumerate(relations, 1):
        inside = "".join(f'<member type="way" ref="{way}" role="{role}"/>' for way, role in members)
        lines.append(f'<relation id="{number}" {meta}>{inside}{tagged(tags)}</relation>')
    places = {ref: place(*corner) for corner, ref in refs.items()}
    nodes = [f'<node id="{ref}" {meta} lat="{lat:.7f}" lon="{lon:.7f}"/>' for ref, (lon, lat) in places.items()]
    path.write_text(f'<osm version="0.6">{head}' + "\n".join([*nodes, *lines]) + "</osm>", encoding="utf-8")
    return path

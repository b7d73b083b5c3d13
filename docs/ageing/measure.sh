#!/bin/sh
# SPDX-License-Identifier: Apache-2.0
# Measure everything in this folder anew, and the rates that come with the package:
# measure.sh PROGRAM FOLDER-OF-EXTRACTS ('make ageing' calls it).
set -eu
program=$1
extracts=$(cd "$2" && pwd)
here=$(cd "$(dirname "$0")" && pwd)

measure() { # PLACE FOLDER "FILE..." "DATE..." MORE...
    place=$1 folder=$2 files=$3 dates=$4
    shift 4
    for file in $files; do set -- "$@" --extract "$extracts/$file"; done
    for date in $dates; do set -- "$@" --at "$date"; done
    "$program" measure-ageing --place "$place" "$@" --out "$here/$folder"
}

measure Liechtenstein liechtenstein "
    liechtenstein-2013-08-03.osm.pbf liechtenstein-2014-12-10.osm.pbf liechtenstein-2015-07-27.osm.pbf
    liechtenstein-2018-12-09.osm.pbf liechtenstein-2019-11-18.osm.pbf liechtenstein-2021-05-05.osm.pbf
    liechtenstein-2021-10-28.osm.pbf liechtenstein-2022-12-15.osm.pbf liechtenstein-2025-09-19.osm.pbf" ""
measure Andorra andorra "
    andorra-2013-05-28.osm.pbf andorra-2017-02-19.osh.pbf andorra-2020-05-01.osm.pbf andorra-2021-10-28.osm.pbf
    andorra-2025-01-19.osm.pbf" "2015-01-01 2016-01-01 2017-01-01"
# Monaco is so small that the usual margin of 300 m would leave a quarter of it.
measure Monaco monaco "
    monaco-2015-04-27.osm.pbf monaco-2020-07-19.osm.pbf monaco-2022-07-19.osm.pbf monaco-2025-02-15.osm.pbf" "" --margin-m 100
measure Dreieich dreieich "dreieich-2013-07-19.osm.pbf dreieich-2022-10-16.osm.pbf" ""
measure "Faroe Islands" faroe "faroe-2017-02-18.osh.pbf" "2010-01-01 2012-01-01 2014-01-01 2016-01-01 2017-02-01"
# A control: one day apart, from two independent files. What it finds is the floor of the method, not ageing.
measure "Andorra, a day apart" andorra-control "andorra-2013-05-28.osm.pbf andorra-2017-02-19.osh.pbf" "2013-05-27"
measure "Andorra, a day apart, edges kept" andorra-control-edges \
    "andorra-2013-05-28.osm.pbf andorra-2017-02-19.osh.pbf" "2013-05-27" --margin-m 0

"$program" measure-ageing --compare "$here/liechtenstein" "$here/andorra" "$here/monaco" "$here/dreieich" "$here/faroe" \
    --control "$here/andorra-control" --control "$here/andorra-control-edges" \
    --rates "$here/../../sasgeo_bench/ageing/ratebook.toml" --out "$here/summary.md"

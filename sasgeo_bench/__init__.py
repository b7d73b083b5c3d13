# SPDX-License-Identifier: Apache-2.0
"""sasgeo-bench: benchmark and dataset builder for map localization of UAVs without GNSS.

`import sasgeo_bench as sgb` gives all that a plugin and a notebook need; `__init__.pyi` lists the names. Each is
imported when it is first asked for, so that importing the package costs next to nothing.

Examples
--------
>>> import sasgeo_bench as sgb
>>> sgb.Grid(epsg=32632, west_m=0.0, north_m=100.0, cell_size_m=2.0, rows=50, cols=50).bounds_m
(0.0, 0.0, 100.0, 100.0)
"""

from collections.abc import Callable
from functools import cache
from typing import Any

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:  # noqa: ANN401 - any public name
    get, _, names = _public()
    return names if name == "__all__" else get(name)


def __dir__() -> list[str]:
    return _public()[1]()


@cache
def _public() -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    from lazy_loader import attach_stub  # noqa: PLC0415 - what shuts a matcher in runs without other packages

    return attach_stub(__name__, __file__)

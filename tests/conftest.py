# SPDX-License-Identifier: Apache-2.0
"""What every test shares: no network, reproducible hypothesis runs, and the folder of real extracts."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# No test depends on how busy the machine is; CI draws the same examples each time, a person's runs go on searching.
settings.register_profile(
    "sasgeo",
    deadline=None,
    derandomize="CI" in os.environ,
    max_examples=50,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("sasgeo")

LOOPBACK = ("127.", "localhost", "::1")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip the tests on real data, with the reason, where there is none."""
    if _extracts_folder() is not None:
        return
    skip = pytest.mark.skip(reason="real extracts: SASGEO_EXTRACTS names no folder with *.osm.pbf files")
    for item in items:
        if item.get_closest_marker("real"):
            item.add_marker(skip)


@pytest.fixture(scope="session")
def real_extracts() -> Path:
    """The folder of real extracts; a test that asks for it is skipped where there is none."""
    folder = _extracts_folder()
    if folder is None:
        pytest.skip("real extracts: SASGEO_EXTRACTS names no folder with *.osm.pbf files")
    return folder


@pytest.fixture(autouse=True, scope="session")
def _no_network() -> Iterator[None]:
    """Refuse every connection that leaves this machine, so that no test can depend on one."""
    with pytest.MonkeyPatch.context() as patch:
        connect = socket.socket.connect

        def connect_here_only(self: socket.socket, address: object) -> None:
            if self.family != socket.AF_UNIX and not str(address[0]).startswith(LOOPBACK):  # type: ignore[index]
                message = f"a test tried to reach {address!r}: tests use no network"
                raise RuntimeError(message)
            connect(self, address)  # type: ignore[arg-type]

        patch.setattr(socket.socket, "connect", connect_here_only)
        yield


def _extracts_folder() -> Path | None:
    """The first folder of SASGEO_EXTRACTS (a list, as in PATH) that holds extracts."""
    for name in os.environ.get("SASGEO_EXTRACTS", "").split(os.pathsep):
        if name and any(Path(name).glob("*.osm.pbf")):
            return Path(name).resolve()
    return None

# SPDX-License-Identifier: Apache-2.0
"""Helpers of a made-up map, and tasks of an embedded town."""

import builtins
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sasgeo_baselines.segmenters.network import drawn_weights, encoder_shapes

from sasgeo_bench.tasks.build import make_tasks
from sasgeo_bench.tasks.task_plan import TaskRequest, plan_requests
from tests.made_up import CLASSES, query_of, region_of, textured, view_of


@pytest.fixture(scope="session")
def made() -> SimpleNamespace:
    """The helpers of `tests.made_up`."""
    return SimpleNamespace(textured=textured, region_of=region_of, view_of=view_of, query_of=query_of, classes=CLASSES)


@pytest.fixture(scope="session")
def town_tasks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root with a quarter of town-grid, which is enough for the search of a view, and the suite `clean` at one site."""
    out = tmp_path_factory.mktemp("baselines") / "out"
    wanted = TaskRequest(suites=("clean",), regions=("town-grid",), split="crossfit", count=1, seed=0, out=out)
    for request in plan_requests(wanted):
        whole = request.region
        town = whole.extract[-1].town.model_copy(update={"size_m": 1280.0})
        extract = whole.extract[-1].model_copy(update={"town": town})
        quarter = whole.model_copy(update={"size_m": (1024.0, 1024.0), "extract": [extract]})
        make_tasks(replace(request, region=quarter))
    return out


@pytest.fixture(scope="session")
def torch() -> Any:
    """PyTorch; the test is skipped without it."""
    return pytest.importorskip("torch", reason="PyTorch, the extra [torch], is not installed (make test-torch)")


@pytest.fixture
def without_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """An interpreter that has no PyTorch."""
    real = builtins.__import__

    def refusing(name: str, *args: Any, **kwargs: Any) -> Any:
        if name == "torch":
            raise ModuleNotFoundError("No module named 'torch'", name=name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refusing)


@pytest.fixture(scope="session")
def drawn_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Weights of an encoder that has learned nothing, as an archive of NumPy."""
    path = tmp_path_factory.mktemp("weights") / "encoder.npz"
    weights = drawn_weights(1, np.random.default_rng(0))
    np.savez(path, **{name: weights[name] for name in encoder_shapes()})
    return path

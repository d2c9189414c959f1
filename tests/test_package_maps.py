"""Whoever opens a package finds every module of it in the map at its top."""

import importlib
import pkgutil
import re

import pytest


@pytest.mark.parametrize("package", ["daq", "drivers", "identify", "simulated_rig"])
def test_every_module_is_on_the_map(package: str) -> None:
    """In its group; and nothing is on it that has gone."""
    opened = importlib.import_module(package)
    there = {module.name for module in pkgutil.iter_modules(opened.__path__)}
    mapped = (opened.__doc__ or "").split("What is where:")[1]
    assert set(re.findall(r"`(\w+)`", mapped)) == there

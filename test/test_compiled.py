"""Compiled code gives the same digits where it was compiled as where it is loaded from the cache."""

from __future__ import annotations

import importlib
import pkgutil

from numba.core.registry import CPUDispatcher

import mems6dof_ros

ROOMS = ("calibration", "localization", "pose", "simulation", "sources")


def compiled() -> dict[str, CPUDispatcher]:
    """Every compiled function of the core, by module and name."""
    found = {}
    for room in ROOMS:
        package = importlib.import_module(f"mems6dof_ros.{room}")
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            for name, value in vars(importlib.import_module(module.name)).items():
                if isinstance(value, CPUDispatcher):
                    found[f"{value.py_func.__module__}.{value.py_func.__name__}"] = value
                    assert name == value.py_func.__name__
    return found


def test_what_may_reorder_sums_is_inlined_where_compiled_code_calls_it() -> None:
    functions = compiled()
    assert len(functions) > 50
    called = {
        id(function.py_func.__globals__.get(name))
        for function in functions.values()
        for name in function.py_func.__code__.co_names
    }
    wrong = [
        name
        for name, function in functions.items()
        if id(function) in called
        and function.targetoptions.get("fastmath")
        and not function.targetoptions.get("forceinline")
    ]
    assert wrong == []


def test_every_function_is_kept_for_the_next_process() -> None:
    uncached = [
        name for name, function in compiled().items() if function._cache.__class__.__name__ == "NullCache"
    ]
    assert uncached == [], mems6dof_ros.__file__

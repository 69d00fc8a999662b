"""Where every simulator is installed, no test of one may be skipped unnoticed: RPG_NO_SKIPS=1 makes it fail."""

from __future__ import annotations

import os
from collections.abc import Generator
from pathlib import Path
from typing import Any

import pytest

from rpg.envs.headless import prefer_offscreen_gl

prefer_offscreen_gl()  # before any test imports a simulator

HERE = Path(__file__).parent
NO_SKIPS = os.environ.get("RPG_NO_SKIPS") == "1"


def fail_if_skipped(report: Any) -> None:
    if report.skipped and not hasattr(report, "wasxfail"):
        reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else report.longrepr
        report.outcome, report.longrepr = "failed", f"RPG_NO_SKIPS=1, but this was skipped: {reason}"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: Any) -> Generator[None, Any, Any]:
    report = yield
    if NO_SKIPS and HERE in item.path.parents:
        fail_if_skipped(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector) -> Generator[None, Any, Any]:
    report = yield
    if NO_SKIPS and HERE in collector.path.parents:
        fail_if_skipped(report)
    return report

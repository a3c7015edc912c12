"""A test that failed runs once more, for diagnosis alone: it stays failed, and is reported as flaky where it passes then."""

from __future__ import annotations

import pytest
from _pytest.runner import runtestprotocol

FLAKY = "flaky"


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: pytest.Item, nextitem: pytest.Item | None) -> bool:
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    reports = runtestprotocol(item, nextitem=nextitem, log=False)
    if failed := [report for report in reports if report.failed]:
        item._initrequest()  # type: ignore[attr-defined]  # pytest has no public way to run a test's fixtures anew
        again = [report for report in runtestprotocol(item, nextitem=nextitem, log=False) if report.failed]
        words = (
            "\n".join(report.longreprtext for report in again) or "It passed: the test is FLAKY, and this run failed."
        )
        failed[0].sections.append(("the second try", words))
        for report in reports:
            report.user_properties.append((FLAKY, not again))
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for status in ("failed", "error"):
        for report in terminalreporter.getreports(status):
            if (FLAKY, True) in getattr(report, "user_properties", ()):  # a file that can't be collected has none
                terminalreporter.write_line(
                    f"FLAKY {report.nodeid}: failed, then passed when it ran once more", red=True
                )

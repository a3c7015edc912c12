"""A test that failed runs once more, for diagnosis alone: it stays failed, and is reported as flaky where it passes then.

What failed is printed at once: a run that is ended for its time leaves no summary.
"""

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


class _AtOnce:
    """Of the process that reports."""

    def __init__(self, config: pytest.Config) -> None:
        self.config = config

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        terminal = self.config.pluginmanager.get_plugin("terminalreporter")
        if report.failed and terminal is not None:
            crash = getattr(report.longrepr, "reprcrash", None)
            words = crash.message if crash else report.longreprtext
            terminal.write_line(f"\n{report.nodeid}, {report.when}: {words[:3000]}", red=True)


def pytest_configure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput"):
        config.pluginmanager.register(_AtOnce(config))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for status in ("failed", "error"):
        for report in terminalreporter.getreports(status):
            if (FLAKY, True) in getattr(report, "user_properties", ()):  # a file that can't be collected has none
                terminalreporter.write_line(
                    f"FLAKY {report.nodeid}: failed, then passed when it ran once more", red=True
                )

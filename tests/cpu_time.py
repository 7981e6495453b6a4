"""A plugin that measures the CPU seconds of each test: ``pytest --cpu-limit 6`` fails quick tests that use more.

Counted are all threads of the test's process and every child that was waited for, during setup, call and teardown.
A fixture that tests share counts for the test that first asks for it. CPU time hardly depends on the load, but not
quite: tests that share caches and cores took up to ``MARGIN`` times as long as on an idle machine.
"""

import resource
from collections.abc import Generator

import pytest

MARGIN = 1.5
SHOWN = 40
_used: dict[str, float] = {}
_begun = pytest.StashKey[float]()


def cpu_s() -> float:
    """CPU seconds, user and system, of this process and of the children that it has waited for."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def pytest_addoption(parser: pytest.Parser) -> None:
    """``--cpu-limit SECONDS``."""
    text = f"Fail tests that are not marked slow and use over {MARGIN} times SECONDS of CPU; list the costliest."
    parser.addoption("--cpu-limit", type=float, metavar="SECONDS", help=text)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Note where the test begins."""
    item.stash[_begun] = cpu_s()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """At the test's end, write down what it used, and fail it if that is too much."""
    report = yield
    limit = item.config.getoption("--cpu-limit")
    if limit is None or call.when != "teardown":
        return report
    used = cpu_s() - item.stash[_begun]
    report.user_properties.append(("cpu_s", f"{used:.2f}"))
    if used > MARGIN * limit and not item.get_closest_marker("slow") and report.passed:
        report.outcome = "failed"
        report.longrepr = (
            f"{used:.1f} s of CPU; a quick test has {limit:g}. Make its scene smaller, share a fixture, "
            "or mark it slow (CONTRIBUTING.md)."
        )
    return report


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Collect what the workers measured."""
    for name, value in report.user_properties:
        if name == "cpu_s" and report.when == "teardown":
            _used[report.nodeid] = float(str(value))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """List the costliest tests, and the sum."""
    if _used:
        terminalreporter.section(f"CPU seconds: {sum(_used.values()):.0f} in {len(_used)} tests; the costliest")
        for test in sorted(_used, key=lambda test: -_used[test])[:SHOWN]:
            terminalreporter.write_line(f"{_used[test]:6.2f} {test}")

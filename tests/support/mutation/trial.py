"""Tries mutants: each in a forked child, on the tests that run its line, the quickest first.

A fault in a function replaces the function's code, in a child of a process that has collected all tests. A fault in what runs at the import,
or in a kernel, is tried on all tests in a child of a process that has only the libraries: there the module is imported with its fault, and
the tests are collected anew. No file is written.
"""

from __future__ import annotations

import ast
import contextlib
import ctypes
import gc
import importlib
import importlib.machinery
import importlib.util
import linecache
import os
import pickle
import resource
import shutil
import signal
import sys
import tempfile
import time
import types
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import pytest

from tests.support.mutation.mutants import Mutant, mutants, mutated, noting
from tests.support.suite.caches import kernel_cache

REPOSITORY = Path(__file__).parents[3]
KILLED, SURVIVED, TIMED_OUT = "killed", "survived", "timed out"
_OURS = ("orchestrator", "shared_store", "worker", "racer", "tests", "muster_policy")
_EXAMPLES = 10
"""Examples that Hypothesis tries in each test at most."""
_TIMES, _MORE = 10, 5.0
"""A test may take so many times its usual time, and so many seconds more, of the processor; on the clock ten times that, and a
minute."""
_COLLECTION = 120.0
"""Seconds of the processor for imports and the collection of tests."""
_MEMORY = 4 << 30
"""Bytes that a child may take beyond what its parent has."""
_LIBC, _DEATH_SIGNAL = ctypes.CDLL(None), 1
"""So that no child outlives its parent: prctl(PR_SET_PDEATHSIG)."""
_OPTIONS = ("-qq", "--tb=no", *(f"-pno:{name}" for name in ("cacheprovider", "timeout", "faulthandler")))


_Functions = defaultdict[tuple[str, str, int], list[types.FunctionType]]


@dataclass
class Reach:
    """What each test runs of the modules, and its time of the processor [s]."""

    seconds: dict[str, float] = field(default_factory=dict)
    lines: dict[tuple[str, str], set[int]] = field(default_factory=dict)
    """By test and module."""
    libraries: tuple[str, ...] = ()
    """The modules of others that the tests import."""

    def tests(self, module: str, line: int) -> list[str]:
        """The tests that reach a line of the module, the quickest first."""
        found = [test for (test, where), seen in self.lines.items() if where == module and line in seen]
        return sorted(found, key=lambda test: (self.seconds[test], test))


@dataclass(frozen=True)
class Trial:
    """Modules, and the tests that should notice a fault in them."""

    modules: Sequence[str]
    """Paths in the repository."""
    tests: Sequence[str]
    chosen: Callable[[str, Mutant], bool]
    """Which mutants are tried."""
    note: Callable[[str, Mutant, str, float], None]
    """Called with every result, and the time of the processor [s] that it took."""
    options: Sequence[str] = ()
    """For pytest."""
    bounds_memory: bool = True

    def run(self) -> None:
        """Try the chosen mutants. Raises RuntimeError if the tests can't be run without a fault."""
        with tempfile.TemporaryDirectory() as scratch:
            _Run(self, Path(scratch)).run()


class _Run:
    def __init__(self, trial: Trial, scratch: Path) -> None:
        self.trial, self.scratch, self.reach = trial, scratch, Reach()
        self.sources = {module: (REPOSITORY / module).read_text() for module in trial.modules}
        self.mutants = [
            (module, mutant)
            for module, source in self.sources.items()
            for mutant in mutants(source)
            if trial.chosen(module, mutant)
        ]

    def run(self) -> None:
        if any(mutant.in_kernel for _, mutant in self.mutants):
            self._set_kernels_apart()
        kept = self.scratch / "reach"
        self.plugin = _Collected(lambda session: self._in_functions(session, kept))
        self._need(_in_child(lambda: self._pytest(self.plugin)))
        self.reach = pickle.loads(kept.read_bytes())
        for name in self.reach.libraries:
            with contextlib.suppress(Exception):
                importlib.import_module(name)
        tests = sorted(self.reach.seconds, key=self.reach.seconds.__getitem__)
        later = [(module, mutant) for module, mutant in self.mutants if not _is_quick(mutant)]
        if later:
            self._need(_in_child(lambda: self._anew(later[0][0], None, tests)))
        for module, mutant in later:
            self._try(module, mutant, tests, partial(self._anew, module, mutant.number, tests))

    def _set_kernels_apart(self) -> None:
        """Let Warp find the kernels that are compiled, and keep the faulty ones elsewhere."""
        compiled = Path(os.environ.get("WARP_CACHE_PATH") or kernel_cache())
        apart = self.scratch / "kernels"
        if compiled.is_dir():
            shutil.copytree(compiled.resolve(), apart, copy_function=os.symlink)
        os.environ["WARP_CACHE_PATH"] = str(apart)

    def _need(self, status: int) -> None:
        if status != 0:
            log = (self.scratch / "log").read_text()[-4000:]
            raise RuntimeError(f"the tests can't be run without a fault (status {status}):\n{log}")

    def _try(self, module: str, mutant: Mutant, tests: Sequence[str], act: Callable[[], int]) -> None:
        """Try one mutant, on tests that may notice it."""
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        status = _in_child(act, _MEMORY if self.trial.bounds_memory else None) if tests else 0
        now, late = resource.getrusage(resource.RUSAGE_CHILDREN), status in (-signal.SIGPROF, -signal.SIGALRM)
        seconds = now.ru_utime + now.ru_stime - before.ru_utime - before.ru_stime
        self.trial.note(module, mutant, SURVIVED if status == 0 else TIMED_OUT if late else KILLED, seconds)

    def _pytest(self, plugin: object, *options: str) -> int:
        """Run pytest, silently."""
        log = os.open(self.scratch / "log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(log, 1)
        os.dup2(log, 2)
        base = f"--basetemp={self.scratch / 'temporary'}"
        return int(pytest.main([*self.trial.tests, *_OPTIONS, *self.trial.options, *options, base], plugins=[plugin]))

    # -- faults in functions ------------------------------------------------------------------------------------------

    def _in_functions(self, session: pytest.Session, kept: Path) -> None:
        """In the process that has collected the tests."""
        items = {item.nodeid: item for item in session.items}
        for module in self.trial.modules:
            importlib.import_module(_name(module))
        functions = self._functions()
        self._need(_in_child(lambda: self._measure(items, functions, kept)))
        self.reach = pickle.loads(kept.read_bytes())
        gc.freeze()
        for module, mutant in self.mutants:
            if _is_quick(mutant):
                tests = self.reach.tests(module, mutant.line)

                act = partial(self._in_function, session, functions, module, mutant, [items[test] for test in tests])
                self._try(module, mutant, tests, act)

    def _in_function(
        self, session: pytest.Session, functions: _Functions, module: str, mutant: Mutant, items: Sequence[pytest.Item]
    ) -> int:
        """Put the fault into its function and run the tests: the first failure ends this process."""
        assert mutant.function is not None
        code = _codes(mutated(self.sources[module], mutant.number), module)[mutant.function]
        for function in functions[module, *mutant.function]:
            function.__code__ = code
        for item in items:
            _limit(self.reach.seconds[item.nodeid])
            session.config.hook.pytest_runtest_protocol(item=item, nextitem=None)
        return 0

    def _measure(self, items: dict[str, pytest.Item], functions: _Functions, kept: Path) -> int:
        """Run every test, and note what it reaches; a test that fails is left out."""
        seen: defaultdict[str, set[int]] = defaultdict(set)
        for module, source in self.sources.items():
            vars(sys.modules[_name(module)])["__reached__"] = seen[module].add
            codes = _codes(noting(source), module)
            for (where, *key), found in functions.items():
                for function in found if where == module else ():
                    function.__code__ = codes[tuple(key)]
        self.plugin.ends = False
        for name, item in items.items():
            for lines in seen.values():
                lines.clear()
            started = time.process_time()
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=None)
            if not self.plugin.failed:
                self.reach.seconds[name] = time.process_time() - started
                self.reach.lines |= {(name, module): set(lines) for module, lines in seen.items() if lines}
            self.plugin.failed = False
        self.reach.libraries = tuple(name for name in sys.modules if name.partition(".")[0] not in (*_OURS, "__main__"))
        kept.write_bytes(pickle.dumps(self.reach))
        return 0

    def _functions(self) -> _Functions:
        """Every function of the modules, by module, name and first line."""
        found: _Functions = defaultdict(list)
        paths = {str(REPOSITORY / module): module for module in self.trial.modules}
        for each in gc.get_objects():
            if isinstance(each, types.FunctionType) and (module := paths.get(each.__code__.co_filename)):
                found[module, each.__code__.co_qualname, each.__code__.co_firstlineno].append(each)
        return found

    # -- faults at the import, and in kernels -------------------------------------------------------------------------

    def _anew(self, module: str, number: int | None, tests: Sequence[str]) -> int:
        """Import the module with a fault, collect the tests and run them."""
        _limit(_COLLECTION)
        source = self.sources[module] if number is None else ast.unparse(mutated(self.sources[module], number))
        sys.meta_path.insert(0, _Faulty(_name(module), str(REPOSITORY / module), source))
        files = {test.partition("::")[0] for test in tests}
        apart = [f"--ignore={path}" for each in self.reach.seconds if (path := each.partition("::")[0]) not in files]
        return self._pytest(_Ordered(tests, self.reach.seconds), "-x", *sorted(set(apart)))


class _Faulty(importlib.machinery.SourceFileLoader):
    """Finds and loads one module with another text, which is also what :mod:`inspect` and so Warp read."""

    def __init__(self, name: str, path: str, source: str) -> None:
        super().__init__(name, path)
        self._source = source

    def find_spec(self, name: str, path: object, target: object = None) -> importlib.machinery.ModuleSpec | None:
        return importlib.util.spec_from_file_location(name, self.path, loader=self) if name == self.name else None

    def get_code(self, fullname: str) -> types.CodeType:
        linecache.cache[self.path] = (len(self._source), None, self._source.splitlines(keepends=True), self.path)
        return _compiled(self._source, self.path)


class _Plugin:
    """Few examples, always the same ones."""

    failed = False
    ends = True

    def pytest_configure(self) -> None:
        from hypothesis import HealthCheck, Phase, settings

        settings.register_profile(
            "mutation",
            max_examples=_EXAMPLES,
            phases=[Phase.explicit, Phase.generate],
            derandomize=True,
            database=None,
            deadline=None,
            suppress_health_check=list(HealthCheck),
        )
        settings.load_profile("mutation")

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        from hypothesis import settings

        for item in items:
            for holder, name in (
                (getattr(item, "obj", None), "_hypothesis_internal_use_settings"),
                (getattr(item, "cls", None), "settings"),
            ):
                found = getattr(holder, name, None)
                if isinstance(found, settings) and found.max_examples > _EXAMPLES:
                    setattr(holder, name, settings(found, max_examples=_EXAMPLES))

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_makereport(self, call: pytest.CallInfo[None]) -> None:
        """The first failure ends a child: nobody reads its report."""
        if call.excinfo is not None and not call.excinfo.errisinstance(pytest.skip.Exception):
            if self.ends:
                os._exit(1)
            self.failed = True


class _Collected(_Plugin):
    """Does something else with the collected tests than to run them."""

    def __init__(self, act: Callable[[pytest.Session], None]) -> None:
        self._act = act

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        if session.testsfailed:
            raise session.Interrupted("tests that can't be collected")
        self._act(session)
        return True


class _Ordered(_Plugin):
    """Runs some of the tests, in this order, each within its time."""

    def __init__(self, tests: Sequence[str], seconds: dict[str, float]) -> None:
        self._places, self._seconds = {test: place for place, test in enumerate(tests)}, seconds

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        super().pytest_collection_modifyitems(items)
        items[:] = sorted(
            (item for item in items if item.nodeid in self._places), key=lambda item: self._places[item.nodeid]
        )

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        _limit(self._seconds[nodeid])

    def pytest_runtest_logfinish(self) -> None:
        _limit(_COLLECTION)  # what follows the last test


def _name(module: str) -> str:
    return module.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def _codes(tree: ast.Module, module: str) -> dict[tuple[object, ...], types.CodeType]:
    """The code of the functions in a module's tree, by name and first line."""

    def inside(code: types.CodeType) -> Iterator[types.CodeType]:
        for each in code.co_consts:
            if isinstance(each, types.CodeType):
                yield each
                yield from inside(each)

    code = _compiled(tree, str(REPOSITORY / module))
    return {(each.co_qualname, each.co_firstlineno): each for each in inside(code)}


def _is_quick(mutant: Mutant) -> bool:
    return mutant.function is not None and not mutant.in_kernel


def _compiled(what: ast.Module | str, path: str) -> types.CodeType:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # such as a comparison with a literal by "is"
        code: types.CodeType = compile(what, path, "exec", dont_inherit=True)
    return code


def _limit(usual: float) -> None:
    """End this process if its next step takes far longer than usual [s]."""
    seconds = usual * _TIMES + _MORE
    signal.setitimer(signal.ITIMER_PROF, seconds)
    signal.setitimer(signal.ITIMER_REAL, seconds * 10 + 60)


def _in_child(act: Callable[[], int], memory: int | None = None) -> int:
    """Act in a forked child; returns its exit code, or the negative number of the signal that ended it."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            os.setpgid(0, 0)
            _LIBC.prctl(_DEATH_SIGNAL, signal.SIGKILL)
            if memory is not None:
                pages = int(Path("/proc/self/statm").read_text().split()[0])
                resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + memory,) * 2)
            code = act()
        finally:
            os._exit(code)
    status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # what it has started
    return status

"""The sandbox of reward functions: what code that got round the guard can still reach, on this kernel and on lesser ones."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from racer.rewards import confinement as confined
from racer.rewards import guard, parameters, sandbox
from racer.rewards.guard import check_source, try_out
from racer.rewards.problems import RewardFailed
from racer.rewards.samples import OVAL, oval
from racer.rewards.workers import Workers
from tests.conftest import REPOSITORY
from tests.support.racer.racing import round_the_guard

MACHINE = os.uname().machine
pytestmark = pytest.mark.skipif(MACHINE not in sandbox.MACHINES, reason="no list of this processor's system calls")
SECRET = "MSTRSECRETOFALLKEYS"

# what each reaches is put into a message; none of them may reach anything
READERS = {
    "open": "open(PATH).read()",
    "linecache": "''.join(np.ma.core.inspect.linecache.getlines(PATH))",
    "fromfile": "bytes(np.fromfile(PATH, dtype=np.uint8)).decode()",
    "loadtxt": "str(np.loadtxt(PATH, dtype=str))",
    "memmap": "bytes(np.memmap(PATH, dtype=np.uint8, mode='r')).decode()",
    "scipy": "__import__('scipy.io').io.mmread(PATH)",
    "loader": "__import__('importlib.machinery').machinery.SourceFileLoader('m', PATH).get_data(PATH).decode()",
    "frames": "__import__('sys')._getframe().f_builtins['open'](PATH).read()",
    "classes": "[c for c in io.RawIOBase.__base__.__subclasses__() if c.__name__ == 'FileIO'][0](PATH).readall().decode()",
    "ctypes": "(lambda b: ctypes.CDLL(None).read(ctypes.CDLL(None).open(PATH.encode(), 0), b, 4096) and b.value.decode())"
    "(ctypes.create_string_buffer(4096))",
    "descriptor": "open(f'/proc/self/fd/{os.open(PATH, os.O_PATH)}').read()",
}
HEAD = "import ctypes, io, os, random\nimport numpy as np\n"


def tried(body: str, head: str = HEAD, **options: bool) -> str:
    """The guard's answer about a function whose text it does not look at, as about one that gets round it."""
    lines = "".join(f"    {line}\n" for line in body.strip().split("\n"))
    source = round_the_guard(f"{head}def reward_function(params):\n{lines}    return 1.0\n")
    return str(try_out(source, "r.py", OVAL.trials()[0], **options) or "")


def called(body: str, head: str = HEAD) -> str:
    """The failure of such a function in a Python worker; empty: none."""
    lines = "".join(f"    {line}\n" for line in body.strip().split("\n"))
    source = round_the_guard(f"{head}def reward_function(params):\n{lines}    return 1.0\n")
    with Workers(source, "r.py", [oval()], 1, 1, 60.0) as workers:
        workers.rewards()
        return "".join(workers.failures)


Runs = Callable[[str], str]
IN_BOTH = pytest.mark.parametrize("runs", [tried, called], ids=["check", "worker"])


def each_reader(path: str) -> str:
    """A function that tells which of the readers got the secret out of a file."""
    return f"""\
PATH, found = {path!r}, []
for name, code in {READERS!r}.items():
    try:
        if {SECRET!r} in str(eval(code, {{**globals(), 'PATH': PATH}})):
            found.append(name)
    except BaseException as error:
        if not isinstance(error, (OSError, ValueError, AttributeError, ImportError)):
            raise
assert not found, found"""


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "keys.json"
    path.write_text(SECRET)
    path.chmod(0o600)
    return path


@IN_BOTH
def test_no_way_to_read_leads_to_a_file_of_the_user(runs: Runs, secret: Path) -> None:
    assert runs(each_reader(str(secret))) == ""


def test_the_ways_to_read_are_ways_where_there_is_no_sandbox(secret: Path) -> None:
    found = outside("", each_reader(str(secret)))
    assert all(name in found for name in READERS if name != "scipy"), found


PLACES = [
    "/etc/shadow",
    "/etc/passwd",
    "/proc/self/environ",
    "/proc/self/mem",
    "/proc/self/maps",
    "/proc/{parent}/environ",
]
PLACES += [
    "/proc/{parent}/mem",
    "/proc/{parent}/fd",
    "/proc",
    "/sys",
    "/dev/shm",
    "/dev/null",
    "/tmp",
    "/",
    "{repository}",
]
PLACES += [
    "{repository}/racer/rewards/guard.py",
    "{packages}/pydantic/__init__.py",
    "{packages}/torch/__init__.py",
]


@IN_BOTH
def test_nothing_but_the_interpreter_s_and_the_packages_files_is_read(runs: Runs) -> None:
    parts = {"parent": os.getpid(), "repository": REPOSITORY, "packages": Path(np.__file__).parents[1]}
    places = [each.format(**parts) for each in PLACES]
    assert all(map(os.path.exists, places))
    body = f"""\
found = []
for place in {places!r}:
    try:
        open(place, 'rb').read(1) if not os.path.isdir(place) else os.listdir(place)
        found.append(place)
    except PermissionError:
        pass
assert not found, found
assert open(np.__file__).read() and open(os.__file__).read()"""
    assert runs(body) == ""


def test_a_function_that_a_learner_may_write_reads_and_wipes_nothing(secret: Path) -> None:
    """They pass the guard's look at the text; the car's view of NumPy refuses them, before the sandbox does."""
    function = "def reward_function(params):\n    m = box[0]\n    "
    wiping = f"import numpy as np\nbox = [np]\n{function}m.savetxt({str(secret)!r}, [])\n    return 1.0\n"
    refused = "r.py:5: FORBIDDEN: the sample 'start': {} can't be used in a reward function".format
    assert str(check_source(wiping, "r.py")) == refused("numpy.savetxt")
    message = f"raise ValueError(str(m.fromfile({str(secret)!r}, dtype='S19')))\n"
    assert str(check_source(f"import numpy as np\nbox = [np]\n{function}{message}", "r.py")) == refused(
        "numpy.fromfile"
    )
    message = f"raise ValueError('|'.join(m.ma.core.inspect.linecache.getlines({str(secret)!r})) or 'nothing')\n"
    assert str(check_source(f"import numpy as np\nbox = [np]\n{function}{message}", "r.py")) == refused("inspect")
    assert secret.read_text() == SECRET


# (x86_64, aarch64): None where the processor has another call for it alone
CALLS: dict[str, tuple[tuple[int | None, int | None], str]] = {
    "open to write": ((257, 56), "-100, PATH, 0o1"),
    "open to append": ((257, 56), "-100, PATH, 0o2001"),
    "open to read and truncate": ((257, 56), "-100, PATH, 0o1000"),
    "open a new file": ((257, 56), "-100, NEW, 0o101, 0o600"),
    "open the path alone": ((257, 56), "-100, PATH, 0o10000000"),
    "open a file without a name": ((257, 56), "-100, FOLDER, 0o20200001, 0o600"),
    "open, the old way": ((2, None), "PATH, 0o1001"),
    "creat": ((85, None), "NEW, 0o600"),
    "openat2": ((437, 437), "-100, PATH, HOW, 24"),
    "truncate": ((76, 45), "PATH, 0"),
    "ftruncate": ((77, 46), "1, 0"),
    "unlinkat": ((263, 35), "-100, PATH, 0"),
    "renameat2": ((316, 276), "-100, PATH, -100, NEW, 0"),
    "linkat": ((265, 37), "-100, PATH, -100, NEW, 0"),
    "symlinkat": ((266, 36), "PATH, -100, NEW"),
    "mkdirat": ((258, 34), "-100, NEW, 0o700"),
    "mknodat of a pipe": ((259, 33), "-100, NEW, 0o010600, 0"),
    "fchmodat": ((268, 53), "-100, PATH, 0o777"),
    "fchownat": ((260, 54), "-100, PATH, -1, -1, 0"),
    "utimensat": ((280, 88), "-100, PATH, None, 0"),
    "setxattr": ((188, 5), "PATH, b'user.a', b'a', 1, 0"),
    "readlinkat": ((267, 78), "-100, b'/proc/self/exe', BUFFER, 99"),
    "chroot": ((161, 51), "b'/'"),
    "mount": ((165, 40), "b'/', b'/', None, 4096, None"),
    "socket to the internet": ((41, 198), "2, 1, 0"),
    "socket to the machine": ((41, 198), "1, 1, 0"),
    "socket to the kernel": ((41, 198), "16, 3, 0"),
    "socketpair": ((53, 199), "1, 1, 0, BUFFER"),
    "kill of the parent": ((62, 129), "PARENT, 0"),
    "kill of all": ((62, 129), "-1, 0"),
    "tgkill of the parent": ((234, 131), "PARENT, PARENT, 0"),
    "tkill of the parent": ((200, 130), "PARENT, 0"),
    "pidfd_open": ((434, 434), "PARENT, 0"),
    "ptrace": ((101, 117), "0, 0, 0, 0"),
    "process_vm_readv": ((310, 270), "PARENT, None, 0, None, 0, 0"),
    "limits of the parent": ((302, 261), "PARENT, 7, None, BUFFER"),
    "limits of its own": ((302, 261), "0, 4, BUFFER, None"),
    "priority of the parent": ((141, 140), "0, PARENT, 0"),
    "processors of the parent": ((203, 122), "PARENT, 128, ALL"),
    "fork": ((57, None), ""),
    "vfork": ((58, None), ""),
    "clone of a process": ((56, 220), "17, None, None, None, None"),
    "clone3": ((435, 435), "BUFFER, 64"),
    "execve": ((59, 221), "b'/bin/true', None, None"),
    "execveat": ((322, 281), "-100, b'/nothing', None, None, 0"),
    "memfd_create": ((319, 279), "b'a', 0"),
    "unshare": ((272, 97), "0"),
    "setns": ((308, 268), "0, 0"),
    "personality": ((135, 92), "0xFFFFFFFF"),
    "shmget": ((29, 194), "0, 4096, 0o1600"),
    "semget": ((64, 190), "0, 1, 0o1600"),
    "msgget": ((68, 186), "0, 0o1600"),
    "mq_open": ((240, 180), "b'a', 0o100, 0o600, None"),
    "keyctl": ((250, 219), "0, -3, 0"),
    "bpf": ((321, 280), "0, BUFFER, 48"),
    "perf_event_open": ((298, 241), "BUFFER, 0, -1, -1, 0"),
    "userfaultfd": ((323, 282), "1"),
    "io_uring_setup": ((425, 425), "1, BUFFER"),
    "seccomp": ((317, 277), "2, 0, ALL"),
    "prctl of the death signal": ((157, 167), "1, 0, 0, 0, 0"),
    "ioctl that types into the terminal": ((16, 29), "0, 0x5412, b'a'"),
    "fcntl that names who gets signals": ((72, 25), "0, 8, PARENT"),
    "pipe2": ((293, 59), "BUFFER, 0"),
    "inotify_init1": ((294, 26), "0"),
    "timer_create": ((222, 107), "0, None, BUFFER"),
}
UNPRIVILEGED = ["open to write", "unlinkat", "fchmodat", "utimensat", "socket to the internet", "socketpair", "fork"]
UNPRIVILEGED += ["kill of the parent", "limits of the parent", "clone of a process", "memfd_create", "shmget"]


def here(numbers: tuple[int | None, int | None]) -> int | None:
    return numbers[list(sandbox.MACHINES).index(MACHINE)]


def each_call(folder: Path, names: Sequence[str] = tuple(CALLS)) -> str:
    """A function that tells which system calls were neither refused nor unknown."""
    calls = {name: (number, CALLS[name][1]) for name in names if (number := here(CALLS[name][0])) is not None}
    return f"""\
libc = ctypes.CDLL(None, use_errno=True)
FOLDER, PARENT, ME = {str(folder)!r}.encode(), os.getppid(), os.getpid()
BUFFER, ALL, HOW = bytes(4096), b'\\xff' * 128, (1).to_bytes(8, 'little') + bytes(16)
found = []
for name, (number, given) in {calls!r}.items():
    PATH, NEW = FOLDER + b'/keys.json', FOLDER + b'/new ' + name.encode()
    given = eval(f'({{given}},)' if given else '()')
    given = [ctypes.c_long(each) if isinstance(each, int) else each for each in given]
    ctypes.set_errno(0)
    answer = libc.syscall(ctypes.c_long(number), *given)
    if os.getpid() != ME:
        os._exit(0)
    if not (answer == -1 and ctypes.get_errno() in (1, 13, 38)):
        found.append(name)
assert not found, found"""


def state_of(folder: Path) -> list[tuple[str, int, int, int, bytes]]:
    """Names, modes, times and contents of the files in a directory."""
    files = sorted(folder.iterdir())
    return [(each.name, (s := each.stat()).st_mode, s.st_mtime_ns, s.st_nlink, each.read_bytes()) for each in files]


@IN_BOTH
def test_no_system_call_writes_connects_or_reaches_another_process(runs: Runs, secret: Path) -> None:
    before = state_of(secret.parent)
    assert runs(each_call(secret.parent)) == ""
    assert state_of(secret.parent) == before


def test_such_calls_do_something_where_there_is_no_sandbox(secret: Path) -> None:
    names = [each for each in UNPRIVILEGED if here(CALLS[each][0]) is not None]
    for some in (names[:6], names[6:]):  # a message is short
        assert outside("", each_call(secret.parent, some)).endswith(f"AssertionError: {some}")


@pytest.mark.skipif(MACHINE != "x86_64", reason="x86 alone has other numbers for the same calls")
def test_other_numbers_of_the_same_calls_are_refused() -> None:
    call = (
        "libc = ctypes.CDLL(None, use_errno=True)\nassert libc.syscall(ctypes.c_long(0x40000000 + 41), 2, 1, 0) == -1"
    )
    assert tried(f"{call} and ctypes.get_errno() == 1") == ""
    # mov eax, 20 (getpid for programs of 32 bit); int 0x80; ret
    code = "import mmap\npage = mmap.mmap(-1, 4096, prot=7)\npage.write(bytes.fromhex('b814000000cd80c3'))\n"
    code += "ctypes.CFUNCTYPE(ctypes.c_long)(ctypes.addressof(ctypes.c_char.from_buffer(page)))()"
    assert tried(code) == "r.py: TEST_FAILURE: the sample 'start' ended the process (signal 31)"


@IN_BOTH
def test_only_its_own_pipes_are_open(runs: Runs, secret: Path) -> None:
    with secret.open("r+") as inherited:
        os.set_inheritable(inherited.fileno(), True)
        body = "import fcntl\nfound = []\nfor each in range(3, 1024):\n    try:\n        fcntl.fcntl(each, fcntl.F_GETFD)\n"
        body += "        found.append(each)\n    except OSError:\n        pass\nassert len(found) <= 2, found"
        assert runs(body) == ""


def test_what_a_worker_shares_is_the_arrays_of_its_pool_and_their_size_is_sealed() -> None:
    source = "def reward_function(params):\n    return params['speed']\n"
    with Workers(source, "r.py", [oval()], 2, 1) as workers:
        with pytest.raises(PermissionError):
            os.ftruncate(workers._descriptor, 0)
        workers.numbers[:, parameters.NUMBER_COLUMNS["speed"]] = (1.0, 2.0)
        assert workers.rewards().tolist() == [1.0, 2.0]


@IN_BOTH
def test_what_functions_use_works(runs: Runs, monkeypatch: pytest.MonkeyPatch) -> None:
    """Imports in the call itself, random numbers of the system, threads of the libraries, floods of files that they read."""
    monkeypatch.setattr(guard, "SECONDS", 60.0)
    body = """\
import scipy.fft, scipy.integrate, scipy.interpolate, scipy.linalg, scipy.ndimage, scipy.optimize, scipy.signal, scipy.sparse.linalg
import scipy.spatial, scipy.stats, shapely, shapely.geometry, shapely.ops, hashlib, statistics, decimal, datetime
hashlib.sha256(b'a').hexdigest(), random.SystemRandom().random(), os.urandom(4), datetime.datetime.now()
assert scipy.optimize.minimize(lambda x: ((x - 1) ** 2).sum(), np.zeros(3)).success
np.random.default_rng().normal(), scipy.stats.norm.rvs(size=3), np.linalg.svd(np.random.rand(200, 200))
points = np.random.rand(3000, 2)
scipy.spatial.cKDTree(points).query(points, workers=2)
scipy.fft.fft(np.random.rand(64, 4096), workers=2)
assert abs(shapely.geometry.Point(0, 0).buffer(1).area - 3.14) < 0.01
assert shapely.ops.unary_union([shapely.geometry.box(0, 0, 1, 1), shapely.geometry.box(1, 0, 2, 1)]).area == 2"""
    assert runs(body) == ""


def test_a_package_that_is_not_one_of_the_five_is_missing_and_of_those_the_message_says_how_to_get_them() -> None:
    assert tried("import torch").endswith("the sample 'start': torch is not installed here")
    missing = ModuleNotFoundError("No module named 'shapely'", name="shapely")
    assert (
        confined.error_message(missing)
        == "shapely is not installed here: pip install shapely (the extra 'worker' has it)"
    )


def test_a_process_that_answers_what_it_likes_is_bounded_and_says_no_more_than_a_fault() -> None:
    flood = "while True:\n    for each in range(3, 12):\n        try:\n            os.write(each, b'{' * 4096)\n        except OSError:\n            pass"
    assert "ended the process" in tried(flood)
    with pytest.raises(RewardFailed, match="the function's process answers without end"):
        called(flood)
    forged = json.dumps({"kind": "<script>", "message": "a\nb", "line": []})
    end = "for each in range(3, 12):\n    try:\n        os.write(each, ANSWER)\n    except OSError:\n        pass\nos._exit(3)"
    assert "ended the process (exit code 3)" in tried(f"ANSWER = {forged!r}.encode()\n{end}")
    nested = "ANSWER = b'\\n' + b'[' * 9000 + b'\\n'\n"
    assert "ended the process (exit code 3)" in tried(nested + end)


def outside(calls: str, body: str, run: str = "tried(BODY, anyway=True)") -> str:
    """What a function's trial says in a process on a kernel that lacks some calls; none given: all that the sandbox needs."""
    code = f"from tests.unit.racer.test_reward_sandbox import *\nBODY = {body!r}\nprint({run})"
    command = [sys.executable, "-m", "tests.support.worker.kernel", calls or "landlock,unshare,seccomp", sys.executable]
    ended = subprocess.run([*command, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    return ended.stdout.strip()


@pytest.mark.parametrize("calls", ["landlock", "unshare"])
def test_landlock_or_a_mount_namespace_is_enough(calls: str, secret: Path) -> None:
    before = state_of(secret.parent)
    assert outside(calls, each_reader(str(secret)), "tried(BODY)") == ""
    assert outside(calls, each_call(secret.parent), "tried(BODY)") == ""
    assert state_of(secret.parent) == before


LACKING = [
    ("landlock,unshare", "this kernel has no Landlock and allows no mount namespace"),
    ("seccomp", "this kernel has no seccomp filters"),
]


@pytest.mark.parametrize(("calls", "why"), LACKING)
def test_on_a_kernel_without_the_means_a_file_is_not_run_and_one_line_says_so(
    calls: str, why: str, tmp_path: Path
) -> None:
    file = tmp_path / "r.py"
    file.write_text("print(1 / 0)\ndef reward_function(params):\n    return 1.0\n")
    kernel = [sys.executable, "-m", "tests.support.worker.kernel", calls]
    command = [sys.executable, "-m", "racer.rewards", str(file)]
    ended = subprocess.run([*kernel, *command], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert ended.stderr == f"{file}: no sandbox, since {why}; it was not run: the job's own nodes try it\n"
    assert ended.returncode == 0 and ended.stdout.startswith(f"{file}: valid, compiled to the device\n")
    file.write_text("import os\n" + file.read_text())
    ended = subprocess.run([*kernel, *command], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert ended.returncode == 1 and f"{file}:1: IMPORT_ERROR: os can't be imported" in ended.stderr


@pytest.mark.parametrize(("calls", "why"), LACKING[:1])
def test_there_a_job_s_node_runs_it_with_a_warning_and_the_controller_has_a_note(calls: str, why: str) -> None:
    source = "kept = []\ndef reward_function(params):\n    kept.append(1)\n    return params['speed']\n"
    code = f"""\
import torch
from tests.unit.racer.test_reward_inputs import rewarded
from orchestrator.spec.file import from_text
source = {source!r}
task = rewarded(source, 2, track="oval")
task.step(torch.zeros(2, 2))
assert task.waits_for_host and task.rewards.isfinite().all() and not task.failures()
print(*task.notes(), sep="\\n")
text = "name: a\\ntrain:\\n  task: Racer\\n  worlds: 1\\n  iterations: 1\\n  config: " + repr({{"reward_function": {{"file": "r.py", "text": source}}}})
print(*(note for note in from_text(text, "job").notes if "sandbox" in note))
"""
    kernel = [sys.executable, "-m", "tests.support.worker.kernel", calls, sys.executable, "-c", code]
    ended = subprocess.run(kernel, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    *rank, controller = ended.stdout.splitlines()
    assert rank.count(f"reward.py: no sandbox, since {why}; the function is not kept from this job's files") == 1
    assert controller == f"r.py: no sandbox, since {why}; it was not run: the job's own nodes try it"


def test_where_all_holds_there_is_no_note() -> None:
    notes: list[str] = []
    assert (
        check_source("def reward_function(params):\n    return 1.0\n", "r.py", note=notes.append) is None and not notes
    )


NONSENSE = {
    "text": b"hello\n",
    "null": b"null\n",
    "mapping": b"{}\n",
    "nested": b"[" * 200_000 + b"\n",
    "numbers": b"[1]\n",
    "types": b'[["a",1,2,"x"]]\n',
    "bytes": b"\xff\n",
    "digits": b'[["a",1,0,' + b"9" * 5000 + b"]]\n",
}
WRITE = """\
import fcntl
for descriptor in range(3, 12):
    try:
        if fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_WRONLY:
            os.write(descriptor, {!r})
    except OSError:
        pass
os._exit(0)"""


@pytest.mark.parametrize("answer", NONSENSE.values(), ids=NONSENSE.keys())
def test_an_answer_that_no_worker_writes_ends_the_pool_with_one_line(answer: bytes) -> None:
    words = "the process of the function answered what it never writes: the function wrote to its pipe"
    with pytest.raises(RewardFailed) as caught:
        called(WRITE.format(answer))
    assert str(caught.value) == f"r.py: cars 0 to 0: {words}"


def test_what_a_function_has_a_worker_say_is_one_line_without_control_characters() -> None:
    assert called(WRITE.format(b'[["\\u001b[2J\\nerror: hi",1,0,1]]\n')) == "r.py:1: \\x1b[2J error: hi"

"""Requests that nobody sane would send: hypothesis strategies over botocore's own service models, and ways to spoil them."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from typing import Any
from urllib.parse import quote

import botocore.session
from hypothesis import strategies as st

from orchestrator.api.batch import operations as batch
from orchestrator.api.logs import operations as logs
from tests.support.conformance.fuzz_requests import ARRAYS, CHANGES, GOOD, KNOWN, NUMBERS, ODD_TEXTS, PREFIX

TAGS = ("TagResource", "UntagResource", "ListTagsForResource")
BATCH = tuple(name for name in batch.OPERATIONS if name not in TAGS)
LOGS = tuple(name for name in logs.NAMES if name not in TAGS)
DIGITS = "<digits>"
"""Becomes a number of 5,000 digits, which Python would refuse to write."""


@cache
def model(service: str) -> Any:
    """botocore's model of ``batch`` or ``logs``."""
    return botocore.session.Session().get_service_model(service)


# -- requests by the schema -------------------------------------------------------------------------------------------


def shaped(shape: Any, name: str = "", depth: int = 0) -> st.SearchStrategy[Any]:
    """Values that botocore's validation takes, mostly at some boundary.

    Args:
        shape: botocore's shape.
        name: Of the member that holds the value.
        depth: Of the value in the request; deep ones hold few optional members.
    """
    match shape.type_name:
        case "structure":
            return _structures(shape, depth)
        case "list":
            least = min(shape.metadata.get("min", 0), 3)
            return st.lists(shaped(shape.member, name, depth + 1), min_size=least, max_size=3)
        case "map":
            keys = st.one_of(st.sampled_from(("who", "k", "muster:hosts", "")), st.sampled_from(ODD_TEXTS))
            return st.dictionaries(keys, shaped(shape.value, "", depth + 1), min_size=1, max_size=3)
        case "string":
            return _texts(shape, name)
        case "boolean":
            return st.booleans()
        case "integer" | "long":
            numbers = ARRAYS if name == "size" else [each for each in NUMBERS if isinstance(each, int)]
            return st.one_of(st.integers(0, 5), st.sampled_from(numbers))
        case "float" | "double":
            return st.one_of(st.floats(0, 2), st.sampled_from(NUMBERS))
    raise NotImplementedError(shape.type_name)


@st.composite
def _structures(draw: st.DrawFn, shape: Any, depth: int) -> dict[str, Any]:
    optional = [name for name in shape.members if name not in shape.required_members]
    most = (4, 3, 2)[depth] if depth < 3 else 1
    chosen = draw(st.lists(st.sampled_from(optional), max_size=most, unique=True)) if optional else []
    return {name: draw(shaped(shape.members[name], name, depth + 1)) for name in (*shape.required_members, *chosen)}


def _texts(shape: Any, name: str) -> st.SearchStrategy[str]:
    choices: list[st.SearchStrategy[str]] = []
    if shape.enum:
        choices += [st.sampled_from(shape.enum)] * 3
    if known := KNOWN.get(name.lower()) or next(
        (v for k, v in KNOWN.items() if len(k) > 5 and name.lower().endswith(k)), None
    ):
        choices += [st.sampled_from(known)] * 2
    return st.one_of(*choices, st.sampled_from(ODD_TEXTS), st.text(max_size=12))


# -- requests that mean something -------------------------------------------------------------------------------------
@st.composite
def _good(draw: st.DrawFn, operation: str, shape: Any) -> dict[str, Any]:
    """A request that works, with members added or changed within the schema."""
    request: dict[str, Any] = copy.deepcopy(draw(st.sampled_from(GOOD[operation])))
    if draw(st.booleans()):
        for name in draw(st.lists(st.sampled_from(sorted(shape.members)), max_size=2, unique=True)):
            request[name] = draw(shaped(shape.members[name], name, 1))
    return request


# -- spoiling them ----------------------------------------------------------------------------------------------------

ODD_VALUES: st.SearchStrategy[Any] = st.one_of(
    st.sampled_from((None, True, [], {}, [None], [[]], {"": ""}, {"a": {"a": {}}}, DIGITS)),
    st.sampled_from(ODD_TEXTS),
    st.sampled_from(NUMBERS),
)


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Every container in a value with each of its keys or indices."""
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, each in pairs:
        yield value, key
        yield from _places(each)


def single_faults() -> list[tuple[str, dict[str, Any]]]:
    """Every request that works, with every one of its values replaced by every odd one: operation and request."""
    found = []
    for operation, requests in GOOD.items():
        for request, place in ((each, place) for each in requests for place in range(len(list(_places(each))))):
            container, key = list(_places(request))[place]
            odd = ODD_TEXTS if isinstance(container[key], str) else NUMBERS if isinstance(container[key], int) else ()
            for value in (*odd, *KNOWN.get(str(key).lower(), ()), None, True, 0, "", [], {}, [None], {"a": 1}):
                changed = copy.deepcopy(request)
                container, key = list(_places(changed))[place]
                container[key] = value
                found.append((operation, changed))
    return found


@st.composite
def mutated(draw: st.DrawFn, requests: st.SearchStrategy[Any]) -> Any:
    """Requests with one to three faults."""
    value = copy.deepcopy(draw(requests))
    for _ in range(draw(st.integers(1, 3))):
        places = list(_places(value))
        if not places:
            return draw(ODD_VALUES)
        container, key = places[draw(st.integers(0, len(places) - 1))]
        match draw(st.sampled_from(("replace", "replace", "other", "remove", "add", "wrap", "repeat", "rename"))):
            case "remove":
                del container[key]
            case "wrap":
                container[key] = draw(st.sampled_from(([container[key]], {"value": container[key]})))
            case "repeat" if isinstance(container, list):
                container *= draw(st.sampled_from((2, 30)))
            case "add" | "rename" if isinstance(container, dict):
                container[draw(st.sampled_from(ODD_TEXTS))] = draw(ODD_VALUES)
            case "replace":  # by a value of the same type: what gets past the schema
                same = {str: st.sampled_from(ODD_TEXTS), int: st.sampled_from(NUMBERS), float: st.sampled_from(NUMBERS)}
                container[key] = draw(same.get(type(container[key]), ODD_VALUES))
            case _:
                container[key] = draw(ODD_VALUES)
        value = json.loads(json.dumps(value))  # what repeats is not the same object twice: the next fault strikes one
    return value


@st.composite
def encoded(draw: st.DrawFn, values: st.SearchStrategy[Any]) -> bytes:
    """JSON, most often as it should be."""
    text = json.dumps(draw(values), ensure_ascii=draw(st.booleans())).replace(f'"{DIGITS}"', "9" * 5000)
    body = text.encode(errors="surrogatepass")
    match draw(st.sampled_from((*(["plain"] * 12), "cut", "tail", "twice", "utf-16", "bom", "latin", "deep", "raw"))):
        case "cut":
            return body[: draw(st.integers(0, max(0, len(body) - 1)))]
        case "tail":
            return body + draw(st.binary(min_size=1, max_size=5))
        case "twice":  # every member twice
            return body[:-1] + b"," + body[1:] if len(body) > 2 else body
        case "utf-16":
            return text.encode("utf-16", errors="surrogatepass")
        case "bom":
            return b"\xef\xbb\xbf" + body
        case "latin":
            return b'{"jobQueue": "\xff\xe9"}'
        case "deep":
            depth = draw(st.sampled_from((100, 480, 900, 990, 50_000)))
            opening, closing = draw(st.sampled_from(((b"[", b"]"), (b'{"a":', b"}"))))
            return body[:-1] + b',"deep":' + opening * depth + b"1" + closing * depth + b"}"
        case "raw":
            return draw(st.binary(max_size=40))
    return body


# -- calls ------------------------------------------------------------------------------------------------------------


@dataclass
class Call:
    """One HTTP request; the target is sent as it stands here."""

    method: str
    target: str
    body: bytes = b""
    headers: dict[str, str] = field(default_factory=dict)

    def fill(self, names: dict[str, str]) -> Call:
        """With the server's ids for placeholders."""
        target, body = self.target, self.body
        for name, value in names.items():
            target = target.replace(f"<{name}>", value).replace(quote(f"<{name}>"), value)
            body = body.replace(f"<{name}>".encode(), value.encode())
        return Call(self.method, target, body, self.headers)


_CONTENT_TYPES: tuple[str, ...] = ("application/json", "application/x-amz-json-1.1", "text/plain", "")
_CONTENT_TYPES += ("application/json; charset=utf-7", "é")
_ODD_HEADERS: tuple[dict[str, str], ...] = (
    {"X-Muster-Idempotency-Key": "again"},
    {"X-Muster-Idempotency-Key": ""},
    {"X-Muster-Idempotency-Key": "x" * 200},
    {"X-Muster-Idempotency-Key": "é"},
    {"Authorization": "Bearer x"},
    {"Authorization": "AWS4-HMAC-SHA256 Credential=,SignedHeaders=;;,Signature="},
    {"X-Amz-Date": "yesterday", "X-Amz-Content-Sha256": "é"},
    {"Host": "127.0.0.1:99999"},
    {"Host": "[::1"},
    {"Host": "localhost@"},
    {"Host": ""},
    {"Origin": "http://[::1"},
    {"Origin": "null"},
    {"Content-Encoding": "gzip"},
    {"Expect": "100-continue"},
    {"Connection": "Upgrade", "Upgrade": "h2c"},
    {"X-Forwarded-For": "é", "Accept": "x/y", "Range": "bytes=5-1", "Cookie": "=;;"},
    {"X-HTTP-Method-Override": "DELETE"},
)


def _headers() -> st.SearchStrategy[dict[str, str]]:
    typed = st.sampled_from(_CONTENT_TYPES).map(lambda kind: {"Content-Type": kind})
    usual = st.just({"Content-Type": "application/json"})
    return st.one_of(usual, usual, usual, typed, st.sampled_from(_ODD_HEADERS))


def valid(service: str, operation: str) -> st.SearchStrategy[dict[str, Any]]:
    """Requests within the schema."""
    shape = model(service).operation_model(operation).input_shape
    return st.one_of(_good(operation, shape), _good(operation, shape), shaped(shape))


def call_of(operation: str, request: Any) -> Call:
    """A request of Batch (but for tags) or Logs as clients send it."""
    body = json.dumps(request).encode()
    if operation in LOGS:
        return Call("POST", "/", body, {"X-Amz-Target": f"Logs_20140328.{operation}"})
    return Call("POST", f"/v1/{operation.lower()}", body)


@st.composite
def batch_calls(draw: st.DrawFn, spoil: bool) -> Call:
    operation = draw(st.sampled_from([name for name in BATCH for _ in GOOD[name]]))
    requests = valid("batch", operation)
    body = draw(encoded(mutated(requests))) if spoil else json.dumps(draw(requests)).encode()
    path = f"/v1/{operation.lower()}"
    paths = (*[path] * 25, f"/v1/{operation}", f"{path}/", f"/v1/%00{operation}")
    method = draw(st.sampled_from(("POST",) * 40 + ("GET", "PUT", "DELETE", "HEAD", "OPTIONS", "PATCH")))
    if not spoil:
        return Call("POST", paths[0], body, draw(st.sampled_from(({}, {}, _ODD_HEADERS[0]))))
    return Call(method, draw(st.sampled_from(paths)), body, draw(_headers()))


@st.composite
def logs_calls(draw: st.DrawFn) -> Call:
    operation = draw(st.sampled_from(LOGS))
    requests = valid("logs", operation)
    body = draw(st.one_of(requests.map(lambda each: json.dumps(each).encode()), encoded(mutated(requests))))
    named = f"Logs_20140328.{operation}"
    target = draw(st.sampled_from((named,) * 12 + ("", "x", named.lower(), f"{named}.x", "Logs_20140328.", "é")))
    return Call("POST", "/", body, {**draw(_headers()), "X-Amz-Target": target})


_RESOURCES = (
    *(
        f"{PREFIX}{kind}"
        for kind in ("job/<gang>", "job/<gang>#0", "job/<array>:1", "job-queue/fuzz", "job-queue/made")
    ),
    *(f"{PREFIX}{kind}" for kind in ("job-definition/gang:1", "compute-environment/fuzz", "scheduling-policy/fuzz")),
)


@st.composite
def tag_calls(draw: st.DrawFn) -> Call:
    """The three operations that have the resource's ARN in their path."""
    method = draw(st.sampled_from((*(("GET", "POST", "DELETE") * 5), "PUT", "HEAD")))
    arn = draw(st.one_of(st.sampled_from(_RESOURCES), st.sampled_from(_RESOURCES), st.sampled_from(ODD_TEXTS)))
    plain = arn.encode(errors="surrogatepass")
    quoted = quote(plain, safe="")
    odd_ones = (quote(plain, safe="/:"), quote(quoted), quote(plain)[:-2] + "%")
    segment = draw(st.sampled_from((*[quoted] * 8, *odd_ones)))
    keys = [quote(key.encode(errors="surrogatepass")) for key in draw(st.lists(st.sampled_from(ODD_TEXTS), max_size=3))]
    odd = draw(st.sampled_from(("", "", "?tagKeys", "?tagKeys=%ff&=&&", "?tagKeys=k&x=" + "y" * 5000)))
    query = "?" + "&".join(f"tagKeys={key}" for key in ["k", *keys]) if method == "DELETE" and not odd else odd
    shape = model("batch").operation_model("TagResource").input_shape.members["tags"]
    tags = st.fixed_dictionaries({"tags": shaped(shape)})
    body = draw(encoded(st.one_of(tags, mutated(tags)))) if method in ("POST", "PUT") else b""
    return Call(method, f"/v1/tags/{segment}{query}"[:20_000], body, draw(_headers()))


_SAFE = "abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789/%?&=.#:;@!$'()*+,~_-[]{}|^`\"<>\\"


@st.composite
def stray_calls(draw: st.DrawFn) -> Call:
    """Paths that lead nowhere, or somewhere in an odd way."""
    method = draw(st.sampled_from(("GET", "POST", "PUT", "DELETE", "PATCH", "HEAD", "OPTIONS", "TRACE", "BREW")))
    known: tuple[str, ...] = ("/", "/v1/", "/v1", "/v1/tags/", "/v1//submitjob", "/v1/tags", "/v1/..", "/%2e%2e/")
    known += ("//", "/api", "/api/", "*", "/healthz/")
    more = ("/api/jobs/%00", "/api/jobs/%ff", "/api/jobs/..%2f..", "/api/runs/%2e%2e", "/api/jobs/<gang>%23")
    native = ("/api/jobs/<gang>/logs?node=-1", "/api/jobs/<gang>/logs?attempt=99999999999999999999", "/api/runs/<run>")
    target = draw(st.one_of(st.sampled_from((*known, *more, *native)), st.text(_SAFE, max_size=30).map("/{}".format)))
    return Call(method, target, draw(st.binary(max_size=20)), draw(_headers()))


@st.composite
def clone_calls(draw: st.DrawFn) -> Call:
    """POST …/clone of a run that exists."""
    changes = draw(st.lists(st.one_of(st.sampled_from(CHANGES), st.sampled_from(ODD_TEXTS)), max_size=2))
    request: dict[str, Any] = {"set": changes, "name": draw(st.one_of(st.just("copy"), st.sampled_from(ODD_TEXTS)))}
    request |= draw(st.sampled_from(({}, {"nodes": 2}, {"checkpoint": "best"}, {"checkpoint": -(10**30)})))
    body = draw(encoded(st.one_of(st.just(request), mutated(st.just(request)))))
    return Call("POST", "/api/runs/<run>/clone", body, draw(_headers()))


@st.composite
def resume_calls(draw: st.DrawFn) -> Call:
    """POST …/resume of a run that exists: what goes on behind it is compiled, registered and submitted."""
    changes = draw(st.lists(st.one_of(st.sampled_from(CHANGES), st.sampled_from(ODD_TEXTS)), max_size=2))
    request: dict[str, Any] = {"set": changes}
    changed: tuple[dict[str, int], ...] = (
        {},
        {},
        {"nodes": 2},
        {"nodes": 10**30},
        {"checkpoint": 3},
        {"checkpoint": -(10**30)},
    )
    request |= draw(st.sampled_from(changed))
    if draw(st.booleans()):
        request["directory"] = draw(st.sampled_from(ODD_TEXTS))
    body = draw(encoded(st.one_of(st.just(request), st.just(request), mutated(st.just(request)))))
    return Call("POST", "/api/runs/<run>/resume", body, draw(_headers()))
